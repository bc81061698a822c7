"""The steps of SAPM's match of one segment (P5 3.1), each a small function."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3

MIN_COARSE_POINTS = 6
"""Points of a segment that is matched by the coarse update (P5: "our threshold is 6")."""


@dataclass(frozen=True, eq=False)
class CandidateTable:
    """Candidates of all points of a segment for an assumed match of the pivot (P5 3.1.1).

    Parameters
    ----------
    order : indices of the segment's points, the pivot first, then by distance from it
    columns : for each of `order` the candidates, best first; the pivot has one
    """

    order: NDArray
    columns: list[NDArray]

    @property
    def size(self) -> int:
        """Number of candidates."""
        return sum(len(c) for c in self.columns)

    @property
    def filled(self) -> int:
        """Number of columns with candidates."""
        return sum(len(c) > 0 for c in self.columns)


def mean_distance(x: NDArray) -> float:
    """Mean distance l [m] between the points (k, 3) [m] of a segment; at least (2, 3)."""
    i, j = np.triu_indices(len(x), 1)
    return float(np.linalg.norm(x[i] - x[j], axis=-1).mean())


def candidate_table(
    x: NDArray, points: NDArray, free: NDArray, pivot: int, place: NDArray, match: int, epsilon: float
) -> CandidateTable:
    """Candidates by (4): points whose distance from the assumed pivot differs from the model's by less than 2ε.

    Parameters
    ----------
    x : (k, 3) [m] the segment, or (k + 1, 3) with its virtual joint as the last
    points : (N, 3) [m]
    free : (N,) bool, not identified yet
    pivot : int, index in x
    place : (3,) [m] position of the pivot's assumed match, which is the point `match` (-1: a virtual joint)
    epsilon : float, ε as a share of the distance
    """
    D = np.linalg.norm(x - x[pivot], axis=1)
    order = np.argsort(D, kind="stable")
    order = np.concatenate([[pivot], order[order != pivot]])
    d = np.linalg.norm(points - place, axis=1)
    columns = [np.array([match])]
    for i in order[1:]:
        ratio = np.abs(d - D[i]) / max(D[i], 1e-9)
        ok = np.flatnonzero((ratio < 2 * epsilon) & free & (np.arange(len(points)) != match))
        columns.append(ok[np.argsort(ratio[ok])])
    return CandidateTable(order, columns)


def errors(x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Errors (N,) [m] of points x (N, 3) against y (N, 3) under the best motion T (4, 4) by SVD, (1) (Arun et al.)."""
    T = se3.aligned(x, y)
    return np.linalg.norm(y - se3.apply(T, x), axis=1), T


def coarse_updates(table: CandidateTable, x: NDArray, at: NDArray, limit: float) -> Iterator[NDArray]:
    """First update rule: start with all first candidates, and replace the worst match by its next. Yields motions.

    Parameters
    ----------
    at : (N + 1, 3) [m] points, the last one the pivot's position
    limit : float [m], ε l, bound of the mean error
    """
    heads = [0] * len(table.columns)
    while True:
        rows = [j for j, c in enumerate(table.columns) if heads[j] < len(c)]
        if len(rows) < 3:
            return
        chosen = np.array([table.columns[j][heads[j]] for j in rows])
        e, T = errors(x[table.order[rows]], at[chosen])
        if e.mean() < limit:
            yield T
        moved = [k for k, j in enumerate(rows) if j > 0]
        heads[rows[max(moved, key=lambda k: e[k])]] += 1


def triples(table: CandidateTable, x: NDArray, at: NDArray, limit: float) -> Iterator[NDArray]:
    """Second update rule: the pivot with its nearest and its farthest neighbours, then the next. Yields motions (4, 4).

    For a point pair, or if only one neighbour has candidates, each of these with the pivot: the rotation about the pair
    is undetermined, and the children's matches confirm the motion (P5 3.2). at (N + 1, 3) [m], limit [m]: see
    `coarse_updates`.
    """
    filled = [j for j in range(1, len(table.columns)) if len(table.columns[j])]
    if len(filled) == 1:
        for other in table.columns[filled[0]]:
            e, T = errors(x[table.order[[0, filled[0]]]], at[[table.columns[0][0], other]])
            if e.mean() < limit:
                yield T
    pairs = [(i, j) for i in filled for j in reversed(filled) if i < j]
    for i, j in pairs:
        for near, far in product(table.columns[i], table.columns[j]):
            if near != far:
                e, T = errors(x[table.order[[0, i, j]]], at[[table.columns[0][0], near, far]])
                if e.mean() < limit:
                    yield T


def nearest(x: NDArray, T: NDArray, points: NDArray, free: NDArray, limit: float) -> NDArray:
    """Closest free point (k,) of each moved model point within 2 l ε = `limit` [m], (5); -1 for none."""
    d = np.linalg.norm(se3.apply(T, x)[:, None] - points, axis=-1)
    d[:, ~free] = np.inf
    found = d.argmin(1)
    own = d[np.arange(len(x)), found]
    found[own >= limit] = -1
    for i in np.argsort(own):  # a point is matched once: to the closest
        if found[i] >= 0 and any(found[j] == found[i] and (own[j], j) < (own[i], i) for j in range(len(x))):
            found[i] = -1
    return found
