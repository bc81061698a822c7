"""The steps of VooDoo (P2 4.2), each for itself; a limb is a segment, `frames` (S, 12) say where all stand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.surfaces.closest.nearest import nearest_lines
from kinefit.images.depth import downsample


class Pairs(NamedTuple):
    """Pairs of a point of a limb and where it should be: `source`, `target` (N, 3) [m], `weight`, `limb` (N,)."""

    source: NDArray
    target: NDArray
    weight: NDArray
    limb: NDArray


def fewer(member: NDArray, *, factor: float, minimum: int, maximum: int) -> tuple[NDArray, NDArray]:
    """Step 3: point (M,) and limb (M,) of what is left of candidates (N, S), limb by limb."""
    kept = [downsample(np.flatnonzero(m), factor=factor, minimum=minimum, maximum=maximum) for m in member.T]
    return np.concatenate(kept), np.repeat(np.arange(member.shape[1]), [len(k) for k in kept])


def closest_points(body: Body, frames: NDArray, x: NDArray, weight: NDArray, limb: NDArray, bound: float) -> Pairs:
    """Step 4: each point with the nearest one of its limb's surface, where that is within the bound [m]."""
    lines = np.ascontiguousarray(x.T)
    distance, normal, owner = nearest_lines(body, frames, lines, bound, limb)
    found = owner >= 0
    source = (lines - distance * normal).T
    return Pairs(source[found], x[found], weight[found], owner[found])


def points_on_lines(body: Body, frames: NDArray, points: PointSet, lines: NDArray, weight: NDArray) -> Pairs:
    """Step 5: points of the body with the nearest ones on their Plücker lines (K, 6); lines that are NaN are none."""
    seen = np.isfinite(lines).all(axis=1)
    x = places(body, frames, points)[seen]
    n, m = lines[seen, :3], lines[seen, 3:]
    target = np.cross(n, m) + np.sum(x * n, axis=1, keepdims=True) * n
    return Pairs(x, target, weight[seen], points.segments[seen])


def points_on_points(body: Body, frames: NDArray, points: PointSet, x: NDArray, weight: NDArray) -> Pairs:
    """Points of the body with where they were measured (K, 3); NaN for none."""
    seen = np.isfinite(x).all(axis=1)
    return Pairs(places(body, frames, points)[seen], x[seen], weight[seen], points.segments[seen])


def nearest_limb(body: Body, frames: NDArray, x: NDArray, bound: float) -> NDArray:
    """(N, S) bool, the limb whose surface is nearest to each point, within the bound [m]."""
    _, _, owner = nearest_lines(body, frames, np.ascontiguousarray(x.T), bound)
    member = np.zeros((len(x), len(frames)), bool)
    member[owner >= 0, owner[owner >= 0]] = True
    return member


def places(body: Body, frames: NDArray, points: PointSet) -> NDArray:
    """(K, 3) [m] points of the body in the world."""
    f = frames[points.segments]
    return (f[:, :9].reshape(-1, 3, 3) @ body.points_rest(points)[:, :, None])[..., 0] + f[:, 9:]


def joined(*parts: Pairs) -> Pairs:
    """All pairs of several steps."""
    return Pairs(*(np.concatenate(columns) for columns in zip(*parts)))


def quality(pairs: Pairs) -> float:
    """Step 7: mean squared distance [m²] of all pairs, by their weights (P2 eq. 1)."""
    total = float(pairs.weight.sum())
    if total <= 0.0:
        return 0.0
    return float(pairs.weight @ np.sum((pairs.source - pairs.target) ** 2, axis=1)) / total
