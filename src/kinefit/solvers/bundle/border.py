"""Fit poses of many frames and parameters that they share: damped Gauss-Newton, the poses eliminated.

The normal equations of K frames and p parameters θ have the shape of an arrow: each frame's pose is coupled to itself
and θ only. Eliminating the poses (Schur complement) leaves p equations, so the cost grows linearly with the frames.
Derivatives by θ are central differences of whitened residuals √w·r of the same correspondences in two worlds, for fixed
robust factors. So sensors need not know the parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.solvers import _kernels_linear
from kinefit.solvers.bundle.border_frames import (
    MAX_POSE_STEPS,
    BorderedProblem,
    FrameEquations,
    Weighing,
    differences,
    gram,
    settle,
    solved,
)
from kinefit.solvers.equations import lock
from kinefit.solvers.least_squares import bounds_of

_INITIAL_DAMPING = 1e-3  # as a share of the poses' mean diagonal
_PARAMETER_DAMPING_RATIO = 0.01  # to the poses' damping: parameters have a prior, few angles have one
_MAX_DAMPING = 1e8  # as a share of the poses' mean diagonal: with more the cost cannot fall
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


@dataclass(frozen=True, eq=False)
class _Block:
    """One frame's part of the arrow."""

    frame: FrameEquations
    by_theta: NDArray  # (N, p) whitened derivatives, without robust factors
    used: NDArray  # (N,) bool, rows with a weight above 0
    B: NDArray  # (n, p)
    S: NDArray  # (p, p)
    b: NDArray  # (p,)


def solve(
    problem: BorderedProblem,
    theta: NDArray,
    states: Sequence[BodyState],
    prior: Prior,
    steps: NDArray,
    *,
    weighing: Weighing | None = None,
    iterations: tuple[int, int] = (20, MAX_POSE_STEPS),
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
    task = _Task(problem, prior, np.asarray(steps, float), weighing or Weighing())
    theta, bounds, (most, settling) = np.array(theta, float), bounds_of(problem.body(theta), True), iterations
    states = [s.retract(np.zeros(6 + len(s.angles)), bounds) for s in states]
    frames, states = settle(problem, theta, states, task.weighing, settling)
    cost, blocks, reusable = task.cost(theta, frames), None, None
    mean = float(np.mean([np.trace(f.H) / len(f.H) for f in frames])) if frames else 1.0
    least = _kernels_linear.LEAST_DAMPING * mean
    damping, growth, converged, tried, change = _INITIAL_DAMPING * mean, 2.0, False, 0, 0.0
    while tried < most and not converged:
        tried += 1
        if blocks is None:  # on demand: derivatives by θ are most of the work
            blocks = task.blocks(theta, states, frames, reusable)
        delta, moves, predicted = task.step(theta, blocks, damping)
        if predicted <= tolerance * cost + 1e-300:
            converged = True
            continue
        trial = theta + delta
        moved = [s.retract(m, bounds) for s, m in zip(states, moves, strict=True)]
        settled, moved = settle(problem, trial, moved, task.weighing, settling)
        new = task.cost(trial, settled)
        damping, growth = _kernels_linear.adapt(damping, growth, cost - new, predicted, least)
        if new < cost:
            turns = np.array([a.difference(b) for a, b in zip(states, moved)])
            change += float(np.sqrt(np.mean(np.square(turns))) + np.abs(delta).max())
            theta, states, frames, cost = trial, moved, settled, new
            reusable = blocks if change <= _MAX_REUSE_CHANGE else None
            change, blocks = change if reusable else 0.0, None
        elif damping > _MAX_DAMPING * mean:
            converged = True

    def compute_information() -> NDArray:
        last = task.blocks(theta, states, frames, reusable) if blocks is None else blocks
        return _information(last, len(theta), lock(problem.body(theta), None))

    return Bordered(theta, tuple(states), prior, cost, tried, converged, compute_information)


@dataclass(frozen=True, eq=False)
class _Task:
    """A problem with its prior, difference steps and weights."""

    problem: BorderedProblem
    prior: Prior
    steps: NDArray
    weighing: Weighing

    @property
    def _least(self) -> float:
        """Damping of poses in steps with θ; weakly constrained angles then move in steps of the poses alone."""
        return _MIN_POSE_DAMPING * self.weighing.most

    def cost(self, theta: NDArray, frames: Sequence[FrameEquations]) -> float:
        """Cost of rows, postures and prior, with parameters (p,)."""
        away = theta - self.prior.mean
        return float(away @ self.prior.information @ away) + sum(f.cost for f in frames)

    def blocks(
        self,
        theta: NDArray,
        states: Sequence[BodyState],
        frames: Sequence[FrameEquations],
        reusable: Sequence[_Block] | None,
    ) -> list[_Block]:
        """The frames' parts of the arrow, with derivatives by θ of `reusable` blocks if the used rows are the same."""
        used = [frame.used for frame in frames]
        if reusable is not None and all(np.array_equal(a.used, b) for a, b in zip(reusable, used, strict=True)):
            by_theta = [block.by_theta for block in reusable]
        else:
            by_theta = differences(self.problem, theta, self.steps, states)
        out = []
        for frame, D, some in zip(frames, by_theta, used, strict=True):
            T = (frame.factor * some)[:, None] * D
            out.append(_Block(frame, D, some, gram(frame.J, T), gram(T, T), frame.residual @ T))
        return out

    def step(self, theta: NDArray, blocks: Sequence[_Block], damping: float) -> tuple[NDArray, list[NDArray], float]:
        """δθ (p,), each pose's δ (n,), and the predicted fall of the cost."""
        p = len(theta)
        S = self.prior.information + _PARAMETER_DAMPING_RATIO * damping * np.eye(p)
        pull = self.prior.information @ (self.prior.mean - theta)
        b, solutions = pull.copy(), []
        for block in blocks:
            frame = block.frame
            back = solved(frame.H, np.column_stack([block.B, frame.g]), frame.held, damping + self._least)
            both = gram(block.B, back)
            S += block.S - both[:, :p]
            b += block.b - both[:, p]
            solutions.append(back)
        delta = np.linalg.solve(S, b)
        moves = [back[:, p] - back[:, :p] @ delta for back in solutions]
        fall = float(delta @ pull) + _PARAMETER_DAMPING_RATIO * damping * float(delta @ delta)
        for block, move in zip(blocks, moves, strict=True):
            fall += float(block.b @ delta + block.frame.g @ move) + (damping + self._least) * float(move @ move)
        return delta, moves, fall


def _information(blocks: Sequence[_Block], p: int, known: NDArray) -> NDArray:
    """Information (p, p) of all frames on θ, their poses eliminated; joint limits do not count."""
    out = np.zeros((p, p))
    for block in blocks:
        out += block.S - gram(block.B, solved(block.frame.H, block.B, known, 0.0))
    return 0.5 * (out + out.T)
