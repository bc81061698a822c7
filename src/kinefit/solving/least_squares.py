"""Levenberg-Marquardt with absolute adaptive damping, and the single Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving import _kernels_linear
from kinefit.solving.equations import Equations, lock, normal_equations
from kinefit.solving.rows import AnyRows

_MAX_TRIES = 30  # of more damping, for a matrix that is not positive definite

MAX_DAMPING = 1e8
"""λ as a share of H's diagonal, above which no step lowers the cost."""

MakeRows = Callable[[BodyState], AnyRows | Iterable[AnyRows]]


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit.

    Parameters
    ----------
    state : BodyState
    equations : Equations, undamped, at that state
    iterations : int, number of steps tried
    converged : bool, False if the iterations were used up
    damping : float, last λ: a good start for the next frame
    """

    state: BodyState
    equations: Equations
    iterations: int
    converged: bool
    damping: float


@dataclass(frozen=True, eq=False)
class Step:
    """One Gauss-Newton step: the new state, δ (n,) and its norm, and the equations before it."""

    state: BodyState
    delta: NDArray
    norm: float
    equations: Equations

    @property
    def cost(self) -> float:
        """Cost of the state before the step, in squared standard deviations (no unit)."""
        return self.equations.cost


class WithCost(Protocol):
    """A problem linearised at some values of its unknowns."""

    @property
    def cost(self) -> float:
        """Cost of these values, in squared standard deviations."""
        ...


At = TypeVar("At", bound=WithCost)
Move = TypeVar("Move")


@dataclass(frozen=True, eq=False)
class Descent(Generic[At]):
    """The end of `descend`.

    Parameters
    ----------
    at : the problem there
    iterations : int, number of steps tried
    converged : bool, False if the iterations were used up
    damping : float, last λ
    """

    at: At
    iterations: int
    converged: bool
    damping: float


@dataclass(frozen=True)
class Damping:
    """First λ of `descend`, the least, and the λ at which the search ends, in the unit of its steps."""

    first: float
    least: float = _kernels_linear.LEAST_DAMPING
    most: float = MAX_DAMPING

    def times(self, mean: float) -> Damping:
        """The same of steps whose λ is absolute, for shares of H's mean diagonal (a number in H's unit)."""
        return Damping(self.first * mean, self.least * mean, self.most * mean)


def descend(
    at: At, solve: Callable[[At, float], tuple[Move, float]], follow: Callable[[At, Move], At | None], *,
    iterations: int, tolerance: float, damping: Damping, nothing: float = 1e-300, last: bool = False,
) -> Descent[At]:  # fmt: skip
    """Minimise a cost by damped Gauss-Newton steps, their damping adapted by Nielsen's rule.

    Parameters
    ----------
    at : the problem to start from
    solve : (problem, λ) -> step, and the fall of the cost that it predicts; negative if H is not positive definite
    follow : (problem, step) -> the problem after the step; None if that is impossible
    iterations : number of steps tried, at most
    tolerance, nothing : stop when the predicted fall of the cost is below this share of it plus `nothing`
    damping : of `solve`
    last : whether the step that ends it is taken, too
    """
    now, growth = damping.first, 2.0
    for tried in range(1, iterations + 1):
        move, predicted = solve(at, now)
        if predicted < 0.0:
            now, growth = _kernels_linear.adapt(now, growth, -1.0, 1.0, damping.least)
            continue
        converged = predicted <= tolerance * at.cost + nothing
        if converged and not last:
            return Descent(at, tried, True, now)
        new = follow(at, move)
        fall = -1.0 if new is None else at.cost - new.cost
        now, growth = _kernels_linear.adapt(now, growth, fall, predicted, damping.least)
        if new is not None and fall > 0.0:
            at = new
        else:
            converged |= now > damping.most
        if converged:
            return Descent(at, tried, True, now)
    return Descent(at, iterations, False, now)


def _step(eq: Equations, damping: float, bounds: tuple[NDArray, NDArray], locked: NDArray) -> tuple[NDArray, float]:
    n = len(eq.gradient)
    L, delta = np.empty(eq.chain.shape), np.empty(n)
    fall = _kernels_linear.damped_step(
        eq.packed, eq.gradient, damping, eq.chain, eq.depth, eq.state.angles, bounds[0], bounds[1], locked, L, delta,
    )  # fmt: skip
    return delta, fall


def bounds_of(body: Body, limits: bool) -> tuple[NDArray, NDArray]:
    """(D,) lower and upper limits of every coordinate; infinite if `limits` is False."""
    if limits:
        return body.tree.lower, body.tree.upper
    free = np.full(len(body.tree.coordinates), np.inf)
    return -free, free


@checked
def gauss_newton(
    body: Body,
    state: BodyState,
    rows: AnyRows | Iterable[AnyRows],
    *,
    loss: Loss = SQUARED,
    limits: bool = True,
    damping: float = 0.0,
    locked: NDArray | None = None,
) -> Step:
    """One step of (H + λ) δ = g for rows linearised at `state`, for loops that make new rows at every step (ICP).

    Parameters
    ----------
    limits : bool
        Whether coordinates stay within their limits.
    damping : float
        λ, added to the diagonal; at least `LEAST_DAMPING` times H's mean diagonal.
    locked : (n,) bool
        Degrees of freedom that do not move.
    """
    eq = normal_equations(body, state, rows, loss=loss)
    bounds, held = bounds_of(body, limits), lock(body, locked)
    damping = max(damping, _kernels_linear.LEAST_DAMPING * float(eq.diagonal.mean()) + 1e-300)
    delta, fall = _step(eq, damping, bounds, held)
    for _ in range(_MAX_TRIES):
        if fall >= 0:
            break
        damping *= 100.0
        delta, fall = _step(eq, damping, bounds, held)
    return Step(state.retract(delta, bounds), delta, float(np.linalg.norm(delta)), eq)


@checked
def levenberg_marquardt(
    body: Body,
    state: BodyState,
    make_rows: MakeRows,
    *,
    loss: Loss = SQUARED,
    limits: bool = True,
    locked: NDArray | None = None,
    damping: float | None = None,
    max_iterations: int = 50,
    tolerance: float = 1e-9,
) -> Fit:
    """Minimise Σ ρ(w r²) over the body's state.

    Parameters
    ----------
    make_rows : state -> rows
        Called at every state tried, so rows are exact there.
    limits : bool
        Whether coordinates stay within their limits.
    locked : (6 + D,) bool
        Degrees of freedom that do not move.
    damping : float
        First λ, absolute (in the units of H); default: a tenth of H's mean diagonal.
    tolerance : float
        Stop when the predicted fall of the cost is below this share of it, or below 1e-16 of the first cost.
    """
    bounds, held = bounds_of(body, limits), lock(body, locked)

    def follow(eq: Equations, delta: NDArray) -> Equations:
        moved = eq.state.retract(delta, bounds)
        return normal_equations(body, moved, make_rows(moved), loss=loss)

    state = state.retract(np.zeros(body.tree.n_dofs), bounds)
    start = normal_equations(body, state, make_rows(state), loss=loss)

    def solve(eq: Equations, damping: float) -> tuple[NDArray, float]:
        return _step(eq, damping, bounds, held)

    return fitted(start, solve, follow, damping, max_iterations, tolerance)


def fitted(
    start: Equations, solve: Callable[[Equations, float], tuple[NDArray, float]],
    follow: Callable[[Equations, NDArray], Equations | None], damping: float | None, iterations: int, tolerance: float,
) -> Fit:  # fmt: skip
    """The end of `descend` from a pose's equations, with the damping of `levenberg_marquardt`."""
    mean = float(start.diagonal.mean()) + 1e-300
    least = _kernels_linear.LEAST_DAMPING * mean
    end = descend(
        start, solve, follow, iterations=iterations, tolerance=tolerance, nothing=1e-16 * start.cost,
        damping=Damping(0.1 * mean if damping is None else max(damping, least), least, 1e16 * mean),
    )  # fmt: skip
    return Fit(end.at.state, end.at, end.iterations, end.converged, end.damping)
