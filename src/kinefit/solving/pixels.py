"""Fit a pose to pixels, a predicted pose and the posture prior: `levenberg_marquardt` in one compiled kernel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import Loss
from kinefit.solving import _kernels_pixels
from kinefit.solving.equations import dense_pattern, lock

INITIAL_DAMPING = 1e-3
"""First damping with a prediction of every degree of freedom; without one, it is multiplied by H's mean diagonal."""


class PixelPoints(NamedTuple):
    """N points of a body in `camera` (N,) of a rig: `uv` (N, 2) [px], `weight` (N,) [1/px²], a loss of one scale."""

    points: PointSet
    camera: NDArray
    uv: NDArray
    weight: NDArray
    loss: Loss


class PixelFit(NamedTuple):
    """The end of a fit: state, `H` (n, n) and `g` (n,) of its normal equations, cost, and number of steps tried."""

    state: BodyState
    H: NDArray
    g: NDArray
    cost: float
    iterations: int


def fit_pixels(
    body: Body, state: BodyState, rig: Rig, pixels: PixelPoints, held: tuple[BodyState, NDArray] | None, *,
    max_iterations: int, tolerance: float, posture: float = 1.0,
) -> PixelFit | None:  # fmt: skip
    """Minimise Σ ρ over pixels, the prediction and the posture prior, from a start state.

    The steps are those of `levenberg_marquardt`, up to rounding, in a fifth of the time, since no rows are made.

    Parameters
    ----------
    state : to start from
    pixels : N points of the body, in images (N, 2) [px]
    held : predicted state and its information (n, n); None for no prediction
    max_iterations, tolerance : see `levenberg_marquardt`
    posture : share of the posture prior

    Returns
    -------
    None if an input is not finite
    """
    tree, n = body.tree, body.tree.n_dofs
    predicted, information = held or (state, np.zeros((n, n)))
    posed, precision = tree.held_by_posture
    roots, angles = np.empty((2, 4, 4)), np.empty((2, n - 6))
    roots[0], angles[0] = state.T_world_root, state.angles
    H, g = np.empty((2, n, n)), np.empty((2, n))
    best, cost, tried = _kernels_pixels.minimum(
        tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, tree.chain, tree.depth, *dense_pattern(n),
        tree.lower, tree.upper, lock(body, None), pixels.points.segments, body.points_rest(pixels.points), rig.packed,
        pixels.camera, pixels.uv, pixels.weight, pixels.loss.kind, float(pixels.loss.scale), predicted.T_world_root,
        predicted.angles, information, posed, tree.usual,
        posture * (precision if precision.ndim == 2 else np.diag(precision)), roots, angles, H, g, max_iterations,
        tolerance, INITIAL_DAMPING, 0.0 if held else INITIAL_DAMPING,
    )  # fmt: skip
    if best < 0:
        return None
    _kernels_pixels.mirror(H[best])
    return PixelFit(BodyState(roots[best], angles[best]), H[best], g[best], cost, tried)
