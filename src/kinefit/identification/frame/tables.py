"""A marker model as the search wants it: per segment places, distances, deviations, what is shared, joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.identification.model.model import MarkerModel

FINEST = 1e-3
"""[m] least standard deviation of a marker's coordinate in its segment: below it, training was too short to tell."""


OTHER_MOTIONS = 0.7
"""Deviation that no training shows, as a share of the catalogue's usual one: skin moves otherwise in other motions."""

BEYOND, BEYOND_SHARE = 0.03, 0.15
"""Distances across a joint go beyond those of training by this [m], and this share of their range."""


@dataclass(frozen=True, eq=False)
class SegmentTable:
    """One segment, seen from the root that was chosen.

    Parameters
    ----------
    index, parent : of the segment, parent -1 for the root
    children : indexes
    markers : (k,) int
    x : (k, 3) [m] reference positions; D : (k, k) [m] their distances
    sigma : (k,) [m] standard deviation of each coordinate
    shared : for each marker its place in the parent's `markers`, or -1; common : the markers that have one
    joint_here, joint_there : (3,) [m] in this segment's and the parent's reference; None for the root
    spread : [m] per coordinate
    """

    index: int
    parent: int
    children: tuple[int, ...]
    markers: NDArray
    x: NDArray
    D: NDArray
    sigma: NDArray
    shared: NDArray
    common: NDArray
    joint_here: NDArray | None
    joint_there: NDArray | None
    spread: float
    low: NDArray
    high: NDArray
    width: NDArray


@lru_cache(maxsize=64)
def segment_tables(model: MarkerModel, root: int) -> tuple[SegmentTable, ...]:
    """The model's segments, parents first, hung from any of them as the root."""
    links: dict[int, list[tuple[int, NDArray, NDArray, float, bool]]] = {s: [] for s in range(len(model.segments))}
    for j in model.joints:
        above, below, learnt = np.asarray(j.in_parent, float), np.asarray(j.in_child, float), j.exercised > 0
        links[j.parent].append((j.child, below, above, j.spread, learnt))
        links[j.child].append((j.parent, above, below, j.spread, learnt))
    found: list[SegmentTable] = []
    trained = any(j.exercised > 0 for j in model.joints)  # else deviations are guesses, for any motion
    todo: list[tuple[int, int, NDArray | None, NDArray | None, float, bool]] = [(root, -1, None, None, 0.0, False)]
    while todo:
        s, parent, here, there, spread, learnt = todo.pop(0)
        children = [link for link in links[s] if link[0] != parent]
        todo += [(link[0], s, link[1], link[2], link[3], link[4]) for link in children]
        markers = np.array(model.segments[s], np.int64)
        x = np.ascontiguousarray(np.asarray(model.reference, float)[markers])
        theirs = list(model.segments[parent]) if parent >= 0 else []
        shared = np.array([theirs.index(m) if m in theirs else -1 for m in markers], np.int64)
        pairs = np.ix_(np.array(theirs, np.int64), markers)
        low, high = model.low[pairs], model.high[pairs]
        width = (BEYOND + BEYOND_SHARE * (high - low)) * (learnt and np.isfinite(high - low))
        own = deviations(model.deviation[np.ix_(markers, markers)])
        D = np.linalg.norm(x[:, None] - x, axis=-1)
        found.append(
            SegmentTable(
                s, parent, tuple(link[0] for link in children), markers, x, D,
                np.hypot(own, unseen(D) * trained), shared, np.flatnonzero(shared >= 0), here, there, spread,
                np.nan_to_num(low), np.nan_to_num(high), np.nan_to_num(width),
            )
        )  # fmt: skip
    return tuple(found)


def unseen(D: NDArray) -> NDArray:
    """(k,) [m] what motions other than those of training add to each coordinate's deviation."""
    mean = D.sum(1) / max(len(D) - 1, 1)
    return OTHER_MOTIONS * (0.004 + 0.03 * mean) / np.sqrt(2.0)


def deviations(deviation: NDArray) -> NDArray:
    """(k,) [m] standard deviations of each marker's coordinates from those of distances: d_ij² ≈ s_i² + s_j²."""
    k = len(deviation)
    if k < 2:
        return np.full(k, 0.01)
    square = np.where(np.isfinite(deviation), deviation, np.nanmedian(deviation)) ** 2
    np.fill_diagonal(square, 0.0)
    total = square.sum() / (2 * (k - 1))
    mean = total / k
    own = (square.sum(1) - total) / (k - 2) if k > 2 else np.full(k, mean)
    return np.sqrt(np.maximum(own, max(0.25 * mean, FINEST**2)))
