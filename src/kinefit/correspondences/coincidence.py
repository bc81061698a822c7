"""Coincidence of two points of the body: closed chains, contacts, elastic bands (P3 4, P2 2.2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import targets
from kinefit.errors import ObservationError
from kinefit.rows import PairRows


def coincidence_rows(
    body: Body, state: BodyState, points_a: PointSet, points_b: PointSet, *, sigma: ArrayLike = 0.001
) -> PairRows:
    """Three pair rows for each pair of points that should coincide: r = x_b − x_a along the world's axes.

    Parameters
    ----------
    points_a, points_b : PointSet of K points each, on different segments.
    sigma : scalar or (K,) [m]
        Standard deviation of the gap; a small one makes a closed chain.

    Raises
    ------
    ObservationError
        Different numbers of points, or a sigma that is not positive.
    """
    if len(points_a) != len(points_b):
        problem = f"{len(points_a)} points should meet {len(points_b)}"
        raise ObservationError(problem, remedy="Give equal numbers of points.")
    a, b = body.positions(state, points_a), body.positions(state, points_b)
    n = np.tile(np.eye(3), (len(a), 1))
    w = np.repeat(targets.weights(sigma, np.ones(len(a), bool), "coincidences"), 3)
    pairs = np.repeat(np.stack([points_a.segments, points_b.segments], axis=1), 3, axis=0)
    gap = (b - a).reshape(-1)
    return PairRows(pairs, np.repeat(a, 3, axis=0), np.repeat(b, 3, axis=0), n, gap, w)
