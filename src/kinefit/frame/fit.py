"""One time's fit: measurements are matched, matches become rows, and a state comes out with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.closures import STIFF, hard_equations, looped, soft_closures
from kinefit.correspondences.occupancy.collisions import CollisionPairs, collision_pairs, collision_rows
from kinefit.correspondences.parameters import prior_rows
from kinefit.frame.minimum import ROUGH, Minimum, minimum
from kinefit.frame.prediction import belief, released_from
from kinefit.frame.results import ANYWHERE, FrameResult, evidence_of, judged, together
from kinefit.frame.skin import skin_of
from kinefit.frame.trust import forgotten, holding, leapt, left_out, levered, moving, observed, unseen
from kinefit.rows import AnyRows, Rows
from kinefit.sensors.base import Matched, Measurement, matched_by, pixels_of, rows_at
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solvers.closed import closed_step, on_null_space
from kinefit.solvers.equations import inverse, joint_moves, normal_equations
from kinefit.solvers.least_squares import gauss_newton

_TRACE = 1e-6  # of the prior that stays, so that what nothing observes has a large variance and not none
_ROUNDS = 3  # of matching and solving, where a match changes in what is discrete alone

Held = tuple[BodyState, NDArray]
"""What is known beforehand: a state, and the information (n, n) of it, without the posture prior."""

Without = Sequence[NDArray | None] | None
"""Of each match the segments (S,) bool whose rows weigh nothing."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted frame: the result, and the covariance (n, n) of what was measured and predicted, without the prior.

    Parameters
    ----------
    stated : (n, n) covariance behind the result's deviations, the prior and what surfaces err by included
    seen : (D,) bool, coordinates that this frame's measurements observe
    known : (D,) bool, those, and what was known before and is not lost now
    released : (n,) bool, optional: degrees of freedom that were found where they were not expected
    """

    result: FrameResult
    filtered: NDArray
    stated: NDArray
    seen: NDArray
    known: NDArray
    released: NDArray | None = None


@dataclass(frozen=True, eq=False)
class _FrameFit:
    """Where a fit ended: the scene there, the normal matrix (n, n), the cost under its own match."""

    scene: Scene
    H: NDArray
    cost: float
    matched: tuple[Matched, ...]
    iterations: int
    apart: bool = False


class FrameFit:
    """A body, ready for one fit after the other.

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
        """Fit from a scene's state on, and judge.

        A robust loss drops what is far from the start: a limb that moved while nobody saw it would stay where it was
        expected. So where single points contradict a segment, a second fit begins with a loss as wide as the prediction
        is uncertain, and the better of both is taken.

        Parameters
        ----------
        known : (D,) bool, coordinates that were observed before
        """
        points = [m for m in measurements if m.settled]
        every = len(points) == len(measurements)
        found = self._fitted(scene, held, measurements)
        told = evidence_of(found.scene, found.matched)
        if points and together(scene, [e for e, m in zip(told, measurements) if m.settled]).lost.any():
            other = self._settled(scene, held, points, self._uncertain(held))
            other = other if every else self._renewed(other.scene, held, measurements)
            also = evidence_of(other.scene, other.matched)
            gain = found.cost - other.cost if every else sum(e.balance for e in also) - sum(e.balance for e in told)
            if gain > 0.0:
                found, told = other, also
        released: NDArray | None = None
        for m, one in zip(measurements, list(told)):
            for state in m.starts(scene, None if held is None else held[1], one):
                free = None if held is None else leapt(*held, state)
                other = self._fitted(scene.at(state), released_from(held, free), measurements)
                also = evidence_of(other.scene, other.matched)
                better = m.better(other.scene, found.scene)
                if better is None:
                    better = sum(e.balance for e in also) > sum(e.balance for e in told)
                if better:
                    found, told, released = other, also, free
        return replace(self._judged(found, released_from(held, released), told, known), released=released)

    def _fitted(self, scene: Scene, held: Held | None, measurements: Sequence[Measurement]) -> _FrameFit:
        settled = all(m.settled for m in measurements)
        return self._settled(scene, held, measurements) if settled else self._renewed(scene, held, measurements)

    def _renewed(self, scene: Scene, held: Held | None, measurements: Sequence[Measurement]) -> _FrameFit:
        """Where nearest points take part: one step under each match, within a distance that shrinks to `near`."""
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
        return _FrameFit(scene, step.equations.matrix, step.equations.cost, tuple(matched), iterations, True)

    def _settled(
        self, scene: Scene, held: Held | None, measurements: Sequence[Measurement], reach: float = 0.0
    ) -> _FrameFit:
        """Where a match changes in what is discrete alone: to the minimum under each, until it stays as it is.

        A `reach` [m] beyond the settings' nearest widens the loss at first.
        """
        s, iterations = self.settings, 0
        while reach > s.near:
            found = self._minimum(scene, held, _match(scene, measurements, reach), *ROUGH)
            scene, reach, iterations = found.scene, reach * s.shrink, iterations + found.iterations
        matched = _match(scene, measurements, s.near)
        for last in [False] * (_ROUNDS - 1) + [True]:
            found = self._minimum(scene, held, matched, 40, 1e-4)
            scene, iterations = found.scene, iterations + found.iterations
            again = matched if last else _match(scene, measurements, s.near)
            if all(a.key == b.key for a, b in zip(matched, again)):
                break
            matched = again
        return _FrameFit(scene, found.H, found.cost, tuple(matched), iterations)

    def _minimum(
        self, scene: Scene, held: Held | None, matched: Sequence[Matched], most: int, tolerance: float
    ) -> Minimum:
        return minimum(scene, held, matched, lambda at: self.rows(at, held, matched), self._hard, most, tolerance)

    def _uncertain(self, held: Held | None) -> float:
        """[m] how far some joint centre may be from where it is expected, one standard deviation; `far` at least."""
        if held is None:
            return self.settings.far
        moves = joint_moves(self.body, held[0])
        variance = np.einsum("...i,...i->...", moves @ inverse(held[1]), moves).sum(axis=1)
        return float(np.clip(np.sqrt(variance.max()), self.settings.far, ANYWHERE))

    def rows(
        self, scene: Scene, held: Held | None, matched: Sequence[Matched], *, apart: bool = False,
        without: Without = None,
    ) -> list[AnyRows]:  # fmt: skip
        """Rows of all matches, of what was held, of the posture prior, of soft closures; `apart` keeps parts apart.

        Measurements of the segments `without` weigh nothing.
        """
        parts = rows_of(scene, matched, self.settings, without=without)
        if held is not None:
            parts.append(belief(scene.state, *held))
        if len(scene.state.angles):
            parts.append(prior_rows(self.body, scene.state))
        parts += soft_closures(self.body, scene.state)
        return [*parts, *self.apart(scene)] if apart else parts

    def apart(self, scene: Scene) -> list[AnyRows]:
        """Rows that keep parts of the body from running into each other."""
        if self._pairs is None:
            return []
        s = self.settings
        margin, sigma = -s.flesh, s.collision
        return [collision_rows(self.body, scene.state, pairs=self._pairs, margin=margin, sigma=sigma)]

    def _judged(self, found: _FrameFit, held: Held | None, each: Sequence[Evidence], known: NDArray | None) -> Fitted:
        """Where measurements contradict a segment, none makes it more certain, nor does a surface that hides it."""
        scene, tree, told = found.scene, self.body.tree, together(found.scene, each)
        A = np.zeros((0, tree.n_dofs)) if self._hard is None else self._hard(scene.state)[1]
        exact = A.T @ A / STIFF**2
        H = found.H + exact
        lost = told.lost if told.lost.any() else None
        off = [unseen(m, one) for m, one in zip(found.matched, each)]
        if lost is not None:
            off = [lost if one is None else lost | one for one in off]
        without = off if any(one is not None and one.any() for one in off) else None
        if without is not None:
            rows = self.rows(scene, held, found.matched, without=without)
            H = normal_equations(self.body, scene.state, rows).matrix + exact
        if held is None:
            H = now = H + _TRACE * np.eye(len(H))  # where nothing measures the root, nothing holds it
        else:
            now = H - held[1] + _TRACE * np.eye(len(H))
        seen = self._seen(scene, found.matched, now, without)
        known = seen[6:] if known is None else seen[6:] | known
        known = known | ~np.isfinite(tree.spread)
        alone = np.array(H)
        alone[6:, 6:] -= (1.0 - _TRACE) * tree.posture_precision
        posterior = on_null_space(inverse(H), A)
        stated = posterior + self._of_surfaces(scene, found.matched, now, without)
        if lost is not None:
            elsewhere = np.zeros(len(lost), bool) if told.elsewhere is None else lost & told.elsewhere
            gone = holding(tree, elsewhere) | (moving(tree, lost) & ~seen)
            known, stated = known & ~gone[6:], forgotten(tree, stated, gone)
        result = judged(scene, stated, found.matched, found.iterations, observed=known, told=told)
        if lost is not None:
            result = replace(result, joint_std=np.where(elsewhere[:, None], np.inf, result.joint_std))
        return Fitted(result, inverse(alone), stated, seen[6:], known)

    def _of_surfaces(self, scene: Scene, matched: Sequence[Matched], now: NDArray, without: Without) -> NDArray:
        """(n, n) what the surfaces' own error, which lasts, adds to a pose, with the information of one time."""
        s, n = self.settings, self.body.tree.n_dofs
        if s.skin_shift <= 0.0 or n == 6 or all(m.of_points for m in matched):
            return np.zeros((n, n))
        _, surface, points = _kinds(scene, matched, None, 0, without)
        if not surface:
            return np.zeros((n, n))
        skin = skin_of(scene, surface, s.skin_shift, s.skin_turn, matched)
        moved = (skin.pushes if points >= n else skin.exact_pushes) @ inverse(now)
        return moved.T @ moved

    def _seen(self, scene: Scene, matched: Sequence[Matched], now: NDArray, without: Without) -> NDArray:
        """(n,) bool: what measurements observe, with the information of one time, the prior included.

        Keypoints observe no joint that hardly moves them, see `MIN_LEVER`: others must.
        """
        seen = observed(self.body.tree, now)
        pixels = pixels_of(matched)
        if not pixels:
            return seen
        short = seen[6:] & ~levered(scene, pixels) & ~looped(self.body)
        if short.any():
            others = [k for k, m in enumerate(matched) if m.pixels is None]
            if others:
                off = without and [without[k] for k in others]
                rows = self.rows(scene, None, [matched[k] for k in others], without=off)
                H = normal_equations(self.body, scene.state, rows).matrix + _TRACE * np.eye(len(now))
                short &= ~observed(self.body.tree, H)[6:]
            seen[6:] &= ~short
        return seen


def rows_of(
    scene: Scene, matched: Sequence[Matched], settings: TrackSettings, scale: Mapping[str, float] | None = None, *,
    points: int = 0, without: Without = None,
) -> list[AnyRows]:  # fmt: skip
    """Rows of all matches; those of surfaces determine bones no better than where these lie below them (`frame.skin`).

    That is so where points (keypoints, markers) have at least as many rows as the body has degrees of freedom, and so
    tell by themselves where bones are. With fewer, surfaces are all that holds the body from frame to frame, and their
    error, which lasts, does not harm that: they are taken for exact.

    Parameters
    ----------
    scale : {sensor: factor} on standard deviations
    points : rows of points that are not among the matches
    without : of each match the segments (S,) bool whose rows weigh nothing
    """
    parts, surface, points = _kinds(scene, matched, scale, points, without)
    if not surface or takes_surfaces_for_exact(scene, settings, points):
        return [*parts, *surface]
    return [*parts, skin_of(scene, surface, settings.skin_shift, settings.skin_turn).rows()]


def takes_surfaces_for_exact(scene: Scene, settings: TrackSettings, points: int) -> bool:
    """Whether a fit with so many rows of points leaves out that surfaces lie only about where they should."""
    return settings.skin_shift <= 0.0 or points < scene.body.tree.n_dofs


def _kinds(
    scene: Scene, matched: Sequence[Matched], scale: Mapping[str, float] | None, points: int, without: Without
) -> tuple[list[AnyRows], list[Rows], int]:
    """Rows of all but surfaces, rows of surfaces, and how many of points there are."""
    parts: list[AnyRows] = []
    surface: list[Rows] = []
    for m, off in zip(matched, without or [None] * len(matched)):
        for rows in rows_at(m, scene):
            rows = weaker(rows, (scale or {}).get(m.sensor, 1.0))
            rows = rows if off is None else left_out(rows, off)
            if not m.of_points and isinstance(rows, Rows):
                surface.append(rows)
            else:
                parts.append(rows)
                points += int(np.count_nonzero(rows.weight)) if m.of_points else 0
    return parts, surface, points


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

