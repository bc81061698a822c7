"""Levenberg-Marquardt with absolute adaptive damping, and the single Gauss-Newton step.

Fit a pose to pixels, a predicted pose and the posture prior: `levenberg_marquardt` in one compiled kernel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving import _kernels, _kernels_linear
from kinefit.solving.equations import Equations, dense_pattern, lock, normal_equations
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


INITIAL_DAMPING = 1e-3
"""First damping with a prediction of every degree of freedom; without one, it is multiplied by H's mean diagonal."""


class PixelPoints(NamedTuple):
    """N points of a body in `camera` (N,) of a rig: `uv` (N, 2) [px], `weight` (N,) [1/px²], a loss of one scale."""

    points: PointSet
    camera: NDArray
    uv: NDArray
    weight: NDArray
    loss: Loss


class PixelFit(NamedTuple):
    """The end of a fit: state, `H` (n, n) and `g` (n,) of its normal equations, cost, and number of steps tried."""

    state: BodyState
    H: NDArray
    g: NDArray
    cost: float
    iterations: int


def fit_pixels(
    body: Body, state: BodyState, rig: Rig, pixels: PixelPoints, held: tuple[BodyState, NDArray] | None, *,
    max_iterations: int, tolerance: float, posture: float = 1.0,
) -> PixelFit | None:  # fmt: skip
    """Minimise Σ ρ over pixels, the prediction and the posture prior, from a start state.

    The steps are those of `levenberg_marquardt`, up to rounding, in a fifth of the time, since no rows are made.

    Parameters
    ----------
    state : to start from
    pixels : N points of the body, in images (N, 2) [px]
    held : predicted state and its information (n, n); None for no prediction
    max_iterations, tolerance : see `levenberg_marquardt`
    posture : share of the posture prior

    Returns
    -------
    None if an input is not finite
    """
    tree, n = body.tree, body.tree.n_dofs
    predicted, information = held or (state, np.zeros((n, n)))
    posed, precision = tree.held_by_posture
    roots, angles = np.empty((2, 4, 4)), np.empty((2, n - 6))
    roots[0], angles[0] = state.T_world_root, state.angles
    H, g = np.empty((2, n, n)), np.empty((2, n))
    best, cost, tried = _kernels.minimum(
        tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, tree.chain, tree.depth, *dense_pattern(n),
        tree.lower, tree.upper, lock(body, None), pixels.points.segments, body.points_rest(pixels.points), rig.packed,
        pixels.camera, pixels.uv, pixels.weight, pixels.loss.kind, float(pixels.loss.scale), predicted.T_world_root,
        predicted.angles, information, posed, tree.usual,
        posture * (precision if precision.ndim == 2 else np.diag(precision)), roots, angles, H, g, max_iterations,
        tolerance, INITIAL_DAMPING, 0.0 if held else INITIAL_DAMPING,
    )  # fmt: skip
    if best < 0:
        return None
    _kernels.mirror(H[best])
    return PixelFit(BodyState(roots[best], angles[best]), H[best], g[best], cost, tried)
