"""Poses of many frames with a border of parameters that they share: damped Gauss-Newton, the poses eliminated.

The normal equations of K frames and p parameters θ have the shape of an arrow: each frame's pose meets only itself and
θ. Taking the poses out (Schur complement) leaves p equations, so the cost grows linearly with the frames. Derivatives
by θ are central differences of whitened residuals √w·r of the same correspondences in two worlds, with the robust
factors held: no sensor needs to know of a parameter.
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
    SETTLING,
    BorderedProblem,
    FrameEquations,
    Weighing,
    differences,
    gram,
    limits,
    settle,
    solved,
)
from kinefit.solvers.equations import lock

_FIRST = 1e-3  # damping to begin with, as a share of the poses' mean diagonal
_STIFF = 0.01  # of the poses' damping that parameters have: their prior holds them, few angles have one
_MOST = 1e8  # damping, as such a share, at which nothing is left to be gained
_NEAR = 0.02  # [m, rad] of moves, typical of poses and most of parameters, within which derivatives stay as they are
_LEAST = 0.3  # [1/m², 1/rad²] damping of poses when they move with parameters


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the parameters before.

    Parameters
    ----------
    mean : (p,)
    information : (p, p) inverse covariance; zero for a parameter of which nothing is known.
    """

    mean: NDArray
    information: NDArray


@dataclass(frozen=True, eq=False)
class Bordered:
    """Where a fit of poses and shared parameters ended.

    Parameters
    ----------
    theta : (p,)
    states : K states
    prior : Prior
    cost : float, of rows, postures and prior.
    iterations : int, steps tried.
    converged : bool, False when the iterations were used up.
    told : function that makes `information`, when it is asked for.
    """

    theta: NDArray
    states: tuple[BodyState, ...]
    prior: Prior
    cost: float
    iterations: int
    converged: bool
    told: Callable[[], NDArray]

    @cached_property
    def information(self) -> NDArray:
        """(p, p) what the rows tell of θ, every pose eliminated; without the prior."""
        return self.told()


@dataclass(frozen=True, eq=False)
class _Block:
    """One frame's part of the arrow."""

    frame: FrameEquations
    by_theta: NDArray  # (N, p) whitened, as it was found
    felt: NDArray  # (N,) bool
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
    iterations: tuple[int, int] = (20, SETTLING),
    tolerance: float = 1e-4,
) -> Bordered:
    """Minimise Σ share·ρ(w r²) over K poses and the parameters that they share, prior and postures included.

    Parameters
    ----------
    problem : BorderedProblem
    theta : (p,) to start from.
    states : K, to start from; limits of joints hold.
    prior : Prior
    steps : (p,) of the central differences; parameters are in units of which one is about a metre or a radian.
    weighing : how much sensors and the posture prior count, and the loss of rows without their own.
    iterations : steps with the parameters, and those that poses take by themselves after each one, at most.
    tolerance : stop when the predicted fall of the cost is below this share of it.

    Raises
    ------
    ObservationError
        A sensor whose rows differ in number between two worlds; rows that the body cannot take.
    """
    task = _Task(problem, prior, np.asarray(steps, float), weighing or Weighing())
    theta, bounds, (most, settling) = np.array(theta, float), limits(problem.body(theta)), iterations
    states = [s.retract(np.zeros(6 + len(s.angles)), bounds) for s in states]
    frames, states = settle(problem, theta, states, task.weighing, settling)
    cost, blocks, near = task.cost(theta, frames), None, None
    mean = float(np.mean([np.trace(f.H) / len(f.H) for f in frames])) if frames else 1.0
    least = _kernels_linear.LEAST_DAMPING * mean
    damping, growth, converged, tried, far = _FIRST * mean, 2.0, False, 0, 0.0
    while tried < most and not converged:
        tried += 1
        if blocks is None:  # not before it is needed: derivatives by θ are most of the work
            blocks = task.blocks(theta, states, frames, near)
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
            far += float(np.sqrt(np.mean(np.square(turns))) + np.abs(delta).max())
            theta, states, frames, cost = trial, moved, settled, new
            near = blocks if far <= _NEAR else None
            far, blocks = far if near else 0.0, None
        elif damping > _MOST * mean:
            converged = True

    def told() -> NDArray:
        last = task.blocks(theta, states, frames, near) if blocks is None else blocks
        return _information(last, len(theta), lock(problem.body(theta), None))

    return Bordered(theta, tuple(states), prior, cost, tried, converged, told)


@dataclass(frozen=True, eq=False)
class _Task:
    """A problem with all that weighs it."""

    problem: BorderedProblem
    prior: Prior
    steps: NDArray
    weighing: Weighing

    @property
    def _least(self) -> float:
        """Damping of poses in steps with θ: angles that hardly anything holds settle by themselves."""
        return _LEAST * self.weighing.most

    def cost(self, theta: NDArray, frames: Sequence[FrameEquations]) -> float:
        """Of rows, postures and prior."""
        away = theta - self.prior.mean
        return float(away @ self.prior.information @ away) + sum(f.cost for f in frames)

    def blocks(
        self,
        theta: NDArray,
        states: Sequence[BodyState],
        frames: Sequence[FrameEquations],
        near: Sequence[_Block] | None,
    ) -> list[_Block]:
        """The frames' parts of the arrow, with the derivatives by θ of `near` blocks where those will do."""
        felt = [frame.felt for frame in frames]
        if near is not None and all(np.array_equal(a.felt, b) for a, b in zip(near, felt, strict=True)):
            by_theta = [block.by_theta for block in near]
        else:
            by_theta = differences(self.problem, theta, self.steps, states)
        out = []
        for frame, D, some in zip(frames, by_theta, felt, strict=True):
            T = (frame.factor * some)[:, None] * D
            out.append(_Block(frame, D, some, gram(frame.J, T), gram(T, T), frame.left @ T))
        return out

    def step(self, theta: NDArray, blocks: Sequence[_Block], damping: float) -> tuple[NDArray, list[NDArray], float]:
        """δθ (p,), each pose's δ (n,), and the predicted fall of the cost."""
        p = len(theta)
        S = self.prior.information + _STIFF * damping * np.eye(p)
        pull = self.prior.information @ (self.prior.mean - theta)
        b, kept = pull.copy(), []
        for block in blocks:
            frame = block.frame
            back = solved(frame.H, np.column_stack([block.B, frame.g]), frame.held, damping + self._least)
            both = gram(block.B, back)
            S += block.S - both[:, :p]
            b += block.b - both[:, p]
            kept.append(back)
        delta = np.linalg.solve(S, b)
        moves = [back[:, p] - back[:, :p] @ delta for back in kept]
        fall = float(delta @ pull) + _STIFF * damping * float(delta @ delta)
        for block, move in zip(blocks, moves, strict=True):
            fall += float(block.b @ delta + block.frame.g @ move) + (damping + self._least) * float(move @ move)
        return delta, moves, fall


def _information(blocks: Sequence[_Block], p: int, known: NDArray) -> NDArray:
    """(p, p) what all frames tell of θ with their poses unknown; limits of joints tell nothing."""
    out = np.zeros((p, p))
    for block in blocks:
        out += block.S - gram(block.B, solved(block.frame.H, block.B, known, 0.0))
    return 0.5 * (out + out.T)
