"""Bicubic B-spline patches over any closed net of quadrilaterals (E. Catmull and J. Clark, CAD 10, 1978).

Wherever four quadrilaterals meet at every corner around, the limit is the bicubic B-spline patch of these 4 x 4 control
points, with continuous second derivatives; where another number meets it has one tangent plane (U. Reif, CAGD 12,
1995).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import BodyError


def check_closed(faces: NDArray) -> None:
    """Refuse a net of quadrilaterals (Q, 4) that is open somewhere, or whose faces do not all face outwards.

    Raises
    ------
    BodyError
        How many edges have no twin that runs the other way.
    """
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    size = int(faces.max()) + 1
    code, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    alone = np.setdiff1d(code, back)
    if len(alone) or len(np.unique(code)) < len(code):
        problem = f"a net of {len(faces)} faces is not closed: {len(alone)} edges have no twin"
        raise BodyError(problem, remedy="Every edge needs two faces that both look outwards.")


def subdivided(values: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Values (V, K) of the vertices of a closed net (Q, 4), and its faces, once subdivided: (V', K), (4 Q, 4).

    The first V vertices remain; then those of faces, then those of edges follow.
    """
    V, Q = len(values), len(faces)
    edges, of = _edges(faces)
    centre = values[faces].mean(axis=1)
    ends = values[edges[:, 0]] + values[edges[:, 1]]
    beside = np.zeros_like(ends)
    np.add.at(beside, of.ravel(), centre.repeat(4, axis=0))
    n = np.bincount(edges.ravel(), minlength=V)[:, None].astype(float)
    about, middles = np.zeros_like(values), np.zeros_like(values)
    np.add.at(about, faces.ravel(), centre.repeat(4, axis=0))
    np.add.at(middles, edges.ravel(), 0.5 * ends.repeat(2, axis=0))
    corners = (about / n + 2.0 * middles / n + (n - 3.0) * values) / n
    of = V + Q + of
    middle = V + np.arange(Q)
    quads = [np.stack([faces[:, k], of[:, k], middle, of[:, (k + 3) % 4]], axis=1) for k in range(4)]
    return np.concatenate([corners, centre, 0.25 * (ends + beside)]), np.concatenate(quads)


def limit(values: NDArray, faces: NDArray) -> NDArray:
    """(V, K) where the vertices of a closed net end up after any number of subdivisions."""
    edges, _ = _edges(faces)
    n = np.bincount(edges.ravel(), minlength=len(values))[:, None].astype(float)
    beside, across = np.zeros_like(values), np.zeros_like(values)
    np.add.at(beside, edges[:, 0], values[edges[:, 1]])
    np.add.at(beside, edges[:, 1], values[edges[:, 0]])
    np.add.at(across, faces.ravel(), values[np.roll(faces, 2, axis=1).ravel()])
    return np.asarray((n * n * values + 4.0 * beside + across) / (n * (n + 5.0)))


def interpolated(targets: NDArray, faces: NDArray, rounds: int = 2) -> NDArray:
    """(V, 3) control points whose limits lie at `targets` (V, 3), nearly: a patch runs inside of its control points."""
    control = np.array(targets)
    for _ in range(rounds):
        control += targets - limit(control, faces)
    return control


def spread(values: NDArray, faces: NDArray, rounds: int) -> NDArray:
    """(V, K) values, each half its own and half its neighbours' mean, so many times."""
    edges, _ = _edges(faces)
    n = np.bincount(edges.ravel(), minlength=len(values))[:, None]
    for _ in range(rounds):
        beside = np.zeros_like(values)
        np.add.at(beside, edges[:, 0], values[edges[:, 1]])
        np.add.at(beside, edges[:, 1], values[edges[:, 0]])
        values = 0.5 * (values + beside / n)
    return values


def _edges(faces: NDArray) -> tuple[NDArray, NDArray]:
    """(E, 2) edges of faces (Q, 4), and the number of each face's edge from its corner k to the next (Q, 4)."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    edges, of = np.unique(pairs, axis=0, return_inverse=True)
    return edges, of.reshape(faces.shape)
