"""Bicubic B-spline patches over any closed net of quadrilaterals (E. Catmull and J. Clark, CAD 10, 1978).

Where four quadrilaterals meet at all corners of a face, the limit is the bicubic B-spline patch of the 4 x 4 control
points around, with continuous second derivatives. At other corners it has a continuous tangent plane (U. Reif, CAGD 12,
1995).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import BodyError


def check_closed(faces: NDArray) -> None:
    """Check that a net of quadrilaterals (Q, 4) is closed and consistently oriented.

    Raises
    ------
    BodyError
        An edge without a twin in the opposite direction.
    """
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    size = int(faces.max()) + 1
    code, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    alone = np.setdiff1d(code, back)
    if len(alone) or len(np.unique(code)) < len(code):
        problem = f"a net of {len(faces)} faces is not closed: {len(alone)} edges have no twin"
        raise BodyError(problem, remedy="Every edge needs two faces that both look outwards.")


def subdivided(values: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Subdivide a closed net (Q, 4) with values (V, K) of its vertices once: values (V', K), faces (4 Q, 4).

    The first V vertices are the old ones; those of faces and then those of edges follow.
    """
    V, Q = len(values), len(faces)
    edges, of = _edges(faces)
    centre = values[faces].mean(axis=1)
    ends = values[edges[:, 0]] + values[edges[:, 1]]
    neighbour_sum = np.zeros_like(ends)
    np.add.at(neighbour_sum, of.ravel(), centre.repeat(4, axis=0))
    n = np.bincount(edges.ravel(), minlength=V)[:, None].astype(float)
    about, middles = np.zeros_like(values), np.zeros_like(values)
    np.add.at(about, faces.ravel(), centre.repeat(4, axis=0))
    np.add.at(middles, edges.ravel(), 0.5 * ends.repeat(2, axis=0))
    corners = (about / n + 2.0 * middles / n + (n - 3.0) * values) / n
    of = V + Q + of
    middle = V + np.arange(Q)
    quads = [np.stack([faces[:, k], of[:, k], middle, of[:, (k + 3) % 4]], axis=1) for k in range(4)]
    return np.concatenate([corners, centre, 0.25 * (ends + neighbour_sum)]), np.concatenate(quads)


def limit(values: NDArray, faces: NDArray) -> NDArray:
    """Limits (V, K) of the vertices of a closed net under infinite subdivision, from values (V, K), faces (Q, 4)."""
    edges, _ = _edges(faces)
    n = np.bincount(edges.ravel(), minlength=len(values))[:, None].astype(float)
    neighbour_sum, across = np.zeros_like(values), np.zeros_like(values)
    np.add.at(neighbour_sum, edges[:, 0], values[edges[:, 1]])
    np.add.at(neighbour_sum, edges[:, 1], values[edges[:, 0]])
    np.add.at(across, faces.ravel(), values[np.roll(faces, 2, axis=1).ravel()])
    return np.asarray((n * n * values + 4.0 * neighbour_sum + across) / (n * (n + 5.0)))


def interpolated(targets: NDArray, faces: NDArray, rounds: int = 2) -> NDArray:
    """Control points (V, 3) [m] whose limits are approximately `targets` (V, 3) [m]: a patch lies inside of them."""
    control = np.array(targets)
    for _ in range(rounds):
        control += targets - limit(control, faces)
    return control


def spread(values: NDArray, faces: NDArray, rounds: int) -> NDArray:
    """Smooth values (V, K): each becomes half itself and half its neighbours' mean, `rounds` times."""
    edges, _ = _edges(faces)
    n = np.bincount(edges.ravel(), minlength=len(values))[:, None]
    for _ in range(rounds):
        neighbour_sum = np.zeros_like(values)
        np.add.at(neighbour_sum, edges[:, 0], values[edges[:, 1]])
        np.add.at(neighbour_sum, edges[:, 1], values[edges[:, 0]])
        values = 0.5 * (values + neighbour_sum / n)
    return values


def _edges(faces: NDArray) -> tuple[NDArray, NDArray]:
    """Edges (E, 2) of faces (Q, 4), and the index (Q, 4) of each face's edge from its corner k to the next."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    edges, of = np.unique(pairs, axis=0, return_inverse=True)
    return edges, of.reshape(faces.shape)
