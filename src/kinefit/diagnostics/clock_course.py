"""Clocks that change within a take: frames dropped on the way, and cameras of another rate than stated.

The shift of two cameras against each other is estimated in windows along the take, by the distance of their rays. Its
course over the windows is a constant, a step or a line, the one with clearly the smallest distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from kinefit.diagnostics.views import KeypointViews
from kinefit.findings import Edit, Finding, listed
from kinefit.geometry.camera import Rig
from kinefit.multiview.association import medians

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
_SEARCH_S = 12.0  # of the part that is looked at beside the whole: another rate leaves the searched shifts later
_MIN_STEP = 2.0  # [frames] that a clock has to jump or drift by: less is a constant, within a detector's errors
_MIN_EXCESS = 1.08
"""Cost with constant offsets to that with an offset of its own in each window: up to 1.04 where they are constant."""
_MIN_EXPLAINED = 0.5  # of this excess; a step within a window leaves up to half
_SUBFRAMES = 4  # of a frame, in which a drift is estimated
_LINE_ROUNDS = 2  # of estimating a drift anew, once the cameras are nearly in step
_MIN_GAIN = 1.04  # of the cost, of more cameras or a line, to count instead of fewer or a step
_COMMON_RATES = (12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 90.0, 100.0, 120.0, 200.0, 240.0)  # [Hz]
_MAX_RATE_ERROR = 0.015  # of an estimated rate
_MAX_DRIFT = 0.5  # of a frame in each frame: half the stated rate
_MAX_ALL_PAIRS = 5  # cameras of which all pairs are compared in windows; of more, each with four others
_MAX_SUBSET = 8  # cameras of which all groups are tried; of more, single ones


@dataclass(frozen=True, eq=False)
class ClockCourse:
    """How the clocks of some cameras change against those of the others.

    Parameters
    ----------
    cameras : names of those of which the clock changes
    delays : (F,) [frames] by which a frame of theirs was recorded later, against the first frame of the take
    frame : int, of a step: the first frame after it; -1 of a drift
    size : float [frames] of the step; of a drift [frames] in each frame
    cost, without : mean distance of rays [px] with this course, and with constant offsets
    """

    cameras: tuple[str, ...]
    delays: NDArray
    frame: int
    size: float
    cost: float
    without: float

    def of(self, names: Sequence[str]) -> NDArray:
        """Delays (F, C) [frames] of all cameras."""
        return np.stack([self.delays if n in self.cameras else 0.0 * self.delays for n in names], axis=1)

    def finding(self, rig: Rig, rate: float, first: int) -> Finding:
        """What it means; `first` is the number of the take's first frame."""
        own, others = listed(self.cameras), listed(n for n in rig.names if n not in self.cameras)
        confidence = f"Certain: with it the rays of the cameras pass each other at {self.cost:.1f} px, with constant "
        confidence += f"offsets at {self.without:.1f} px."
        if self.frame < 0:
            true = rate / (1.0 + self.size)
            near = min(_COMMON_RATES, key=lambda other: abs(other - true))
            if abs(near / true - 1.0) < _MAX_RATE_ERROR and abs(near / rate - 1.0) > _MAX_RATE_ERROR:
                true = near
            text = f"The clock of {own} drifts by {60 * self.size:+.2f} s a minute against {others}: its rate is "
            text += f"{true:.2f} Hz, not {rate:g} Hz."
            edits = tuple(Edit("keypoints", "rate", f"{true:.3f}", name) for name in self.cameras)
            return Finding("fault", "rate", text, self.cameras, confidence, edits=edits)
        frame, count = first + self.frame, len(self.delays)
        way, cause = ("later", "Frames were dropped") if self.size > 0 else ("earlier", "Frames were repeated")
        text = f"{own} {'are' if len(self.cameras) > 1 else 'is'} {abs(self.size):.0f} frames "
        text += f"({1e3 * abs(self.size) / rate:.0f} ms) {way} than {others} from frame {frame} on, not before."
        if 2 * len(self.cameras) == len(rig):
            confidence += f" Which half of the cameras is wrong cannot be seen: {others} may have the opposite."
        part = (first, frame) if 2 * self.frame > count else (frame, first + count)
        edits = (Edit("take", "frames", f"[{part[0]}, {part[1]}]"),)
        remedy = f"{cause} there. Until it is corrected, write frames = [{part[0]}, {part[1]}] into [take]."
        return Finding("fault", "time", text, self.cameras, confidence, remedy, edits)


def clock_course(views: KeypointViews) -> ClockCourse | None:
    """The course of the clocks, of consecutive frames with left and right corrected; None if they are constant."""
    for length in dict.fromkeys((len(views), min(len(views), round(_SEARCH_S * views.rate)))):
        windows = int(min(length / (_WINDOW_S * views.rate), _MAX_WINDOWS))
        if windows < _MIN_WINDOWS or len(views.rig) < 2:
            continue
        frames = np.arange(windows * (length // windows)).reshape(windows, -1)
        found = _best_course(views, frames, _window_curves(views, frames))
        if found is not None:
            return _refined(views, found, frames) if found.frame < 0 else found
    return None


def _best_course(
    views: KeypointViews, windows: NDArray, curves: Mapping[tuple[int, int], Curve]
) -> ClockCourse | None:
    """The course that lowers the costs of all pairs in all windows most, if it does so clearly."""
    pairs = [pair for pair, (_, cost) in curves.items() if np.isfinite(cost).any()]
    if not pairs:
        return None
    shifts = curves[pairs[0]][0]
    costs = np.stack([curves[pair][1] for pair in pairs])  # (P, W, S)
    costs = np.where(np.isfinite(costs), costs, np.nanmax(costs, axis=(1, 2), keepdims=True))
    bends = _bends(len(windows), len(views), int(shifts[-1]))
    middles = windows.mean(axis=1)
    forward, back = (
        np.stack([_least_cost(costs, _course(bend, middles, of_first=first)) for bend in bends])
        for first in (True, False)
    )
    constant = _least_cost(costs, np.zeros(len(windows), int))
    least, without = float(costs.min(axis=2).mean()), float(constant.mean())
    if without < _MIN_EXCESS * least:
        return None
    chosen: tuple[tuple[int, ...], int] = (0,), -1
    best = without - _MIN_EXPLAINED * (without - least)
    for group in _groups(len(views.rig)):
        first, second = (np.isin([pair[k] for pair in pairs], group) for k in (0, 1))
        total = np.where(first == second, constant, np.where(first, forward, back)).mean(axis=1)
        at = int(np.argmin(total))
        if total[at] < best / (_MIN_GAIN if len(group) > len(chosen[0]) else 1.0):
            best, chosen = float(total[at]), (group, at)
    group, at = chosen
    if at < 0:
        return None
    names = tuple(views.rig.names[c] for c in group)
    part, size = bends[at]
    if part < 0:
        delays, frame = size * np.arange(len(views)), -1
    else:
        frame = _step_frame(views, pairs, costs, group, bends[at], windows)
        if 2 * len(group) == len(views.rig) and size < 0:  # dropped frames are more frequent than repeated ones
            names, size = tuple(n for n in views.rig.names if n not in names), -size
        delays = np.where(np.arange(len(views)) < frame, 0.0, size)
    return ClockCourse(names, delays, frame, size, best, without)


def _refined(views: KeypointViews, drift: ClockCourse, windows: NDArray) -> ClockCourse:
    """A drift estimated again from the views that it puts in step: within a window they hardly drift then."""
    middles, own = windows.mean(axis=1), [views.rig.names.index(n) for n in drift.cameras]
    for _ in range(_LINE_ROUNDS):
        curves = _window_curves(shifted(views, drift.of(views.rig.names)), windows)
        across = [pair for pair in curves if (pair[0] in own) != (pair[1] in own)]
        reach, costs = len(middles), np.stack([curves[pair][1] for pair in across])
        costs = np.where(np.isfinite(costs), costs, np.nanmax(costs, axis=(1, 2), keepdims=True))
        steps = costs.shape[2] - 1
        fine = np.linspace(0, steps, _SUBFRAMES * steps + 1)
        costs = CubicSpline(np.arange(steps + 1), costs, axis=2)(fine)
        slopes = np.arange(-4 * reach, 4 * reach + 1) / (4.0 * float(np.ptp(middles)))
        parts = [(costs[k : k + 1], pair[0] in own) for k, pair in enumerate(across)]
        course = partial(_course, middles=_SUBFRAMES * middles)
        total = [sum(_least_cost(one, course((-1, s), of_first=first))[0] for one, first in parts) for s in slopes]
        size = (1.0 + drift.size) * (1.0 + float(slopes[int(np.argmin(total))])) - 1.0
        drift = replace(drift, size=size, delays=size * np.arange(len(views)))
    return drift


def _bends(windows: int, length: int, reach: int) -> list[tuple[int, float]]:
    """First window and size [frames] of each step, and -1 and slope [frames in a frame] of each line."""
    sizes = [float(size) for size in range(-reach, reach + 1) if abs(size) >= _MIN_STEP]
    spans = [span for span in np.arange(-2 * reach, 2 * reach + 0.1, 0.5) if abs(span) >= _MIN_STEP]
    lines = [(-1, float(span / length)) for span in spans if abs(span / length) <= _MAX_DRIFT]
    return [*((part, size) for part in range(1, windows) for size in sizes), *lines]


def _course(bend: tuple[int, float], middles: NDArray, *, of_first: bool) -> NDArray:
    """Shifts (W,) int [frames] of a pair, but for a constant, if the clock of its first or second camera has a bend."""
    part, size = bend
    if part < 0:
        slope = size if of_first else -size / (1.0 + size)
        return np.rint(slope * (middles - middles.mean())).astype(int)
    return np.where(np.arange(len(middles)) < part, 0, int(size if of_first else -size))


def _least_cost(costs: NDArray, course: NDArray, at: bool = False) -> NDArray:
    """Mean costs (P,) of pairs (P, W, S) over windows, their shifts on a course (W,) from the best constant.

    With `at` the constants' numbers in S.
    """
    number = np.arange(costs.shape[2])[None] + course[:, None]
    inside = (number >= 0) & (number < costs.shape[2])
    picked = np.take_along_axis(costs, np.clip(number, 0, costs.shape[2] - 1)[None], axis=2)
    mean = np.where(inside, picked, costs.max(axis=(1, 2))[:, None, None]).mean(axis=1)
    return mean.argmin(axis=1) if at else mean.min(axis=1)


def _groups(cameras: int) -> Iterator[tuple[int, ...]]:
    """Cameras of which the clocks may change together: fewer than the others, or as many."""
    for size in range(1, cameras // 2 + 1 if cameras <= _MAX_SUBSET else 2):
        yield from combinations(range(cameras), size)


def _step_frame(
    views: KeypointViews, pairs: Sequence[tuple[int, int]], costs: NDArray, group: tuple[int, ...],
    bend: tuple[int, float], windows: NDArray,
) -> int:  # fmt: skip
    """The first frame after a step of a group's clocks: where the rays of the shifted frames begin to meet."""
    (part, size), middles = bend, windows.mean(axis=1)
    excess = np.zeros(len(views) + 1)
    reach = (costs.shape[2] - 1) // 2
    rays, frames = _rays(views), np.arange(len(views))
    for p, (a, b) in enumerate(pairs):
        if (a in group) == (b in group):
            continue
        way, course = (1 if a in group else -1), _course(bend, middles, of_first=a in group)
        constant = int(_least_cost(costs[p : p + 1], course, at=True)[0]) - reach
        own, other = (a, b) if a in group else (b, a)
        base = views.rig.cameras[other].centre_world - views.rig.cameras[own].centre_world
        each = [_angles(rays[:, :, own], rays[:, :, other], base, frames, way * constant + s) for s in (0, int(size))]
        each = [np.abs(angle - medians(angle.T)) for angle in each]
        worst = 3.0 * float(np.nanmedian(each))
        before, after = (np.mean(np.minimum(np.nan_to_num(e, nan=worst), worst), axis=1) for e in each)
        excess[1:] += np.cumsum(before - after)
    low, high = int(windows[part - 1][0]) + 1, int(windows[part][-1])
    return low + int(np.argmin(excess[low : high + 1]))


def _rays(views: KeypointViews) -> NDArray:
    """(F, K, C, 3) directions in the world of the points with most motion."""
    motion = np.median(np.nan_to_num(np.abs(np.diff(views.uv, axis=0))).sum(-1), axis=0).sum(-1)
    points = np.argsort(-motion)[:_MAX_POINTS]
    return np.stack([camera.ray(views.uv[:, points, c]) for c, camera in enumerate(views.rig)], axis=2)


def pair_curves(views: KeypointViews) -> dict[tuple[int, int], Curve]:
    """Cost curves {(a, b): (shifts [frames], cost [px])}: distance of rays of b, at each shift, from those of a."""
    frames = np.unique(np.linspace(0, len(views) - 1, _MAX_PAIR_FRAMES).astype(int))
    curves = _window_curves(views, frames[None])
    return {pair: (shifts, cost[0]) for pair, (shifts, cost) in curves.items() if np.isfinite(cost).sum() >= 3}


def _window_curves(views: KeypointViews, windows: NDArray) -> dict[tuple[int, int], Curve]:
    """The same for windows (W, N) of frames of a: {(a, b): (shifts (S,), costs (W, S) [px])}; NaN with few rays."""
    reach = int(min(MAX_OFFSET * views.rate, 0.4 * len(views)))
    shifts, rays = np.arange(-reach, reach + 1), _rays(views)
    out = {}
    cameras = len(views.rig)
    for a, b in combinations(range(cameras), 2):
        if cameras > _MAX_ALL_PAIRS and len(windows) > 1 and min(b - a, cameras - b + a) > 2:
            continue
        base = views.rig.cameras[b].centre_world - views.rig.cameras[a].centre_world
        if np.linalg.norm(base) < 1e-6:
            continue
        focal = np.sqrt(views.rig.cameras[a].matrix[0, 0] * views.rig.cameras[b].matrix[0, 0])
        errors = [_epipolar_errors(rays[:, :, a], rays[:, :, b], base, windows, int(s)) for s in shifts]
        out[a, b] = shifts, focal * np.stack(errors, axis=1)
    return out


def _epipolar_errors(rays_a: NDArray, rays_b: NDArray, base: NDArray, windows: NDArray, shift: int) -> NDArray:
    """(W,) mean angles [rad] between rays of b at frame + shift and the epipolar planes of a's rays, less the medians.

    NaN with too few rays.
    """
    angle = _angles(rays_a, rays_b, base, windows.ravel(), shift).reshape(*windows.shape, -1)
    apart = np.abs(angle - medians(angle.swapaxes(1, 2))[:, None])
    apart[np.broadcast_to((np.isfinite(apart).sum(axis=1) < MIN_FRAMES)[:, None], apart.shape)] = np.nan
    flat = apart.reshape(len(windows), -1)
    known = np.isfinite(flat)
    total = np.where(known, np.minimum(flat, 3.0 * medians(flat)[:, None]), 0.0).sum(axis=1)
    return np.where(known.any(axis=1), total / np.maximum(known.sum(axis=1), 1), np.nan)


def _angles(rays_a: NDArray, rays_b: NDArray, base: NDArray, frames: NDArray, shift: int) -> NDArray:
    """Angles (N, K) [rad] between rays of b at frames (N,) + shift and a's epipolar planes; NaN where unknown."""
    at = frames + shift
    inside = ((at >= 0) & (at < len(rays_b)))[:, None, None]
    a, b = rays_a[frames], np.where(inside, rays_b[np.clip(at, 0, len(rays_b) - 1)], np.nan)
    normal = np.cross(base / np.linalg.norm(base), a)
    sine = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.sum(np.where(sine > _MIN_SINE, normal / np.maximum(sine, _MIN_SINE), np.nan) * b, axis=-1)


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
