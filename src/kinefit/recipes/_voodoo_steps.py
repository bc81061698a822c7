"""The steps of VooDoo (P2 4.2), each for itself; a limb is a segment, `frames` (S, 12) say where all stand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.bodies.surfaces.nearest import nearest_lines
from kinefit.correspondences.bands import Bands
from kinefit.images.depth import downsample
from kinefit.solvers.limbs import absolute_orientation, move


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


def band_ends(body: Body, frames: NDArray, bands: Bands) -> tuple[NDArray, NDArray]:
    """Both ends (B, 3) [m] of every band, on the parent and on the child."""
    return places(body, frames, bands.parent), places(body, frames, bands.child)


def band_weights(bands: Bands, measured: Pairs, weight: float, least: int | None) -> tuple[NDArray, NDArray]:
    """Step 6: weights (B,) of the bands at the parent and at the child.

    Where `least` is given, all bands of a limb together weigh `weight` times what is measured of it, at least so many
    points; else every band weighs `weight`.
    """
    if least is None:
        every = np.full(len(bands), weight)
        return every, every
    limbs = int(max(bands.parent.segments.max(), bands.child.segments.max(), measured.limb.max(initial=0))) + 1
    total = np.maximum(np.bincount(measured.limb, measured.weight, limbs), least)
    count = np.bincount(bands.parent.segments, minlength=limbs) + np.bincount(bands.child.segments, minlength=limbs)
    each = weight * total / np.maximum(count, 1)
    return each[bands.parent.segments], each[bands.child.segments]


def band_pairs(bands: Bands, ends: tuple[NDArray, NDArray], own: NDArray, other: NDArray) -> tuple[Pairs, Pairs]:
    """Step 6: both ends of every band with its middle, where it pulls them."""
    middle = 0.5 * (ends[0] + ends[1])
    return (
        Pairs(ends[0], middle, own, bands.parent.segments),
        Pairs(ends[1], middle, other, bands.child.segments),
    )


def moved(
    body: Body, frames: NDArray, measured: Pairs, bands: Bands, ends: tuple[NDArray, NDArray], own: NDArray,
    other: NDArray, stay: float,
) -> NDArray:  # fmt: skip
    """Step 7: frames (S, 12) after each limb's own motion, all found at once in the world."""
    pairs = joined(measured, *band_pairs(bands, ends, own, other))
    return move(frames, *absolute_orientation(*pairs, count=len(frames), stay=stay))


def moved_down(
    body: Body, frames: NDArray, measured: Pairs, bands: Bands, ends: tuple[NDArray, NDArray], own: NDArray,
    other: NDArray, stay: float,
) -> NDArray:  # fmt: skip
    """Step 7: frames (S, 12) after each limb's own motion on top of its parent's, from the root on (P2 3.3).

    What hangs on a limb goes with it before its own motion is found, and is pulled to where the parent's joint is now.
    """
    parents, count = body.tree.parents, len(frames)
    level = np.zeros(count, np.int64)
    for s in range(1, count):
        level[s] = level[parents[s]] + 1
    pull, hold = band_pairs(bands, ends, own, other)
    joint = ends[0]
    for k in range(level.max() + 1):
        pairs = joined(measured, pull, hold._replace(target=joint))
        of = level[pairs.limb] == k
        own_pairs = Pairs(*(column[of] for column in pairs))
        R, t = absolute_orientation(*own_pairs, count=count, stay=stay)
        for s in range(1, count):
            if level[s] > k:
                R[s], t[s] = R[parents[s]], t[parents[s]]
        frames = move(frames, R, t)
        measured, pull, hold = (p._replace(source=_along(p.source, R, t, p.limb)) for p in (measured, pull, hold))
        pull = pull._replace(target=_along(pull.target, R, t, pull.limb))  # both of its ends go along
        joint = _along(joint, R, t, bands.parent.segments)
    return frames


def _along(x: NDArray, R: NDArray, t: NDArray, limb: NDArray) -> NDArray:
    return np.einsum("nij,nj->ni", R[limb], x) + t[limb]


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
