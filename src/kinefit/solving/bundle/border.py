"""Fit poses of many frames and parameters that they share: damped Gauss-Newton, the poses eliminated.

The normal equations of K frames and p parameters θ have the shape of an arrow: each frame's pose is coupled to itself
and θ only. Eliminating the poses (Schur complement) leaves p equations, so the cost grows linearly with the frames.
Derivatives by θ are central differences of whitened residuals √w·r of the same correspondences in two worlds, for fixed
robust factors. So sensors need not know the parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.solving.bundle import border_frames
from kinefit.solving.bundle.arrow import Arrow, Blocks
from kinefit.solving.equations import lock
from kinefit.solving.least_squares import Damping, bounds_of, descend

_INITIAL_DAMPING = 1e-3  # as a share of the poses' mean diagonal
_PARAMETER_DAMPING_RATIO = 0.01  # to the poses' damping: parameters have a prior, few angles have one
_MAX_REUSE_CHANGE = 0.02  # [m, rad] of poses (RMS) plus parameters (largest), within which derivatives are reused
_MIN_POSE_DAMPING = 0.3  # [1/m², 1/rad²] of poses in steps with parameters


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of the parameters.

    Parameters
    ----------
    mean : (p,)
    information : (p, p) inverse covariance; zero for a parameter without a prior
    """

    mean: NDArray
    information: NDArray


@dataclass(frozen=True, eq=False)
class Bordered:
    """The result of a fit of poses and shared parameters.

    Parameters
    ----------
    theta : (p,) parameters
    states : K states
    prior : Prior
    cost : float, of rows, postures and prior
    iterations : int, number of steps tried
    converged : bool, False if the iterations were used up
    compute_information : function that computes `information` on demand
    """

    theta: NDArray
    states: tuple[BodyState, ...]
    prior: Prior
    cost: float
    iterations: int
    converged: bool
    compute_information: Callable[[], NDArray]

    @cached_property
    def information(self) -> NDArray:
        """Information (p, p) of the rows on θ, every pose eliminated, without the prior."""
        return self.compute_information()


def solve(
    problem: border_frames.BorderedProblem,
    theta: NDArray,
    states: Sequence[BodyState],
    prior: Prior,
    steps: NDArray,
    *,
    weighing: border_frames.Weighing | None = None,
    iterations: tuple[int, int] = (20, border_frames.MAX_POSE_STEPS),
    tolerance: float = 1e-4,
) -> Bordered:
    """Minimise Σ share·ρ(w r²) over K poses and the parameters that they share, prior and postures included.

    Parameters
    ----------
    problem : BorderedProblem
    theta : (p,) to start from
    states : K states to start from; coordinates stay within their limits
    prior : Prior
    steps : (p,) of the central differences; parameters should be scaled to about a metre or a radian
    weighing : shares of sensors and of the posture prior, and the loss of rows without their own
    iterations : at most, steps with the parameters, and steps of the poses alone after each
    tolerance : stop when the predicted fall of the cost is below this share of it

    Raises
    ------
    ObservationError
        A sensor's rows differ in number between two worlds; rows on segments that the body lacks.
    """
    task = _Task(problem, prior, np.asarray(steps, float), weighing or border_frames.Weighing(), iterations[1])
    bounds = bounds_of(problem.body(np.asarray(theta, float)), True)
    start = task.at(np.array(theta, float), [s.retract(np.zeros(6 + len(s.angles)), bounds) for s in states])
    mean = float(np.mean([np.trace(f.H) / len(f.H) for f in start.frames])) if start.frames else 1.0
    end = descend(
        start, _Point.step, _Point.follow, iterations=iterations[0], tolerance=tolerance,
        damping=Damping(_INITIAL_DAMPING).times(mean),
    )  # fmt: skip
    at = end.at
    return Bordered(at.theta, tuple(at.states), prior, at.cost, end.iterations, end.converged, at.information)


@dataclass(frozen=True, eq=False)
class _Task:
    """A problem with its prior, difference steps, weights, and number of steps of the poses alone."""

    problem: border_frames.BorderedProblem
    prior: Prior
    steps: NDArray
    weighing: border_frames.Weighing
    settling: int

    def at(self, theta: NDArray, states: Sequence[BodyState]) -> _Point:
        """The point with parameters (p,) and near states, each pose fitted alone."""
        frames, states = border_frames.settle(self.problem, theta, states, self.weighing, self.settling)
        away = theta - self.prior.mean
        cost = float(away @ self.prior.information @ away) + sum(f.cost for f in frames)
        return _Point(self, theta, states, frames, cost)


@dataclass(frozen=True, eq=False)
class _Point:
    """Parameters, states and their frames' equations; cost of rows, postures and prior.

    `known` are used rows and derivatives of an earlier point, and `change` the way from it.
    """

    task: _Task
    theta: NDArray
    states: Sequence[BodyState]
    frames: Sequence[border_frames.FrameEquations]
    cost: float
    known: tuple[list[NDArray], list[NDArray]] | None = None
    change: float = 0.0

    @cached_property
    def used(self) -> list[NDArray]:
        """(N,) bool of every frame: rows with a weight above 0."""
        return [frame.used for frame in self.frames]

    @cached_property
    def by_theta(self) -> list[NDArray]:
        """(N, p) of every frame: whitened derivatives, without robust factors; known ones if the used rows are same."""
        if self.known is not None and all(map(np.array_equal, self.known[0], self.used)):
            return self.known[1]
        return border_frames.differences(self.task.problem, self.theta, self.task.steps, self.states)

    @cached_property
    def _open(self) -> Arrow:
        """The equations without the prior, as if all coordinates moved."""
        p, n, F = len(self.theta), len(self.frames[0].g) if self.frames else 0, len(self.frames)
        S, b, H, g, B = np.zeros((p, p)), np.zeros(p), np.empty((F, n, n)), np.empty((F, n)), np.empty((F, n, p))
        for f, (frame, D, used) in enumerate(zip(self.frames, self.by_theta, self.used, strict=True)):
            T = (frame.factor * used)[:, None] * D
            S += border_frames.gram(T, T)
            b += frame.residual @ T
            H[f], g[f], B[f] = frame.H, frame.g, border_frames.gram(frame.J, T)
        return Arrow(S, b, (Blocks(H, g, B),))

    @cached_property
    def _held(self) -> Arrow:
        """The equations with the prior; coordinates at a limit do not move."""
        prior, held = self.task.prior, np.array([frame.held for frame in self.frames])
        arrow = self._open.holding(held)
        return arrow.with_prior(prior.information, prior.information @ (prior.mean - self.theta))

    def step(self, damping: float) -> tuple[tuple[NDArray, list[NDArray]], float]:
        """δθ (p,) and each pose's δ (n,), and the predicted fall of the cost."""
        # weakly constrained angles move in steps of the poses alone
        of_poses = np.full(self._held.blocks[0].g.shape, damping + _MIN_POSE_DAMPING * self.task.weighing.most)
        return self._held.step(np.full(len(self.theta), _PARAMETER_DAMPING_RATIO * damping), [of_poses])

    def follow(self, move: tuple[NDArray, list[NDArray]]) -> _Point:
        """The point after a step."""
        (delta, (moves,)), theta = move, self.theta + move[0]
        bounds = bounds_of(self.task.problem.body(theta), True)
        new = self.task.at(theta, [s.retract(m, bounds) for s, m in zip(self.states, moves, strict=True)])
        turns = np.array([a.difference(b) for a, b in zip(self.states, new.states)])
        change = self.change + float(np.sqrt(np.mean(np.square(turns))) + np.abs(delta).max())
        return replace(new, known=(self.used, self.by_theta), change=change) if change <= _MAX_REUSE_CHANGE else new

    def information(self) -> NDArray:
        """Information (p, p) of all frames on θ, their poses eliminated; joint limits do not count."""
        known = lock(self.task.problem.body(self.theta), None)
        arrow = self._open.holding(np.tile(known, (len(self.frames), 1)))
        S = arrow.reduced(np.zeros(len(self.theta)), [np.zeros(arrow.blocks[0].g.shape)])[0]
        return 0.5 * (S + S.T)
