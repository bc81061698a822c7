"""Time offsets between two cameras in whole frames: the shift at which the rays of each point meet best."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import KeypointViews

Curve = tuple[NDArray, NDArray]
"""Shifts (S,) [frames] and their costs (S,) [px]."""

_REACH = 2.0  # [s] farthest offset that is looked for; cameras started by hand differ by less, or by much more
_POINTS = 12  # of the body, those that move most
_ROWS = 400  # frames of the first camera that a shift is judged by
_CLEAR = 0.9  # of the cost with no shift: a shift that fits no better than this is none
_MAX_WEIGHT = 2.0  # of a pair's shift: one pair that is deceived by a periodic motion must not outvote the others
VALLEY = 1.4
"""Times the least cost that the usual shift must cost: noise alone gives 1.1, a waving hand 1.8."""
_PARALLEL = 0.15  # sine of the angle to the line of both cameras below which a ray tells nothing
MIN_FRAMES = 12
"""Frames from which a shift can be told."""


def pair_curves(views: KeypointViews) -> dict[tuple[int, int], Curve]:
    """{(a, b): (shifts [frames], cost [px])}: how far rays of b, so many frames later, pass those of a."""
    reach = int(min(_REACH * views.rate, 0.4 * len(views)))
    shifts = np.arange(-reach, reach + 1)
    steps = np.diff(views.uv, axis=0)
    motion = np.nanmedian(np.where(np.isfinite(steps), np.abs(steps), 0.0).sum(-1), axis=0).sum(-1)
    points = np.argsort(-motion)[:_POINTS]
    rays = np.stack([camera.ray(views.uv[:, points, c]) for c, camera in enumerate(views.rig)], axis=2)
    frames = np.unique(np.linspace(0, len(views) - 1, _ROWS).astype(int))
    out = {}
    for a, b in combinations(range(len(views.rig)), 2):
        base = views.rig.cameras[b].centre_world - views.rig.cameras[a].centre_world
        if np.linalg.norm(base) < 1e-6:
            continue
        focal = np.sqrt(views.rig.cameras[a].matrix[0, 0] * views.rig.cameras[b].matrix[0, 0])
        cost = np.array([_miss(rays[:, :, a], rays[:, :, b], base, frames, int(s)) for s in shifts])
        if np.isfinite(cost).sum() >= 3:
            out[a, b] = shifts, focal * cost
    return out


def _miss(rays_a: NDArray, rays_b: NDArray, base: NDArray, frames: NDArray, shift: int) -> float:
    """Mean angle [rad] by which rays of b at frame + shift leave the planes of a's rays, constants taken out.

    NaN where too few are seen.
    """
    frames = frames[(frames + shift >= 0) & (frames + shift < len(rays_b))]
    if len(frames) < MIN_FRAMES:
        return np.nan
    a, b = rays_a[frames], rays_b[frames + shift]
    normal = np.cross(base / np.linalg.norm(base), a)
    sine = np.linalg.norm(normal, axis=-1, keepdims=True)
    angle = np.sum(np.where(sine > _PARALLEL, normal / np.maximum(sine, _PARALLEL), np.nan) * b, axis=-1)
    seen = np.isfinite(angle)
    enough = seen.sum(axis=0) >= MIN_FRAMES
    if not enough.any():
        return np.nan
    angle = angle[:, enough]
    apart = np.abs(angle - median_over_time(angle))
    return float(np.nanmean(np.minimum(apart, 3.0 * np.nanmedian(apart))))


def median_over_time(values: NDArray) -> NDArray:
    """Medians (...) over the first axis of what is finite of values (F, ...); NaN where nothing is."""
    ranked, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)
    middle = [np.take_along_axis(ranked, np.maximum(at, 0)[None], axis=0)[0] for at in ((count - 1) // 2, count // 2)]
    return np.where(count > 0, 0.5 * (middle[0] + middle[1]), np.nan)


def best_shift(shifts: NDArray, cost: NDArray) -> tuple[float, float]:
    """Shift [frames] of least cost, 0 where no other fits clearly better; and its weight."""
    cost = np.where(np.isfinite(cost), cost, np.inf)
    at, zero = int(np.argmin(cost)), int(np.flatnonzero(shifts == 0)[0])
    if cost[at] > _CLEAR * cost[zero]:  # a periodic motion fits as well a step later: the nearest wins
        at = zero
    return float(shifts[at]), min(depth(cost) - 1.0, _MAX_WEIGHT)


def depth(cost: NDArray) -> float:
    """How many times less the best shift costs than the usual one: 1 where there is no motion."""
    cost = cost[np.isfinite(cost)]
    return float(np.median(cost) / max(cost.min(), 1e-12)) if len(cost) else 1.0


def from_pairs(cameras: int, pairs: dict[tuple[int, int], tuple[float, float]]) -> NDArray:
    """(C,) delays [frames] of which the pairs' shifts are differences, by least weighted absolute error."""
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
