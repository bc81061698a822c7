"""Bundle adjustment of cameras and free points (B. Triggs et al., Bundle Adjustment - A Modern Synthesis, 1999)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Rig
from kinefit.losses import Loss, geman_mcclure
from kinefit.solvers.bundle.cameras import (
    COLUMNS,
    TIME,
    CameraPrior,
    PointPixels,
    moved_rig,
    reduce_points,
    residuals,
    robust_cost,
)
from kinefit.solvers.least_squares import descend

_At = tuple[Rig, NDArray, NDArray]  # cameras, time offsets, points


@dataclass(frozen=True, eq=False)
class Bundle:
    """Adjusted cameras and points.

    Parameters
    ----------
    rig : Rig
    offsets : (C,) [s]
    x : (P, 3) [m]
    cost : float
    S : (C · 10, C · 10) information of the data on the cameras, points eliminated.
    """

    rig: Rig
    offsets: NDArray
    x: NDArray
    cost: float
    S: NDArray


def bundle_adjust(
    rig: Rig,
    pixels: PointPixels,
    x: NDArray,
    prior: CameraPrior,
    *,
    offsets: NDArray | None = None,
    loss: Loss | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
) -> Bundle:
    """Minimise the robust pixel error over cameras and points x (P, 3) [m], by damped Gauss-Newton with Schur.

    Parameters
    ----------
    rig, x : start.
    prior : CameraPrior
        Free parameters and their priors. Without priors only the damping fixes the gauge (position, rotation, scale).
    offsets : (C,) [s] time offsets to start from; default 0.
    tolerance : float
        Share of the cost; an iteration that lowers it by less ends the adjustment.
    """
    loss = loss or geman_mcclure()
    begin: _At = rig, np.zeros(len(rig)) if offsets is None else offsets, x
    precision, freedom = prior.precision, prior.freedom

    def cost_of(rig: Rig, offsets: NDArray, x: NDArray) -> float:
        away = prior.departure(rig, offsets)
        return robust_cost(residuals(rig, offsets, pixels, x), pixels.weight, loss)[0] + float(precision @ away**2)

    def step(now: _At, damping: float) -> _At | None:
        rig, offsets, x = now
        system = reduce_points(rig, offsets, freedom, pixels, x, loss, damping)
        S = system.S + np.diag(precision)
        b = system.b - precision * prior.departure(rig, offsets)
        delta = np.linalg.solve(S + damping * np.diag(np.diag(S)) + 1e-12 * np.eye(len(S)), b)
        by_camera = delta.reshape(-1, COLUMNS)
        try:
            return moved_rig(rig, by_camera), offsets + by_camera[:, TIME], x + system.points_step(delta)
        except ValueError:
            return None

    found, cost = descend(
        begin, lambda at: cost_of(*at), step, iterations=max_iterations, tolerance=tolerance, most=1e6
    )
    return Bundle(*found, cost, reduce_points(*found[:2], freedom, pixels, found[2], loss).S)
