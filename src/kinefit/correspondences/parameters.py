"""Rows on the degrees of freedom: soft limits, a prior posture, a predicted pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies import Body, BodyState
from kinefit.correspondences import targets
from kinefit.rows import ParameterRows


def limit_rows(body: Body, state: BodyState, *, sigma: float = 0.02) -> ParameterRows:
    """One row for each coordinate outside its range, towards the nearer limit. The solvers have hard limits.

    Parameters
    ----------
    sigma : float [rad or m]
        Standard deviation of a violation.
    """
    inside = np.clip(state.angles, body.tree.lower, body.tree.upper)
    violated = np.flatnonzero(inside != state.angles)
    w = targets.weights(sigma, np.ones(len(inside), bool), "limits")
    return ParameterRows(6 + violated, (inside - state.angles)[violated], w[violated])


def prior_rows(
    body: Body, state: BodyState, *, mean: ArrayLike | None = None, sigma: ArrayLike | None = None
) -> ParameterRows:
    """One row for each coordinate, towards a mean posture; with a full weight matrix if the body's prior has couplings.

    Parameters
    ----------
    mean : scalar or (D,) [rad or m]
        Default: the mean of the body's posture prior.
    sigma : scalar or (D,) [rad or m]
        Standard deviations, inf for a coordinate without prior; default: the body's posture prior with its couplings.
    """
    tree, count = body.tree, len(body.tree.coordinates)
    if mean is None and sigma is None:
        constrained, precision = tree.held_by_posture
        return ParameterRows(6 + constrained, (tree.usual - state.angles)[constrained], precision)
    w = targets.weights(tree.spread if sigma is None else sigma, np.ones(count, bool), "priors")
    constrained = np.flatnonzero(w > 0.0)
    gap = np.broadcast_to(np.asarray(tree.usual if mean is None else mean, float), count) - state.angles
    joint = sigma is None and tree.coupled
    return ParameterRows(6 + constrained, gap[constrained], tree.held_by_posture[1] if joint else w[constrained])


def prediction_rows(body: Body, state: BodyState, predicted: BodyState, *, sigma: NDArray) -> ParameterRows:
    """One row for each degree of freedom, towards a predicted state.

    For the root's rotation r ≈ δ holds to first order in r. Their sum of squares is exact if the three sigmas are
    equal.

    Parameters
    ----------
    predicted : BodyState
    sigma : (6 + D,) [m, rad]
        Standard deviation of the prediction; inf for a degree of freedom without prediction.
    """
    sigma = shaped(sigma, (body.tree.n_dofs,), "sigma of a prediction")
    w = targets.weights(sigma, np.ones(len(sigma), bool), "predictions")
    constrained = np.flatnonzero(w > 0.0)
    return ParameterRows(constrained, state.difference(predicted)[constrained], w[constrained])
