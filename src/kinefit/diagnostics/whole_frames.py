"""Time offsets between two cameras in whole frames: the shift with the smallest distance between the rays."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import KeypointViews

Curve = tuple[NDArray, NDArray]
"""Shifts (S,) [frames] and their costs (S,) [px]."""

_MAX_OFFSET = 2.0  # [s] that is searched; cameras started by hand differ by less, or by much more
_MAX_POINTS = 12  # of the body, those with most motion
_MAX_FRAMES = 400  # of the first camera, for the cost of a shift
_MAX_COST_RATIO = 0.9  # of a shift to no shift: one that fits no better counts as none
_MAX_WEIGHT = 2.0  # of a pair's shift: one pair with a periodic motion must not outvote the others
MIN_DEPTH = 1.4
"""Ratio of the median cost to the smallest one: noise alone gives 1.1, a waving hand 1.8."""
_MIN_SINE = 0.15  # of the angle between ray and baseline: below, the ray is not informative
MIN_FRAMES = 12
"""Smallest number of frames from which a shift is estimated."""


def pair_curves(views: KeypointViews) -> dict[tuple[int, int], Curve]:
    """Cost curves {(a, b): (shifts [frames], cost [px])}: distance of rays of b, at each shift, from those of a."""
    reach = int(min(_MAX_OFFSET * views.rate, 0.4 * len(views)))
    shifts = np.arange(-reach, reach + 1)
    steps = np.diff(views.uv, axis=0)
    motion = np.nanmedian(np.where(np.isfinite(steps), np.abs(steps), 0.0).sum(-1), axis=0).sum(-1)
    points = np.argsort(-motion)[:_MAX_POINTS]
    rays = np.stack([camera.ray(views.uv[:, points, c]) for c, camera in enumerate(views.rig)], axis=2)
    frames = np.unique(np.linspace(0, len(views) - 1, _MAX_FRAMES).astype(int))
    out = {}
    for a, b in combinations(range(len(views.rig)), 2):
        base = views.rig.cameras[b].centre_world - views.rig.cameras[a].centre_world
        if np.linalg.norm(base) < 1e-6:
            continue
        focal = np.sqrt(views.rig.cameras[a].matrix[0, 0] * views.rig.cameras[b].matrix[0, 0])
        cost = np.array([_epipolar_error(rays[:, :, a], rays[:, :, b], base, frames, int(s)) for s in shifts])
        if np.isfinite(cost).sum() >= 3:
            out[a, b] = shifts, focal * cost
    return out


def _epipolar_error(rays_a: NDArray, rays_b: NDArray, base: NDArray, frames: NDArray, shift: int) -> float:
    """Mean angle [rad] between rays of b at frame + shift and the epipolar planes of a's rays, without constant parts.

    NaN with too few rays.
    """
    frames = frames[(frames + shift >= 0) & (frames + shift < len(rays_b))]
    if len(frames) < MIN_FRAMES:
        return np.nan
    a, b = rays_a[frames], rays_b[frames + shift]
    normal = np.cross(base / np.linalg.norm(base), a)
    sine = np.linalg.norm(normal, axis=-1, keepdims=True)
    angle = np.sum(np.where(sine > _MIN_SINE, normal / np.maximum(sine, _MIN_SINE), np.nan) * b, axis=-1)
    finite = np.isfinite(angle)
    enough = finite.sum(axis=0) >= MIN_FRAMES
    if not enough.any():
        return np.nan
    angle = angle[:, enough]
    apart = np.abs(angle - median_over_time(angle))
    return float(np.nanmean(np.minimum(apart, 3.0 * np.nanmedian(apart))))


def median_over_time(values: NDArray) -> NDArray:
    """Medians (K,) over time of the finite values (F, K); NaN where there are none. Any trailing axes."""
    ranked, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)
    middle = [np.take_along_axis(ranked, np.maximum(at, 0)[None], axis=0)[0] for at in ((count - 1) // 2, count // 2)]
    return np.where(count > 0, 0.5 * (middle[0] + middle[1]), np.nan)


def best_shift(shifts: NDArray, cost: NDArray) -> tuple[float, float]:
    """Shift [frames] of smallest cost, and its weight, from a curve (S,), (S,); 0 if no other fits clearly better."""
    cost = np.where(np.isfinite(cost), cost, np.inf)
    at, zero = int(np.argmin(cost)), int(np.flatnonzero(shifts == 0)[0])
    if cost[at] > _MAX_COST_RATIO * cost[zero]:  # a periodic motion fits as well a step later: the nearest wins
        at = zero
    return float(shifts[at]), min(depth(cost) - 1.0, _MAX_WEIGHT)


def depth(cost: NDArray) -> float:
    """Ratio of the median to the smallest cost (S,); a number, 1 without motion."""
    cost = cost[np.isfinite(cost)]
    return float(np.median(cost) / max(cost.min(), 1e-12)) if len(cost) else 1.0


def from_pairs(cameras: int, pairs: dict[tuple[int, int], tuple[float, float]]) -> NDArray:
    """Delays (C,) [frames] whose differences fit the pairs' shifts with the least weighted absolute error."""
    delays = np.zeros(cameras)
    weight = {pair: w for pair, (_, w) in pairs.items()}
    for _ in range(30):  # iteratively reweighted least squares
        matrix, right = np.full((cameras, cameras), 1e-9), np.zeros(cameras)
        for (a, b), (shift, _) in pairs.items():  # b shows later what a shows: b began earlier
            row = np.zeros(cameras)
            row[a], row[b] = 1.0, -1.0
            matrix += weight[a, b] * np.outer(row, row)
            right += weight[a, b] * shift * row
        delays = np.linalg.lstsq(matrix, right, rcond=None)[0]
        weight = {(a, b): w / max(abs(delays[a] - delays[b] - shift), 0.05) for (a, b), (shift, w) in pairs.items()}
    return np.round(delays - np.median(delays))
