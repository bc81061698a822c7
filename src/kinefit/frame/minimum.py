"""The minimum under one match: of any rows, of closed chains, and in one compiled piece of keypoints alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.correspondences.closures import closed_at
from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched
from kinefit.sensors.points.keypoints import packed
from kinefit.sensors.scene import Scene
from kinefit.solvers.closed import Constraint, closed_fit
from kinefit.solvers.least_squares import levenberg_marquardt
from kinefit.solvers.pixels import LIGHT, fit_pixels

_OPEN = 0.01  # [m, rad] by which a start may be off what closes it, and the first fit's standard deviation of that
ROUGH = 10, 1e-2
"""Iterations and tolerance of a round whose loss is still wide: the next one begins there."""


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where it is, the normal matrix (n, n) there, the cost, and the steps tried."""

    scene: Scene
    H: NDArray
    cost: float
    iterations: int


def minimum(
    scene: Scene, held: tuple[BodyState, NDArray] | None, matched: Sequence[Matched],
    rows: Callable[[Scene], list[AnyRows]], hard: Constraint | None, most: int, tolerance: float,
) -> Minimum:  # fmt: skip
    """From a scene's state on.

    Parameters
    ----------
    held : a state, and the information (n, n) of it
    rows : scene -> rows of the matches, of what was held, of the posture prior
    hard : what closes chains
    most, tolerance : of iterations, see `levenberg_marquardt`
    """
    if held is not None and hard is None and (found := _of_keypoints(scene, held, matched, most, tolerance)):
        return found

    def at(state: BodyState) -> list[AnyRows]:
        return rows(scene.at(state))

    body, start, damping, tried = scene.body, scene.state, None if held is None else LIGHT, 0
    if hard is None:
        fit = levenberg_marquardt(body, start, at, max_iterations=most, tolerance=tolerance, damping=damping)
    else:
        if np.abs(hard(start)[0]).max() > _OPEN:  # the nearest closed pose may be far from what is seen
            near = levenberg_marquardt(
                body, start, lambda state: [*at(state), closed_at(body, state).rows(_OPEN)],
                max_iterations=ROUGH[0], tolerance=ROUGH[1], damping=damping,
            )  # fmt: skip
            start, tried = near.state, near.iterations
        fit = closed_fit(body, start, at, hard, max_iterations=most, tolerance=tolerance, damping=damping)
    return Minimum(scene.at(fit.state), fit.equations.matrix, fit.equations.cost, fit.iterations + tried)


def _of_keypoints(
    scene: Scene, held: tuple[BodyState, NDArray], matched: Sequence[Matched], most: int, tolerance: float
) -> Minimum | None:
    """Without rows in between, where keypoints alone were measured of a body whose joints stay where they are."""
    seen = packed(matched, scene)
    if seen is None:
        return None
    fit = fit_pixels(
        scene.body, scene.state, scene.rig, seen, held, max_iterations=most, tolerance=tolerance
    )
    return None if fit is None else Minimum(scene.at(fit.state), fit.H, fit.cost, fit.iterations)
