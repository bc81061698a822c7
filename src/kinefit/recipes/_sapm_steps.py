"""The steps of SAPM's match of one segment (P5 3.1), each a small function."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.se3 import nearest_rotation

MANY = 6
"""Points from which a segment is matched by the coarse update (P5: "our threshold is 6")."""


@dataclass(frozen=True, eq=False)
class CandidateTable:
    """P5 3.1.1: for an assumed match of the pivot, candidates of all other points of the segment.

    Parameters
    ----------
    order : indexes of the segment's points, the pivot first, then by distance from it
    columns : for each of `order` the candidates, best first; the pivot has one
    """

    order: NDArray
    columns: list[NDArray]

    @property
    def size(self) -> int:
        """Candidates in all."""
        return sum(len(c) for c in self.columns)

    @property
    def filled(self) -> int:
        """Columns that have any."""
        return sum(len(c) > 0 for c in self.columns)


def mean_distance(x: NDArray) -> float:
    """l of a segment [m]: the mean distance of its points."""
    i, j = np.triu_indices(len(x), 1)
    return float(np.linalg.norm(x[i] - x[j], axis=-1).mean())


def candidate_table(
    x: NDArray, points: NDArray, free: NDArray, pivot: int, place: NDArray, match: int, epsilon: float
) -> CandidateTable:
    """(4): points whose distance from the assumed pivot differs by less than 2ε of the model's, best first.

    Parameters
    ----------
    x : (k, 3) the segment, or (k + 1, 3) with its virtual joint as the last
    free : (N,) bool, not identified yet
    place : (3,) [m] of the pivot's assumed match, which is the point `match` (-1: a virtual joint)
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


def motion(x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """(1): the rotation and translation of x onto y by SVD (Arun et al.)."""
    a, b = x.mean(0), y.mean(0)
    R = nearest_rotation((y - b).T @ (x - a))
    return R, b - R @ a


def errors(x: NDArray, y: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """(n,) [m] of each point under the motion that fits all; R, t."""
    R, t = motion(x, y)
    return np.linalg.norm(y - x @ R.T - t, axis=1), R, t


def coarse_updates(table: CandidateTable, x: NDArray, at: NDArray, limit: float) -> Iterator[tuple[NDArray, NDArray]]:
    """First update rule: heads of all columns; the worst match is replaced by its next candidate. Yields motions.

    Parameters
    ----------
    at : (N + 1, 3) [m] points, the last the pivot's place
    limit : ε l [m] that the mean error stays below
    """
    heads = [0] * len(table.columns)
    while True:
        rows = [j for j, c in enumerate(table.columns) if heads[j] < len(c)]
        if len(rows) < 3:
            return
        chosen = np.array([table.columns[j][heads[j]] for j in rows])
        e, R, t = errors(x[table.order[rows]], at[chosen])
        if e.mean() < limit:
            yield R, t
        moved = [k for k, j in enumerate(rows) if j > 0]
        heads[rows[max(moved, key=lambda k: e[k])]] += 1


def triples(table: CandidateTable, x: NDArray, at: NDArray, limit: float) -> Iterator[tuple[NDArray, NDArray]]:
    """Second update rule: the pivot with its nearest and its furthest neighbours, then the next. Yields motions.

    Of a point pair, or where only one neighbour has candidates, each of these with the pivot: its motion is known but
    for a turn about the pair, and whether it is right the children's matches say (P5 3.2).
    """
    filled = [j for j in range(1, len(table.columns)) if len(table.columns[j])]
    if len(filled) == 1:
        for other in table.columns[filled[0]]:
            e, R, t = errors(x[table.order[[0, filled[0]]]], at[[table.columns[0][0], other]])
            if e.mean() < limit:
                yield R, t
    pairs = [(i, j) for i in filled for j in reversed(filled) if i < j]
    for i, j in pairs:
        for near, far in product(table.columns[i], table.columns[j]):
            if near != far:
                e, R, t = errors(x[table.order[[0, i, j]]], at[[table.columns[0][0], near, far]])
                if e.mean() < limit:
                    yield R, t


def nearest(x: NDArray, R: NDArray, t: NDArray, points: NDArray, free: NDArray, limit: float) -> NDArray:
    """(5): (k,) the closest free point of each moved model point within 2 l ε = `limit` [m], -1 where lost."""
    d = np.linalg.norm((x @ R.T + t)[:, None] - points, axis=-1)
    d[:, ~free] = np.inf
    found = d.argmin(1)
    own = d[np.arange(len(x)), found]
    found[own >= limit] = -1
    for i in np.argsort(own):  # a point is matched once: to the closest
        if found[i] >= 0 and any(found[j] == found[i] and (own[j], j) < (own[i], i) for j in range(len(x))):
            found[i] = -1
    return found
