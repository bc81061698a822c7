"""The steps of VooDoo (P2 4.2) as single functions; a limb is a segment, `frames` (S, 12) are their poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.surfaces.places import nearest_lines
from kinefit.images.depth import downsample


class Pairs(NamedTuple):
    """Pairs of a limb's point and its target: `source`, `target` (N, 3) [m], `weight`, `limb` (N,)."""

    source: NDArray
    target: NDArray
    weight: NDArray
    limb: NDArray


class LimbFit(NamedTuple):
    """Result of one frame: frames (S, 12) of the limbs, the mean squared distance [m²], and the number of steps."""

    frames: NDArray
    quality: float
    steps: int


def fewer(member: NDArray, *, factor: float, minimum: int, maximum: int) -> tuple[NDArray, NDArray]:
    """Step 3: downsample candidates (N, S) bool for each limb: point (M,) and limb (M,) of those kept."""
    kept = [downsample(np.flatnonzero(m), factor=factor, minimum=minimum, maximum=maximum) for m in member.T]
    return np.concatenate(kept), np.repeat(np.arange(member.shape[1]), [len(k) for k in kept])


def closest_points(body: Body, frames: NDArray, x: NDArray, weight: NDArray, limb: NDArray, bound: float) -> Pairs:
    """Step 4: pair each point x (N, 3) [m] with the nearest one of its limb's surface, within the bound [m]."""
    lines = np.ascontiguousarray(x.T)
    distance, normal, owner = nearest_lines(body, frames, lines, bound, limb)
    found = owner >= 0
    source = (lines - distance * normal).T
    return Pairs(source[found], x[found], weight[found], owner[found])


def points_on_lines(body: Body, frames: NDArray, points: PointSet, lines: NDArray, weight: NDArray) -> Pairs:
    """Step 5: pair points of the body with the nearest points on their Plücker lines (K, 6); NaN for none."""
    known = np.isfinite(lines).all(axis=1)
    x = places(body, frames, points)[known]
    n, m = lines[known, :3], lines[known, 3:]
    target = np.cross(n, m) + np.sum(x * n, axis=1, keepdims=True) * n
    return Pairs(x, target, weight[known], points.segments[known])


def points_on_points(body: Body, frames: NDArray, points: PointSet, x: NDArray, weight: NDArray) -> Pairs:
    """Pair points of the body with their measured positions x (K, 3) [m]; NaN for none."""
    known = np.isfinite(x).all(axis=1)
    return Pairs(places(body, frames, points)[known], x[known], weight[known], points.segments[known])


def nearest_limb(body: Body, frames: NDArray, x: NDArray, bound: float) -> NDArray:
    """Limb (N, S) bool with the nearest surface to each point x (N, 3) [m], within the bound [m]."""
    _, _, owner = nearest_lines(body, frames, np.ascontiguousarray(x.T), bound)
    member = np.zeros((len(x), len(frames)), bool)
    member[owner >= 0, owner[owner >= 0]] = True
    return member


def places(body: Body, frames: NDArray, points: PointSet) -> NDArray:
    """Points (K, 3) [m] of the body in the world."""
    f = frames[points.segments]
    return (f[:, :9].reshape(-1, 3, 3) @ body.points_rest(points)[:, :, None])[..., 0] + f[:, 9:]


def joined(*parts: Pairs) -> Pairs:
    """Concatenate the pairs of several steps."""
    return Pairs(*(np.concatenate(columns) for columns in zip(*parts)))


def quality(pairs: Pairs) -> float:
    """Step 7: weighted mean squared distance [m²] of all pairs (P2 eq. 1)."""
    total = float(pairs.weight.sum())
    if total <= 0.0:
        return 0.0
    return float(pairs.weight @ np.sum((pairs.source - pairs.target) ** 2, axis=1)) / total
