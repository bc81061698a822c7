"""Cameras that were moved during a recording: when, and by how much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import KeypointViews, from_others, meet
from kinefit.findings import Edit, Finding, in_words

_MIN_STEP_PX = 10.0  # of a camera's keypoints against the others': errors of detectors change by less with the pose
_MIN_PART_FRAMES = 8  # before and after a move
_MIN_EXPLAINED = 0.6  # share of the offsets' squared deviation from their median that one step explains
_MIN_SHARP = 0.6  # share of the step between the nearest frames on both sides; a person who turns takes longer
_NEAR_FRAMES = 10  # on each side
_MAX_OTHER_STEP = 0.5  # of the others' offsets without the moved camera, to its own
_MIN_POINTS = 5  # of a frame


def kick_findings(views: KeypointViews, frames: NDArray) -> tuple[list[Finding], KeypointViews]:
    """Faults for cameras that moved during the recording, and the views without what they saw in their other pose.

    Parameters
    ----------
    views : KeypointViews of three cameras or more
    frames : (F,) int, the numbers of the take's frames
    """
    out, rest, uv = list[Finding](), views, views.uv.copy()
    while len(rest.rig) > 2:
        steps = [_largest_step(_offsets(rest, c)) for c in range(len(rest.rig))]
        left = [_left(rest, c, size) for c, (size, *_) in enumerate(steps)]
        found = int(np.argmin(left))
        if left[found] >= _MAX_OTHER_STEP:
            break
        name, (size, at, off) = rest.rig.names[found], steps[found]
        out.append(_finding(name, size, frames, at, off))
        moved = slice(at, None) if off[0] < off[1] else slice(0, at)
        uv[moved, :, views.rig.index(name)] = np.nan
        rest = rest.without(found)
    return out, replace(views, uv=uv)


def _finding(name: str, size: float, frames: NDArray, at: int, sizes: tuple[float, float]) -> Finding:
    frame, last = int(frames[at]), int(frames[-1]) + 1
    text = f"{name} moved at frame {frame}: its keypoints shift there by {size:.0f} px against the other cameras' "
    text += f"({sizes[0]:.0f} px off before, {sizes[1]:.0f} px after)."
    part = (int(frames[0]), frame) if 2 * at > len(frames) else (frame, last)
    edits = (Edit("take", "frames", f"[{part[0]}, {part[1]}]"),)
    remedy = f"Calibrate it again for the frames after, or track the parts apart: {in_words(edits)}."
    confidence = "Certain: the other cameras agree with each other before and after."
    return Finding("fault", "kicked", text, (name,), confidence, remedy)


def _left(views: KeypointViews, c: int, size: float) -> float:
    """Largest step of the other cameras without a camera that has one of a size [px], as its share; else infinite."""
    if size < _MIN_STEP_PX:
        return np.inf
    rest = views.without(c)
    return max(_largest_step(_offsets(rest, k))[0] for k in range(len(rest.rig))) / size


def _offsets(views: KeypointViews, c: int) -> NDArray:
    """Shift along u and v, and rotation (F, 3) [px] of a camera's keypoints against those of the others.

    The rotation is that of points at the median distance from their middle. Of two cameras, against the points that
    both determine. NaN with few points.
    """
    uv = views.uv[:, :, c]
    if len(views.rig) > 2:
        d = uv - from_others(views, c)
    else:
        d = 2.0 * (uv - views.rig.cameras[c].project(meet(views)[0].reshape(-1, 3)).reshape(uv.shape))
    known = np.isfinite(d).all(axis=-1) & (np.isfinite(d).all(axis=-1).sum(axis=1) >= _MIN_POINTS)[:, None]
    out = np.full((len(uv), 3), np.nan)
    for f in np.flatnonzero(known.any(axis=1)):
        own, off = uv[f, known[f]], d[f, known[f]]
        q, shift = own - np.median(own, axis=0), np.median(off, axis=0)
        reach = np.linalg.norm(q, axis=1)
        across = (q[:, 0] * (off - shift)[:, 1] - q[:, 1] * (off - shift)[:, 0]) / np.maximum(reach, 1.0)
        out[f] = *shift, np.median(across)
    return out


def _largest_step(offsets: NDArray) -> tuple[float, int, tuple[float, float]]:
    """The step that explains offsets (F, 3) [px] best: size [px], first frame, and their sizes before and after.

    Of size 0 where none explains them.
    """
    at = np.flatnonzero(np.isfinite(offsets).all(axis=1))
    x, none = offsets[at], (0.0, 0, (0.0, 0.0))
    if len(x) < 2 * _MIN_PART_FRAMES:
        return none
    whole = np.median(x, axis=0)
    limit = 3.0 * np.median(np.linalg.norm(x - whole, axis=1)) + _MIN_STEP_PX
    x = whole + np.clip(x - whole, -limit, limit) if np.isfinite(limit) else x
    n, sums = np.arange(1, len(x)), np.cumsum(x, axis=0)
    before, after = sums[:-1] / n[:, None], (sums[-1] - sums[:-1]) / (len(x) - n)[:, None]
    gain = (n * (len(x) - n) / len(x)) * np.square(before - after).sum(axis=1)
    gain[: _MIN_PART_FRAMES - 1], gain[len(gain) - _MIN_PART_FRAMES + 1 :] = 0.0, 0.0
    k = int(np.argmax(gain)) + 1
    total = float(np.square(x - x.mean(axis=0)).sum())
    parts = [np.median(part, axis=0) for part in (offsets[at][:k], offsets[at][k:])]
    step = parts[1] - parts[0]
    size = float(np.linalg.norm(step))
    near = offsets[at][max(k - _NEAR_FRAMES, 0) : k], offsets[at][k : k + _NEAR_FRAMES]
    sharp = float((np.median(near[1], axis=0) - np.median(near[0], axis=0)) @ step) / max(size**2, 1e-12)
    if gain[k - 1] < _MIN_EXPLAINED * total or sharp < _MIN_SHARP:
        return none
    off = tuple(float(np.linalg.norm(part)) for part in parts)
    return size, int(at[k]), (off[0], off[1])
