"""One time's fit: measurements are matched, matches become rows, and a state comes out with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.collisions import CollisionPairs, collision_pairs, collision_rows
from kinefit.frame.prediction import belief
from kinefit.frame.results import BLIND, FrameResult, judged
from kinefit.frame.skin import skin_of
from kinefit.rows import AnyRows, ParameterRows, Rows
from kinefit.sensors.base import Matched, Measurement, matched_by, rows_at
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solvers.equations import inverse
from kinefit.solvers.least_squares import gauss_newton, levenberg_marquardt

_LIGHT = 1e-3  # first damping where a prediction holds every degree of freedom already
_TRACE = 1e-6  # of the prior that stays, so that what nothing observes has a large variance and not none
_ROUNDS = 3  # of matching and solving, where a match changes in what is discrete alone

Held = tuple[BodyState, NDArray]
"""What is known beforehand: a state, and the information (n, n) of it, without the posture prior."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted frame: the result, and the covariance (n, n) of what was measured and predicted, without the prior.

    Parameters
    ----------
    observed : (D,) bool, coordinates that sensors have told of, now or before
    """

    result: FrameResult
    filtered: NDArray
    observed: NDArray


class FrameFit:
    """A body, ready for one fit after the other.

    Parameters
    ----------
    body : Body
    settings : TrackSettings
    """

    def __init__(self, body: Body, settings: TrackSettings) -> None:
        self.body, self.settings = body, settings
        self._pairs: CollisionPairs | None = collision_pairs(body) if body.surfaces else None
        self._prior = 6 + np.flatnonzero(np.isfinite(body.tree.spread))
        self._prior_weight = 1.0 / np.square(body.tree.spread[self._prior - 6])

    def run(
        self, scene: Scene, held: Held | None, measurements: Sequence[Measurement], known: NDArray | None = None
    ) -> Fitted:
        """Fit from a scene's state on, and judge; `known` (D,) bool are coordinates that were observed before."""
        known = np.zeros(len(self.body.tree.coordinates), bool) if known is None else known
        if all(m.settled for m in measurements):
            return self._settled(scene, held, measurements, known)
        s, reach, iterations = self.settings, self.settings.far, 0
        while iterations < s.iterations:
            iterations += 1
            matched = _match(scene, measurements, reach)
            step = gauss_newton(self.body, scene.state, self.rows(scene, held, matched, apart=True))
            scene = scene.at(step.state)
            gain = float(step.delta @ step.equations.gradient)  # twice the fall of the cost: squared deviations
            if gain < s.tolerance**2 * len(step.delta) and reach <= s.near:
                break
            reach = max(reach * s.shrink, s.near)
        return self._judged(scene, held, step.equations.matrix, matched, iterations, known)

    def _settled(
        self, scene: Scene, held: Held | None, measurements: Sequence[Measurement], known: NDArray
    ) -> Fitted:
        """Where a match changes in what is discrete alone: to the minimum under each, until it stays as it is."""
        matched, iterations = _match(scene, measurements, self.settings.near), 0
        for last in [False] * (_ROUNDS - 1) + [True]:
            fit = levenberg_marquardt(
                self.body, scene.state, lambda state: self.rows(scene.at(state), held, matched),  # noqa: B023
                max_iterations=40, tolerance=1e-4, damping=None if held is None else _LIGHT,
            )  # fmt: skip
            scene, iterations = scene.at(fit.state), iterations + fit.iterations
            again = matched if last else _match(scene, measurements, self.settings.near)
            if all(a.key == b.key for a, b in zip(matched, again)):
                break
            matched = again
        return self._judged(scene, held, fit.equations.matrix, matched, iterations, known)

    def rows(
        self, scene: Scene, held: Held | None, matched: Sequence[Matched], *, apart: bool = False
    ) -> list[AnyRows]:
        """Rows of all matches, of what was held, of the posture prior; `apart` keeps parts of the body apart."""
        parts = rows_of(scene, matched, self.settings)
        if held is not None:
            parts.append(belief(scene.state, *held))
        usual = self.body.tree.usual
        parts.append(ParameterRows(self._prior, (usual - scene.state.angles)[self._prior - 6], self._prior_weight))
        return [*parts, *self.apart(scene)] if apart else parts

    def apart(self, scene: Scene) -> list[AnyRows]:
        """Rows that keep parts of the body from running into each other."""
        if self._pairs is None:
            return []
        s = self.settings
        margin, sigma = -s.flesh, s.collision
        return [collision_rows(self.body, scene.state, pairs=self._pairs, margin=margin, sigma=sigma)]

    def _judged(
        self, scene: Scene, held: Held | None, H: NDArray, matched: Sequence[Matched], iterations: int, known: NDArray
    ) -> Fitted:  # fmt: skip
        posterior, alone = inverse(H), np.array(H)
        alone[self._prior, self._prior] -= self._prior_weight * (1.0 - _TRACE)
        now = posterior if held is None else inverse(H - held[1] + _TRACE * np.eye(len(H)))
        seen = np.sqrt(np.maximum(np.diag(now)[6:], 0.0)) <= BLIND * self.body.tree.spread
        known = known | seen | ~np.isfinite(self.body.tree.spread)
        return Fitted(judged(scene, posterior, matched, iterations, observed=known), inverse(alone), known)


def rows_of(
    scene: Scene, matched: Sequence[Matched], settings: TrackSettings, scale: Mapping[str, float] | None = None,
    points: int = 0,
) -> list[AnyRows]:  # fmt: skip
    """Rows of all matches; those of surfaces determine bones no better than where these lie below them (`frame.skin`).

    That is so where points (keypoints, markers) have at least as many rows as the body has degrees of freedom, and so
    tell by themselves where bones are. With fewer, surfaces are all that holds the body from frame to frame, and their
    error, which lasts, does not harm that: they are taken for exact.

    Parameters
    ----------
    scale : {sensor: factor} on standard deviations
    points : rows of points that are not among the matches
    """
    parts: list[AnyRows] = []
    surface: list[Rows] = []
    for m in matched:
        for rows in rows_at(m, scene):
            rows = weaker(rows, (scale or {}).get(m.sensor, 1.0))
            if not m.of_points and isinstance(rows, Rows):
                surface.append(rows)
            else:
                parts.append(rows)
                points += int(np.count_nonzero(rows.weight)) if m.of_points else 0
    if surface and settings.skin_shift > 0.0 and points >= scene.body.tree.n_dofs:
        return [*parts, skin_of(scene, surface, settings.skin_shift, settings.skin_turn).rows()]
    return [*parts, *surface]


def rows_of_points(scene: Scene, matched: Sequence[Matched]) -> int:
    """How many rows of points there are among some matches."""
    return sum(int(np.count_nonzero(rows.weight)) for m in matched if m.of_points for rows in rows_at(m, scene))


def weaker(rows: AnyRows, factor: float) -> AnyRows:
    """The same rows with standard deviations that are so many times larger."""
    if factor == 1.0:
        return rows
    if isinstance(rows, Rows):
        return rows.weaker(factor)
    return replace(rows, weight=rows.weight / factor**2)


def _match(scene: Scene, measurements: Sequence[Measurement], reach: float) -> list[Matched]:
    return [matched_by(m, scene, reach) for m in measurements]

