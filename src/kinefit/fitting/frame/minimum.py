"""Minimise one frame's cost under fixed correspondences: for any rows, closed chains, or compiled for keypoints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.sensors.base import Matched, packed
from kinefit.sensors.scene import Scene
from kinefit.solving.closed import Constraint, closed_fit
from kinefit.solving.correspondences.closures import closed_at
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.pixels import INITIAL_DAMPING, fit_pixels
from kinefit.solving.rows import AnyRows

_MAX_CLOSURE_ERROR = 0.01  # [m, rad] of a start; above it a first fit closes chains with this standard deviation
ROUGH_ITERATIONS = 10
"""At most, of a round that another round refines."""
ROUGH_TOLERANCE = 1e-2
"""Of such a round, see `levenberg_marquardt`."""


@dataclass(frozen=True, eq=False)
class Minimum:
    """A minimum: the scene, the normal matrix (n, n), the cost, the number of steps tried, and the match."""

    scene: Scene
    H: NDArray
    cost: float
    iterations: int
    matched: tuple[Matched, ...]


def minimum(
    scene: Scene, held: tuple[BodyState, NDArray] | None, matched: Sequence[Matched],
    rows: Callable[[Scene], list[AnyRows]], hard: Constraint | None, most: int, tolerance: float,
) -> Minimum:  # fmt: skip
    """Minimise the cost of a match from a scene's state.

    Parameters
    ----------
    held : predicted state and its information (n, n)
    rows : scene -> rows of the matches, of the prediction, of the posture prior
    hard : equations of hard closures, None for none
    most : int, iterations at most
    tolerance : float, unitless, see `levenberg_marquardt`
    """
    pixels = packed(matched, scene) if held is not None and hard is None else None
    if held is not None and pixels is not None:  # keypoints alone, of a body without morphs: by the compiled solver
        found = fit_pixels(scene.body, scene.state, scene.rig, pixels, held, max_iterations=most, tolerance=tolerance)
        if found is not None:
            return Minimum(scene.at(found.state), found.H, found.cost, found.iterations, tuple(matched))

    def at(state: BodyState) -> list[AnyRows]:
        return rows(scene.at(state))

    body, start, damping, tried = scene.body, scene.state, None if held is None else INITIAL_DAMPING, 0
    if hard is None:
        fit = levenberg_marquardt(body, start, at, max_iterations=most, tolerance=tolerance, damping=damping)
    else:
        if np.abs(hard(start)[0]).max() > _MAX_CLOSURE_ERROR:  # the nearest closed pose may be far from the data
            near = levenberg_marquardt(
                body, start, lambda state: [*at(state), closed_at(body, state).rows(_MAX_CLOSURE_ERROR)],
                max_iterations=ROUGH_ITERATIONS, tolerance=ROUGH_TOLERANCE, damping=damping,
            )  # fmt: skip
            start, tried = near.state, near.iterations
        fit = closed_fit(body, start, at, hard, max_iterations=most, tolerance=tolerance, damping=damping)
    eq, tried = fit.equations, fit.iterations + tried
    return Minimum(scene.at(fit.state), eq.matrix, eq.cost, tried, tuple(matched))
