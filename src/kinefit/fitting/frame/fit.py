"""Fit one frame: match the measurements, turn the matches into rows, solve for the state and its covariance.

Minimise one frame's cost under fixed correspondences: for any rows, closed chains, or compiled for keypoints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.fitting.frame import results
from kinefit.fitting.frame.prediction import prediction_row, release_dofs
from kinefit.fitting.frame.skin import has_surface_offset, skin_of
from kinefit.sensors.base import Matched, Measurement, matched_by, packed, rows_at
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.closed import Constraint, closed_fit, closed_step, on_null_space
from kinefit.solving.correspondences.closures import HARD_SIGMA, closed_at, hard_equations, looped, soft_closures
from kinefit.solving.correspondences.occupancy.free_space import CollisionPairs, collision_pairs, collision_rows
from kinefit.solving.correspondences.points import prior_rows
from kinefit.solving.equations import inverse, joint_moves, normal_equations
from kinefit.solving.least_squares import INITIAL_DAMPING, fit_pixels, gauss_newton, levenberg_marquardt
from kinefit.solving.rows import AnyRows, DofRows, Rows, weaker

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


_PRIOR_REMAINDER = 1e-6  # share of the prior that stays, so that an unobserved coordinate has a finite variance
_MAX_MATCH_ROUNDS = 3  # of matching and solving, where only discrete parts of a match change

Held = tuple[BodyState, NDArray]
"""A predicted state and its information (n, n), without the posture prior."""

Without = Sequence[NDArray | None] | None
"""For each match, the segments (S,) bool whose rows get weight 0."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted frame with its covariances.

    Parameters
    ----------
    filtered : (n, n) covariance from measurements and prediction, without the posture prior
    stated : (n, n) covariance behind the result's standard deviations, posture prior and surface errors included
    seen : (D,) bool, coordinates that this frame's measurements observe
    known : (D,) bool, coordinates observed in this frame, or observed earlier and not lost now
    released : (n,) bool, optional: degrees of freedom whose prediction was discarded
    """

    result: results.FrameResult
    filtered: NDArray
    stated: NDArray
    seen: NDArray
    known: NDArray
    released: NDArray | None = None


class FrameFit:
    """Fits frames of one body.

    Parameters
    ----------
    body : Body
    settings : TrackSettings
    """

    def __init__(self, body: Body, settings: TrackSettings) -> None:
        self.body, self.settings = body, settings
        pairs = collision_pairs(body) if body.surfaces else None
        self._pairs: CollisionPairs | None = pairs if pairs is not None and len(pairs.pairs) else None
        self._hard = hard_equations(body)

    def run(
        self, scene: Scene, held: Held | None, measurements: Sequence[Measurement], known: NDArray | None = None
    ) -> Fitted:
        """Fit one frame from the scene's state, and assess the result.

        A robust loss ignores measurements far from the start, so a limb that moved while occluded would stay at its
        prediction. If points contradict a segment, a second fit starts with a loss as wide as the prediction's
        uncertainty. The better of both fits is returned. Starts that measurements propose are tried likewise.

        Parameters
        ----------
        scene : at the predicted state
        held : predicted state and its information (n, n); None for no prediction
        known : (D,) bool, coordinates that were observed before
        """
        points = [m for m in measurements if m.settled]
        every = len(points) == len(measurements)
        best = self._fit(scene, held, measurements)
        evidence = results.evidence_of(best.scene, best.matched)
        if points and results.sum_evidence(scene, [e for e, m in zip(evidence, measurements) if m.settled]).lost.any():
            other = self._fit_to_minimum(scene, held, points, self._initial_reach(held))
            other = other if every else self._fit_step_by_step(other.scene, held, measurements)
            new = results.evidence_of(other.scene, other.matched)
            gain = best.cost - other.cost if every else sum(e.balance for e in new) - sum(e.balance for e in evidence)
            if gain > 0.0:
                best, evidence = other, new
        released: NDArray | None = None
        for m, first_evidence in zip(measurements, list(evidence)):
            for state in m.starts(scene, None if held is None else held[1], first_evidence):
                free = None if held is None else results.angles_off_prediction(*held, state)
                other = self._fit(scene.at(state), release_dofs(held, free), measurements)
                new = results.evidence_of(other.scene, other.matched)
                better = m.better(other.scene, best.scene)
                if better is None:
                    better = sum(e.balance for e in new) > sum(e.balance for e in evidence)
                if better:
                    best, evidence, released = other, new, free
        return replace(self._assess(best, release_dofs(held, released), evidence, known), released=released)

    def _fit(self, scene: Scene, held: Held | None, measurements: Sequence[Measurement]) -> Minimum:
        settled = all(m.settled for m in measurements)
        return (self._fit_to_minimum if settled else self._fit_step_by_step)(scene, held, measurements)

    def _fit_step_by_step(self, scene: Scene, held: Held | None, measurements: Sequence[Measurement]) -> Minimum:
        """Fit with nearest points (ICP): one step after each match, while the reach shrinks to `near`."""
        s, iterations = self.settings, 0
        reach = float(np.clip(max(m.within for m in measurements if not m.settled), s.near, s.far))
        while iterations < s.iterations:
            iterations += 1
            matched = _match(scene, measurements, reach)
            rows = self.rows(scene, held, matched, apart=True)
            if self._hard is None:
                step = gauss_newton(self.body, scene.state, rows)
            else:
                step = closed_step(self.body, scene.state, rows, self._hard)
            scene = scene.at(step.state)
            gain = float(step.delta @ step.equations.gradient)  # twice the fall of the cost: squared deviations
            if gain < s.tolerance**2 * len(step.delta) and reach <= s.near:
                break
            reach = max(reach * s.shrink, s.near)
        return Minimum(scene, step.equations.matrix, step.equations.cost, iterations, tuple(matched))

    def _fit_to_minimum(
        self, scene: Scene, held: Held | None, measurements: Sequence[Measurement], reach: float = 0.0
    ) -> Minimum:
        """Fit without nearest points: minimise under each match, until the match no longer changes.

        A `reach` [m] above the setting `near` widens the loss of the first rounds.
        """
        s, iterations = self.settings, 0
        while reach > s.near:
            matched = _match(scene, measurements, reach)
            found = self._minimum(scene, held, matched, ROUGH_ITERATIONS, ROUGH_TOLERANCE)
            scene, reach, iterations = found.scene, reach * s.shrink, iterations + found.iterations
        matched = _match(scene, measurements, s.near)
        for last in [False] * (_MAX_MATCH_ROUNDS - 1) + [True]:
            found = self._minimum(scene, held, matched, 40, 1e-4)
            scene, iterations = found.scene, iterations + found.iterations
            again = matched if last else _match(scene, measurements, s.near)
            if all(a.key == b.key for a, b in zip(matched, again)):
                break
            matched = again
        return replace(found, iterations=iterations)

    def _minimum(
        self, scene: Scene, held: Held | None, matched: Sequence[Matched], most: int, tolerance: float
    ) -> Minimum:
        return minimum(scene, held, matched, lambda at: self.rows(at, held, matched), self._hard, most, tolerance)

    def _initial_reach(self, held: Held | None) -> float:
        """Largest standard deviation [m] of a predicted joint centre, within `far` and the root's prior."""
        if held is None:
            return self.settings.far
        moves = joint_moves(self.body, held[0])
        variance = np.einsum("...i,...i->...", moves @ inverse(held[1]), moves).sum(axis=1)
        return float(np.clip(np.sqrt(variance.max()), self.settings.far, results.ROOT_PRIOR_STD))

    def rows(
        self, scene: Scene, held: Held | None, matched: Sequence[Matched], *, apart: bool = False,
        without: Without = None,
    ) -> list[AnyRows]:  # fmt: skip
        """Rows of all matches, of the prediction, of the posture prior and of soft closures.

        Parameters
        ----------
        held : predicted state and its information (n, n)
        apart : add rows against collisions of the body with itself
        without : for each match, the segments (S,) bool whose rows get weight 0
        """
        parts = rows_of(scene, matched, self.settings, without=without)
        if held is not None:
            parts.append(prediction_row(scene.state, *held))
        if len(scene.state.angles):
            parts.append(prior_rows(self.body, scene.state))
        parts += soft_closures(self.body, scene.state)
        return [*parts, *self.apart(scene)] if apart else parts

    def apart(self, scene: Scene) -> list[AnyRows]:
        """Rows against collisions of the body with itself."""
        if self._pairs is None:
            return []
        s = self.settings
        margin, sigma = -s.flesh, s.collision
        return [collision_rows(self.body, scene.state, pairs=self._pairs, margin=margin, sigma=sigma)]

    def _assess(self, found: Minimum, held: Held | None, each: Sequence[Evidence], known: NDArray | None) -> Fitted:
        """Covariances and quality of a fit, without rows on contradicted segments and of surfaces that occlude one."""
        scene, tree, evidence = found.scene, self.body.tree, results.sum_evidence(found.scene, each)
        A = np.zeros((0, tree.n_dofs)) if self._hard is None else self._hard(scene.state)[1]
        exact = A.T @ A / HARD_SIGMA**2
        H = found.H + exact
        lost = evidence.lost if evidence.lost.any() else None
        off = [results.segments_not_shown(m, e) for m, e in zip(found.matched, each)]
        if lost is not None:
            off = [lost if segments is None else lost | segments for segments in off]
        without = off if any(segments is not None and segments.any() for segments in off) else None
        if without is not None:
            rows = self.rows(scene, held, found.matched, without=without)
            H = normal_equations(self.body, scene.state, rows).matrix + exact
        if held is None:
            H = now = H + _PRIOR_REMAINDER * np.eye(len(H))  # an unobserved root would make H singular
        else:
            now = H - held[1] + _PRIOR_REMAINDER * np.eye(len(H))
        seen = self._observed_dofs(scene, found.matched, now, without)
        known = seen[6:] if known is None else seen[6:] | known
        known = known | ~np.isfinite(tree.spread)
        alone = np.array(H)
        alone[6:, 6:] -= (1.0 - _PRIOR_REMAINDER) * tree.posture_precision
        posterior = on_null_space(inverse(H), A)
        stated = posterior + self._surface_covariance(scene, found.matched, now, without)
        if lost is not None:
            elsewhere = np.zeros(len(lost), bool) if evidence.elsewhere is None else lost & evidence.elsewhere
            gone = results.dofs_of_joints(tree, elsewhere) | (results.dofs_moving(tree, lost) & ~seen)
            known, stated = known & ~gone[6:], results.reset_to_prior(tree, stated, gone)
        result = results.frame_result(scene, stated, found.matched, found.iterations, observed=known, evidence=evidence)
        if lost is not None:
            result = replace(result, joint_std=np.where(elsewhere[:, None], np.inf, result.joint_std))
        return Fitted(result, inverse(alone), stated, seen[6:], known)

    def _surface_covariance(self, scene: Scene, matched: Sequence[Matched], now: NDArray, without: Without) -> NDArray:
        """Covariance (n, n) that the surfaces' bias adds to the pose; `now` is the information of this frame alone."""
        s, n = self.settings, self.body.tree.n_dofs
        if s.skin_shift <= 0.0 or n == 6 or all(m.of_points for m in matched):
            return np.zeros((n, n))
        _, surface, points = _kinds(scene, matched, None, 0, without)
        if not surface:
            return np.zeros((n, n))
        skin = skin_of(scene, surface, s.skin_shift, s.skin_turn, matched)
        moved = (skin.pushes if points >= n else skin.exact_pushes) @ inverse(now)
        return moved.T @ moved

    def _observed_dofs(self, scene: Scene, matched: Sequence[Matched], now: NDArray, without: Without) -> NDArray:
        """(n,) bool: degrees of freedom that this frame's measurements observe; `now` is their information with prior.

        A joint that moves points of images by less than `MIN_LEVER` is observed only if other sensors observe it.
        """
        seen = results.observed(self.body.tree, now)
        moved = [m.moves(scene) for m in matched]
        moving = [of_points for of_points in moved if of_points is not None]
        if not moving:
            return seen
        short = seen[6:] & ~np.any(moving, axis=0) & ~looped(self.body)
        if short.any():
            others = [k for k, of_points in enumerate(moved) if of_points is None]
            if others:
                off = without and [without[k] for k in others]
                rows = self.rows(scene, None, [matched[k] for k in others], without=off)
                H = normal_equations(self.body, scene.state, rows).matrix + _PRIOR_REMAINDER * np.eye(len(now))
                short &= ~results.observed(self.body.tree, H)[6:]
            seen[6:] &= ~short
        return seen


def rows_of(
    scene: Scene, matched: Sequence[Matched], settings: TrackSettings, scale: Mapping[str, float] | None = None, *,
    points: int = 0, without: Without = None,
) -> list[AnyRows]:  # fmt: skip
    """Rows of all matches, with the surface offsets eliminated from the rows of surfaces (`frame.skin`).

    Offsets are eliminated where points (keypoints, markers) have at least as many rows as the body has degrees of
    freedom, and so determine the bones by themselves. With fewer, surfaces alone constrain the body from frame to
    frame. A constant offset does not disturb that, and surfaces count as exact.

    Parameters
    ----------
    scale : {sensor: factor} on standard deviations
    points : number of rows of points that are not among the matches
    without : for each match, the segments (S,) bool whose rows get weight 0
    """
    parts, surface, points = _kinds(scene, matched, scale, points, without)
    if not surface or ignores_surface_offsets(scene, settings, points):
        return [*parts, *surface]
    return [*parts, skin_of(scene, surface, settings.skin_shift, settings.skin_turn).rows()]


def ignores_surface_offsets(scene: Scene, settings: TrackSettings, points: int) -> bool:
    """Whether a fit with this number of rows of `points` ignores surface offsets, see `rows_of`."""
    return settings.skin_shift <= 0.0 or points < scene.body.tree.n_dofs


def _kinds(
    scene: Scene, matched: Sequence[Matched], scale: Mapping[str, float] | None, points: int, without: Without
) -> tuple[list[AnyRows], list[Rows | DofRows], int]:
    """Rows of everything but surfaces, rows of surfaces, and the number of rows of points."""
    parts: list[AnyRows] = []
    surface: list[Rows | DofRows] = []
    for m, off in zip(matched, without or [None] * len(matched)):
        for rows in rows_at(m, scene):
            rows = weaker(rows, (scale or {}).get(m.sensor, 1.0))
            rows = rows if off is None else results.without_segments(rows, off)
            if has_surface_offset(rows, m):
                surface.append(rows)
            else:
                parts.append(rows)
                points += int(np.count_nonzero(rows.weight)) if m.of_points else 0
    return parts, surface, points


def rows_of_points(scene: Scene, matched: Sequence[Matched]) -> int:
    """Number of rows of points with a weight above 0 among the matches."""
    return sum(int(np.count_nonzero(rows.weight)) for m in matched if m.of_points for rows in rows_at(m, scene))


def _match(scene: Scene, measurements: Sequence[Measurement], reach: float) -> list[Matched]:
    return [matched_by(m, scene, reach) for m in measurements]
