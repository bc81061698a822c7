"""Levenberg-Marquardt with absolute adaptive damping, and the single Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState
from kinefit.losses import SQUARED, Loss
from kinefit.rows import AnyRows
from kinefit.solvers import _kernels_linear
from kinefit.solvers.equations import Equations, lock, normal_equations

_MAX_TRIES = 30  # of more damping, for a matrix that is not positive definite

LEAST_SCALED_DAMPING = 1e-9
"""Least λ of solvers that scale each diagonal element of H by 1 + λ (bundle adjustment). Only it fixes a free gauge."""

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


def relax(damping: float) -> float:
    """Reduce the λ (unitless) that scales the diagonal of H, after a step that lowered the cost."""
    return max(0.1 * damping, LEAST_SCALED_DAMPING)


State = TypeVar("State")


def descend(
    state: State, cost_of: Callable[[State], float], step: Callable[[State, float], State | None], *, iterations: int,
    tolerance: float, damping: float = 1e-4, most: float = 1e8,
) -> tuple[State, float]:  # fmt: skip
    """Minimise a cost by steps whose damping grows until they lower it; returns the state and its cost.

    Parameters
    ----------
    step : (state, λ) -> state after a step with λ times the diagonal of H added to H; None if H is singular
    tolerance : stop when a step lowers the cost by less than this share of it
    damping, most : first λ, and the λ at which the search ends; unitless
    """
    cost = cost_of(state)
    for _ in range(iterations):
        before = cost
        while damping < most:
            trial = step(state, damping)
            if trial is not None and (new := cost_of(trial)) < cost:
                state, cost, damping = trial, new, relax(damping)
                break
            damping *= 10.0
        if not before - cost > tolerance * cost:
            break
    return state, cost


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
    state = state.retract(np.zeros(body.tree.n_dofs), bounds)
    eq = normal_equations(body, state, make_rows(state), loss=loss)
    mean = float(eq.diagonal.mean()) + 1e-300
    least = _kernels_linear.LEAST_DAMPING * mean
    damping, growth = (0.1 * mean if damping is None else max(damping, least)), 2.0
    nothing = 1e-16 * eq.cost
    for iteration in range(1, max_iterations + 1):
        delta, predicted = _step(eq, damping, bounds, held)
        if predicted < 0.0:
            damping, growth = _kernels_linear.adapt(damping, growth, -1.0, 1.0, least)
            continue
        if predicted <= tolerance * eq.cost + nothing:
            return Fit(state, eq, iteration, True, damping)
        candidate = state.retract(delta, bounds)
        new = normal_equations(body, candidate, make_rows(candidate), loss=loss)
        damping, growth = _kernels_linear.adapt(damping, growth, eq.cost - new.cost, predicted, least)
        if new.cost < eq.cost:
            state, eq = candidate, new
        elif damping > 1e16 * mean:
            return Fit(state, eq, iteration, True, damping)
    return Fit(state, eq, max_iterations, False, damping)
