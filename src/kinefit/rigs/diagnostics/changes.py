"""What changes within a take: clocks that jump or drift, and cameras that are moved.

The shift of two cameras against each other is estimated in windows along the take, by the distance of their rays. Its
course over the windows is a constant (an offset), a step (frames were dropped or repeated) or a line (another rate),
the one with clearly the smallest distance. A camera that is moved shows a step in the distance of its keypoints from
those of the others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import Edit, Finding, in_words, listed
from kinefit.fitting.multiview.association import medians
from kinefit.fitting.multiview.views import KeypointViews, errors_of, from_others, meet

Curve = tuple[NDArray, NDArray]
"""Shifts (S,) [frames] and their costs (S,) [px]."""

MAX_OFFSET = 2.0
"""[s] that is searched; cameras started by hand differ by less, or by much more."""
MIN_FRAMES = 12
"""Smallest number of frames from which a shift is estimated."""
_MAX_POINTS = 12  # of the body, those with most motion
_MAX_PAIR_FRAMES = 400  # of the first camera, for the cost of a shift
_MIN_SINE = 0.15  # of the angle between ray and baseline: below, the ray is not informative
_WINDOW_S = 1.5  # of one estimate: a gesture
_MIN_WINDOWS, _MAX_WINDOWS = 4, 12
_SEARCH_S = 12.0  # of the part that is looked at besides the whole: another rate leaves the searched shifts later
_MIN_STEP = 2.0  # [frames] that a clock has to jump or drift by: less is a constant, within a detector's errors
_MIN_EXCESS = 1.08
"""Cost with constant offsets to that with an offset of its own in each window: up to 1.04 where they are constant."""
_MIN_EXPLAINED = 0.5  # of this excess; a step within a window leaves up to half
_MIN_GAIN = 1.04  # of the cost, of more cameras, to count instead of fewer
_PERIOD_RATIO, _PERIOD_FRAMES = 1.03, 5  # of costs and least distance of steps that differ by periods of a movement
_COMMON_RATES = (12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 90.0, 100.0, 120.0, 200.0, 240.0)  # [Hz]
_MAX_RATE_ERROR = 0.015  # of an estimated rate
_SPAN_STEP = 0.25  # [frames] over the take, between the drifts that are tried
_MAX_DRIFT = 0.5  # of a frame in each frame: half the stated rate
_MAX_ALL_PAIRS = 5  # cameras of which all pairs are compared in windows; of more, each with four others
_MAX_SUBSET = 8  # cameras of which all groups are tried; of more, single ones

_MIN_MOVE_PX = 10.0  # of a camera's keypoints against the others': errors of detectors change by less with the pose
_MIN_PART_FRAMES = 8  # before and after a move
_MIN_STEP_SHARE = 0.6  # of the squared deviation that one step explains, and of the step between its nearest frames: a
# person who turns takes longer
_NEAR_FRAMES = 10  # on each side
_INLIER_PERCENTILES = 5, 95  # of the offsets of all frames
_MAX_OTHER_STEP = 0.5  # of the others' offsets without the moved camera, to its own


def clock_findings(views: KeypointViews, first: int = 0) -> tuple[list[Finding], KeypointViews]:
    """A fault for cameras whose clock jumps or drifts within the take, and the views in step.

    Parameters
    ----------
    views : KeypointViews of consecutive frames, with left and right corrected
    first : the number of the take's first frame
    """
    for length in dict.fromkeys((len(views), min(len(views), round(_SEARCH_S * views.rate)))):
        windows = int(min(length / (_WINDOW_S * views.rate), _MAX_WINDOWS))
        if windows >= _MIN_WINDOWS and len(views.rig) > 1:
            course = _course(views, np.arange(windows * (length // windows)).reshape(windows, -1))
            if course is not None:
                names, frame, size, costs = course
                late = np.where(np.arange(len(views)) < frame, 0.0, size) if frame else size * np.arange(len(views))
                finding = _drift(views, names, size) if not frame else _step(views, names, first, frame, size)
                text = f"with it the rays of the cameras pass each other at {costs[0]:.1f} px, with constant offsets at"
                text = f"Certain: {text} {costs[1]:.1f} px.{finding.confidence}"
                moved = np.outer(late, np.isin(views.rig.names, names))
                return [replace(finding, confidence=text)], shifted(views, moved)
    return [], views


def _drift(views: KeypointViews, names: tuple[str, ...], slope: float) -> Finding:
    """Of a clock that drifts by `slope` [frames] in each frame."""
    true, others = views.rate / (1.0 + slope), listed(n for n in views.rig.names if n not in names)
    near = (r for r in _COMMON_RATES if abs(r / true - 1.0) < _MAX_RATE_ERROR < abs(r / views.rate - 1.0))
    true = next(near, true)
    text = f"The clock of {listed(names)} drifts by {60 * slope:+.2f} s a minute against {others}: its rate is "
    edits = tuple(Edit("keypoints", "rate", f"{true:.3f}", name) for name in names)
    return Finding("fault", "rate", f"{text}{true:.2f} Hz, not {views.rate:g} Hz.", names, edits=edits)


def _step(views: KeypointViews, names: tuple[str, ...], first: int, frame: int, size: float) -> Finding:
    """Of clocks that jump at a frame by `size` [frames]."""
    others, at = listed(n for n in views.rig.names if n not in names), first + frame
    way, cause = ("later", "Frames were dropped") if size > 0 else ("earlier", "Frames were repeated")
    text = f"{listed(names)} {'are' if len(names) > 1 else 'is'} {abs(size):.0f} frames "
    text += f"({1e3 * abs(size) / views.rate:.0f} ms) {way} than {others} from frame {at} on, not before."
    half = 2 * len(names) == len(views.rig)
    more = f" Which half of the cameras is wrong cannot be seen: {others} may have the opposite." if half else ""
    edits = (_longer_part(first, at, first + len(views)),)
    remedy = f"{cause} there. Until it is corrected, write {in_words(edits)}."
    return Finding("fault", "time", text, names, more, remedy, edits)


def _longer_part(first: int, at: int, last: int) -> Edit:
    part = (first, at) if 2 * at > first + last else (at, last)
    return Edit("take", "frames", f"[{part[0]}, {part[1]}]")


def _course(views: KeypointViews, windows: NDArray) -> tuple[tuple[str, ...], int, float, tuple[float, float]] | None:
    """Cameras whose clocks change, the frame of a step (0 of a drift), its size [frames], costs [px] with it, without.

    None where constant offsets fit as well. Of a drift, the size is in each frame.
    """
    pairs, costs = _window_costs(views, windows)
    if not len(pairs):
        return None
    middles, reach = windows.mean(axis=1), costs.shape[2] // 2
    sizes = [s for s in range(-reach, reach + 1) if abs(s) >= _MIN_STEP]
    steps = [size * (np.arange(len(windows)) >= part) for part in range(1, len(windows)) for size in sizes]
    spans = np.arange(-2 * reach, 2 * reach + 0.1, _SPAN_STEP) / len(views)
    slopes = spans[(np.abs(spans) * len(views) >= _MIN_STEP) & (np.abs(spans) <= _MAX_DRIFT)]
    slope = np.concatenate([np.zeros(len(steps) + 1), slopes])
    late = np.concatenate([[0.0 * middles], steps, np.outer(slopes, middles - middles.mean())])
    ways = _both_ways(costs, late, slope)
    least, without = float(costs.min(axis=2).mean()), float(ways[0, 0].mean())
    if without < _MIN_EXCESS * least:
        return None
    cameras, at, group = len(views.rig), 0, tuple(range(1))
    best = without - _MIN_EXPLAINED * (without - least)
    for count in range(1, cameras // 2 + 1 if cameras <= _MAX_SUBSET else 2):
        for some in combinations(range(cameras), count):
            total = _of_group(ways, pairs, some)
            if total.min() < best / (_MIN_GAIN if count > len(group) else 1.0):
                best, group, at = float(total.min()), some, int(np.argmin(total))
    if at == 0:
        return None
    total, far = _of_group(ways, pairs, group), np.where(slope, np.inf, np.abs(late[:, -1]))
    fits = (total <= _PERIOD_RATIO * best) & (far > 0.0) & (slope[at] == 0.0)
    while (smaller := np.flatnonzero(fits & (far < far[at]) & (abs(late - late[at])[:, -1] > _PERIOD_FRAMES))).size:
        at = int(smaller[np.argmin(total[smaller])])  # a movement that repeats itself: the nearest period
    size, frame = float(slope[at] or late[at][-1]), 0
    if not slope[at]:
        part, others = int(np.argmax(late[at] != 0.0)), ~np.isin(np.arange(cameras), group)
        frame = _first_after(views, -size * others, windows[part - 1][0], windows[part][-1])  # in frames of the group
        if 2 * len(group) == cameras and size < 0:  # dropped frames are more frequent than repeated ones
            group, size = tuple(np.flatnonzero(others).tolist()), -size
    return tuple(views.rig.names[c] for c in group), frame, size, (best, without)


def _both_ways(costs: NDArray, late: NDArray, slope: NDArray) -> NDArray:
    """(2, N, P) mean costs of pairs (P, W, S) if the clock of their first or of their second camera is `late` (N, W).

    late [frames] as it is recorded, with slopes (N,) in each frame; the pair's best constant is added to it.
    """
    shifts, out = np.arange(costs.shape[2])[None], np.empty((2, len(late), len(costs)))
    for k, courses in enumerate((late, -late / (1.0 + slope[:, None]))):
        for n, course in enumerate(np.rint(courses).astype(int)):
            at = shifts + course[:, None]
            picked = np.take_along_axis(costs, np.clip(at, 0, costs.shape[2] - 1)[None], axis=2)
            outside = (at < 0) | (at >= costs.shape[2])
            out[k, n] = np.where(outside, costs.max(axis=(1, 2))[:, None, None], picked).mean(axis=1).min(axis=1)
    return out


def _of_group(ways: NDArray, pairs: NDArray, group: Sequence[int]) -> NDArray:
    """(N,) mean costs over all pairs (P, 2), if the clocks of a group of cameras change together."""
    first, second = np.isin(pairs, group).T
    return np.where(first == second, ways[0, :1], np.where(first, *ways)).mean(axis=1)


def _first_after(views: KeypointViews, late: NDArray, low: int, high: int) -> int:
    """The frame between two from which the cameras agree better if they are `late` (C,) [frames]."""
    errors = [errors_of(v.rig, v.pixels()).reshape(len(v), -1) for v in (views, shifted(views, late))]
    worst = 3.0 * float(np.median(errors[0][np.isfinite(errors[0])]))
    before, after = (np.minimum(e, worst).mean(axis=1) for e in errors)
    return low + 1 + int(np.argmin(np.cumsum((before - after)[low:high])))


def pair_curves(views: KeypointViews) -> dict[tuple[int, int], Curve]:
    """Cost curves {(a, b): (shifts [frames], cost [px])}: distance of rays of b, at each shift, from those of a."""
    frames = np.unique(np.linspace(0, len(views) - 1, _MAX_PAIR_FRAMES).astype(int))
    pairs, costs = _window_costs(views, frames[None], filled=False)
    shifts = np.arange(costs.shape[2]) - costs.shape[2] // 2
    return {(a, b): (shifts, cost[0]) for (a, b), cost in zip(pairs.tolist(), costs) if np.isfinite(cost).sum() >= 3}


def _window_costs(views: KeypointViews, windows: NDArray, *, filled: bool = True) -> tuple[NDArray, NDArray]:
    """Pairs (P, 2) of cameras, and costs (P, W, S) [px] of shifts, in windows (W, N) of frames of the first camera.

    The shifts are whole frames about 0. Costs are NaN with few rays, or `filled` with the pair's largest.
    """
    motion = np.median(np.nan_to_num(np.abs(np.diff(views.uv, axis=0))).sum(-1), axis=0).sum(-1)
    points, cameras = np.argsort(-motion)[:_MAX_POINTS], views.rig.cameras
    rays = np.stack([camera.ray(views.uv[:, points, c]) for c, camera in enumerate(cameras)], axis=2)
    reach = int(min(MAX_OFFSET * views.rate, 0.4 * len(views)))
    pairs, costs = [], []
    for a, b in combinations(range(len(cameras)), 2):
        base = cameras[b].centre_world - cameras[a].centre_world
        skipped = len(windows) > 1 and len(cameras) > _MAX_ALL_PAIRS and min(b - a, len(cameras) - b + a) > 2
        if skipped or np.linalg.norm(base) < 1e-6:
            continue
        errors = [_epipolar_errors(rays[:, :, a], rays[:, :, b], base, windows, s) for s in range(-reach, reach + 1)]
        cost = np.sqrt(cameras[a].matrix[0, 0] * cameras[b].matrix[0, 0]) * np.stack(errors, axis=1)
        if np.isfinite(cost).any():
            pairs.append((a, b))
            costs.append(np.where(np.isfinite(cost), cost, np.nanmax(cost)) if filled else cost)
    return np.array(pairs), np.array(costs).reshape(len(pairs), len(windows), 2 * reach + 1)


def _epipolar_errors(rays_a: NDArray, rays_b: NDArray, base: NDArray, windows: NDArray, shift: int) -> NDArray:
    """(W,) mean angles [rad] between rays of b at frame + shift and the epipolar planes of a's rays, less the medians.

    NaN with too few rays.
    """
    at = windows + shift
    inside = ((at >= 0) & (at < len(rays_b)))[..., None, None]
    a, b = rays_a[windows], np.where(inside, rays_b[np.clip(at, 0, len(rays_b) - 1)], np.nan)
    normal = np.cross(base / np.linalg.norm(base), a)
    sine = np.linalg.norm(normal, axis=-1, keepdims=True)
    angle = np.sum(np.where(sine > _MIN_SINE, normal / np.maximum(sine, _MIN_SINE), np.nan) * b, axis=-1)
    apart = np.abs(angle - medians(angle.swapaxes(1, 2))[:, None])
    apart[np.broadcast_to((np.isfinite(apart).sum(axis=1) < MIN_FRAMES)[:, None], apart.shape)] = np.nan
    flat = apart.reshape(len(windows), -1)
    known = np.isfinite(flat)
    total = np.where(known, np.minimum(flat, 3.0 * medians(flat)[:, None]), 0.0).sum(axis=1)
    return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)


def shifted(views: KeypointViews, delays: Sequence[float] | NDArray) -> KeypointViews:
    """Shift the views to common times: frame f of camera c was recorded at f + delays[c], delays (C,) [frames].

    Interpolates linearly between frames. Delays (F, C) are those of each frame.
    """
    uv = np.full_like(views.uv, np.nan)
    t = np.arange(len(views))
    each = np.broadcast_to(np.asarray(delays, float), (len(t), len(views.rig))).T
    for c, delay in enumerate(each):
        at = np.interp(t, np.maximum.accumulate(t + delay + 1e-9 * t), t, -1.0, len(t)) if np.ptp(delay) else t - delay
        low = np.floor(at + 1e-9).astype(int)
        part = np.clip(at - low, 0.0, 1.0)
        first, second = np.clip(low, 0, len(t) - 1), np.clip(low + (part > 1e-6), 0, len(t) - 1)
        inside = (low >= 0) & (low + (part > 1e-6) < len(t))
        mixed = (1 - part)[:, None, None] * views.uv[first, :, c] + part[:, None, None] * views.uv[second, :, c]
        uv[:, :, c] = np.where(inside[:, None, None], mixed, np.nan)
    return replace(views, uv=uv)


def move_findings(
    views: KeypointViews, frames: NDArray, ignored: Collection[str] = ()
) -> tuple[list[Finding], KeypointViews]:
    """Faults for cameras that moved during the recording, and the views without what they saw in their other pose.

    Parameters
    ----------
    views : KeypointViews of three cameras or more
    frames : (F,) int, the numbers of the take's frames
    ignored : cameras that lack frames, whose absence would shift the points of the others
    """
    out, rest, uv = list[Finding](), views, views.uv.copy()
    for name in ignored:
        rest = rest.without(rest.rig.index(name))
    while len(rest.rig) > 2:
        moves = [_largest_step(_offsets(rest, c)) for c in range(len(rest.rig))]
        without = [rest.without(c) if move[0] >= _MIN_MOVE_PX else None for c, move in enumerate(moves)]
        left = [max(_largest_step(_offsets(v, k))[0] for k in range(len(v.rig))) if v else np.inf for v in without]
        c = int(np.argmin([others / max(move[0], 1e-9) for others, move in zip(left, moves)]))
        if left[c] >= _MAX_OTHER_STEP * moves[c][0]:
            break
        name, (size, at, off) = rest.rig.names[c], moves[c]
        edit = _longer_part(int(frames[0]), int(frames[at]), int(frames[-1]) + 1)
        text = f"{name} moved at frame {frames[at]}: its keypoints shift there by {size:.0f} px against the other "
        text += f"cameras' ({off[0]:.0f} px off before, {off[1]:.0f} px after)."
        remedy = f"Calibrate it again for the frames after, or track the parts apart: {in_words([edit])}."
        confidence = "Certain: the other cameras agree with each other before and after."
        out.append(Finding("fault", "kicked", text, (name,), confidence, remedy))
        uv[slice(at, None) if off[0] < off[1] else slice(0, at), :, views.rig.index(name)] = np.nan
        rest = rest.without(c)
    return out, replace(views, uv=uv)


def _offsets(views: KeypointViews, c: int) -> NDArray:
    """Shift along u and v, and rotation (F, 3) [px] of a camera's keypoints against those of the others.

    The rotation is that of points at the median distance from their middle. Of two cameras, against the points that
    both determine. NaN where none is known.
    """
    uv, pair = views.uv[:, :, c], len(views.rig) == 2
    d = 2.0 * (uv - views.rig.cameras[c].project(meet(views)[0])) if pair else uv - from_others(views, c)
    shift = medians(d.swapaxes(1, 2))
    q, off = uv - medians(uv.swapaxes(1, 2))[:, None], d - shift[:, None]
    across = q[..., 0] * off[..., 1] - q[..., 1] * off[..., 0]
    return np.column_stack([shift, medians(across / np.maximum(np.linalg.norm(q, axis=-1), 1.0))])


def _largest_step(offsets: NDArray) -> tuple[float, int, list[float]]:
    """The step that explains offsets (F, 3) [px] best: size [px], first frame, and their sizes before and after.

    Of size 0 where none explains them.
    """
    at = np.flatnonzero(np.isfinite(offsets).all(axis=1))
    if len(at) < 2 * _MIN_PART_FRAMES:
        return 0.0, 0, [0.0, 0.0]
    raw, n = offsets[at], np.arange(1, len(at))
    x = np.clip(raw, *np.percentile(raw, _INLIER_PERCENTILES, axis=0))
    sums = np.cumsum(x, axis=0)
    apart = sums[:-1] / n[:, None] - (sums[-1] - sums[:-1]) / (len(x) - n)[:, None]
    gain = (n * (len(x) - n) / len(x)) * np.square(apart).sum(axis=1)
    gain[: _MIN_PART_FRAMES - 1] = gain[len(gain) - _MIN_PART_FRAMES + 1 :] = 0.0
    k = int(np.argmax(gain)) + 1
    parts = np.stack([np.median(part, axis=0) for part in (raw[:k], raw[k:])])
    near = [np.median(part, axis=0) for part in (raw[max(k - _NEAR_FRAMES, 0) : k], raw[k : k + _NEAR_FRAMES])]
    step = parts[1] - parts[0]
    sharp = (near[1] - near[0]) @ step / max(step @ step, 1e-12)
    explained = gain[k - 1] / max(float(np.square(x - x.mean(axis=0)).sum()), 1e-12)
    size = float(np.linalg.norm(step)) if min(explained, sharp) >= _MIN_STEP_SHARE else 0.0
    return size, int(at[k]), np.linalg.norm(parts, axis=1).tolist()
