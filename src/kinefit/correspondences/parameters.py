"""Rows on the degrees of freedom: soft limits, a prior posture, a predicted pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies import Body, BodyState
from kinefit.correspondences import targets
from kinefit.rows import ParameterRows


def limit_rows(body: Body, state: BodyState, *, sigma: float = 0.02) -> ParameterRows:
    """One row for each coordinate outside its range, back to the nearer end. For limits that hold see the solver.

    Parameters
    ----------
    sigma : float [rad or m]
        Softness of a limit.
    """
    inside = np.clip(state.angles, body.tree.lower, body.tree.upper)
    beyond = np.flatnonzero(inside != state.angles)
    w = targets.weights(sigma, np.ones(len(inside), bool), "limits")
    return ParameterRows(6 + beyond, (inside - state.angles)[beyond], w[beyond])


def prior_rows(
    body: Body, state: BodyState, *, mean: ArrayLike | None = None, sigma: ArrayLike | None = None
) -> ParameterRows:
    """One row for each coordinate, towards a mean posture; weighed together where the body's prior couples them.

    Parameters
    ----------
    mean : scalar or (D,) [rad or m]
        Default: the body's usual posture.
    sigma : scalar or (D,) [rad or m]
        Spread of the posture, inf for a coordinate without prior; default: the body's posture prior, couplings and all.
    """
    tree, count = body.tree, len(body.tree.coordinates)
    if mean is None and sigma is None:
        held, precision = tree.held_by_posture
        return ParameterRows(6 + held, (tree.usual - state.angles)[held], precision)
    w = targets.weights(tree.spread if sigma is None else sigma, np.ones(count, bool), "priors")
    held = np.flatnonzero(w > 0.0)
    gap = np.broadcast_to(np.asarray(tree.usual if mean is None else mean, float), count) - state.angles
    joint = sigma is None and tree.coupled
    return ParameterRows(6 + held, gap[held], tree.held_by_posture[1] if joint else w[held])


def prediction_rows(body: Body, state: BodyState, predicted: BodyState, *, sigma: NDArray) -> ParameterRows:
    """One row for each degree of freedom, towards a predicted state.

    For the root's turn r ≈ δ holds to first order in r: exact in sum where its three deviations are alike.

    Parameters
    ----------
    predicted : BodyState
    sigma : (6 + D,) [m, rad]
        Standard deviation of the prediction; inf for a degree of freedom that is not predicted.
    """
    sigma = shaped(sigma, (body.tree.n_dofs,), "sigma of a prediction")
    w = targets.weights(sigma, np.ones(len(sigma), bool), "predictions")
    held = np.flatnonzero(w > 0.0)
    return ParameterRows(held, state.difference(predicted)[held], w[held])
