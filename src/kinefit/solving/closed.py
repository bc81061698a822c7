"""Fit a body under equality constraints: hard closures (P3 3.2, as an equality-constrained step).

With H the normal matrix, g the gradient, A the Jacobian of the constraints c = 0, and Z a basis of its null space, a
step is

    δ = −A⁺ c + Z (Zᵀ (H + λ) Z)⁻¹ Zᵀ (g + (H + λ) A⁺ c)

It solves the Karush-Kuhn-Tucker system without multipliers, for redundant constraints too. Every trial state is
projected onto c = 0 before its cost is compared. Covariances are restricted to the null space of A. If the gradient is
a force, the multipliers of c = 0 are the forces in the closures: `closure_forces`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import BodyError, check_choice
from kinefit.solving import _kernels_linear
from kinefit.solving.correspondences.closures import closed_at
from kinefit.solving.equations import Equations, lock, normal_equations
from kinefit.solving.least_squares import Fit, MakeRows, Step, bounds_of, fitted
from kinefit.solving.rows import AnyRows

CLOSED = 1e-9
"""[m, rad] largest residual of an equation that counts as satisfied."""

_MIN_RESIDUAL = 1e-13  # [m, rad] below which no further step is taken; far from the world's origin rounding is larger
_MIN_SINGULAR_RATIO = 1e-7  # to the largest singular value of A: below it an equation is redundant
_MIN_SELF_STRESS = 1e-7  # of a unit set of forces that balances itself: a force or torque with less is determined
_MAX_UNBALANCED = 1e-6  # of the largest load
_MAX_PROJECTION_STEPS = 30  # Newton steps onto the equations
_MAX_LIMIT_ROUNDS = 6  # of stopping coordinates at limits that a step would exceed

Constraint = Callable[[BodyState], tuple[NDArray, NDArray]]
"""State -> c (m,) and its Jacobian A (m, n)."""


@dataclass(frozen=True, eq=False)
class Null:
    """Null space of equations, and the step onto them.

    Parameters
    ----------
    free : (n, n − r) Z, orthonormal directions along which the equations do not change; zero for held coordinates
    back : (n,) −A⁺ c, the shortest step onto the equations
    """

    free: NDArray
    back: NDArray


def null_space(A: NDArray, c: NDArray, held: NDArray) -> Null:
    """Null space of equations with Jacobian A (m, n) and values c (m,); degrees of freedom `held` (n,) bool stay."""
    open_to = np.flatnonzero(~held)
    U, s, Vt = np.linalg.svd(A[:, open_to])
    rank = int(np.sum(s > _MIN_SINGULAR_RATIO * max(float(s.max(initial=0.0)), 1e-12)))
    free, back = np.zeros((A.shape[1], len(open_to) - rank)), np.zeros(A.shape[1])
    free[open_to] = Vt[rank:].T
    back[open_to] = -Vt[:rank].T @ ((U[:, :rank].T @ c) / s[:rank])
    return Null(free, back)


def onto(
    body: Body, state: BodyState, constraint: Constraint, *, limits: bool = True, locked: NDArray | None = None,
    steps: int = _MAX_PROJECTION_STEPS,
) -> tuple[BodyState, float]:  # fmt: skip
    """Project a state onto equations; returns the nearest state found and its largest residual [m, rad].

    Parameters
    ----------
    limits : whether coordinates stay within their limits
    locked : (n,) bool, degrees of freedom that do not move
    steps : Newton steps at most
    """
    bounds, fixed = bounds_of(body, limits), lock(body, locked)
    c, A = constraint(state)
    worst, best = float(np.abs(c).max(initial=0.0)), float(c @ c)
    for _ in range(steps):
        if worst <= _MIN_RESIDUAL:
            break
        share, stops = 1.0, np.zeros(len(fixed), bool)
        for _ in range(_MAX_LIMIT_ROUNDS):
            delta = null_space(*_stopped(A, c, state, stops, bounds), fixed).back
            out = _beyond(state, delta, bounds) & ~stops & ~fixed
            if not out.any():
                break
            stops |= out
        moved = None
        while share > 1e-3:  # shorten a step that increases the residuals
            trial = state.retract(share * delta, bounds)
            new_c, new_A = constraint(trial)
            if float(new_c @ new_c) < best:
                moved = trial
                break
            share *= 0.3
        if moved is None:
            break
        state, c, A, best = moved, new_c, new_A, float(new_c @ new_c)
        worst = float(np.abs(c).max(initial=0.0))
    return state, worst


def _beyond(state: BodyState, delta: NDArray, bounds: tuple[NDArray, NDArray]) -> NDArray:
    """(n,) bool: coordinates that exceed their limits after a step."""
    angles = state.angles + delta[6:]
    out = np.zeros(len(delta), bool)
    out[6:] = (angles < bounds[0] - 1e-12) | (angles > bounds[1] + 1e-12)
    return out


def _stopped(
    A: NDArray, c: NDArray, state: BodyState, stops: NDArray, bounds: tuple[NDArray, NDArray]
) -> tuple[NDArray, NDArray]:
    """The equations, and further ones that move the coordinates `stops` (n,) bool to the nearer of their limits."""
    at = np.flatnonzero(stops)
    if not len(at):
        return A, c
    q = state.angles[at - 6]
    low, high = bounds[0][at - 6], bounds[1][at - 6]
    nearer = np.where(np.abs(q - low) < np.abs(q - high), q - low, q - high)
    return np.concatenate([A, np.eye(A.shape[1])[at]]), np.concatenate([c, nearer])


def _step(
    eq: Equations, damping: float, constraint: Constraint, bounds: tuple[NDArray, NDArray], locked: NDArray
) -> tuple[NDArray, float]:
    """δ (n,) of the constrained step from a state with c = 0, and the fall of the cost that it predicts."""
    state, g, (c, A) = eq.state, eq.gradient, constraint(eq.state)
    damped = eq.matrix + damping * np.eye(len(g))
    at_limit = np.zeros(len(g), bool)
    at_limit[6:] = ((state.angles <= bounds[0]) & (g[6:] < 0.0)) | ((state.angles >= bounds[1]) & (g[6:] > 0.0))
    held, stops, delta = locked | at_limit, np.zeros(len(g), bool), np.zeros(len(g))
    for _ in range(_MAX_LIMIT_ROUNDS):
        null = null_space(*_stopped(A, c, state, stops, bounds), held)
        Z = null.free
        push = Z.T @ (g - damped @ null.back)
        delta = null.back + Z @ np.linalg.solve(Z.T @ damped @ Z, push)
        out = _beyond(state, delta, bounds) & ~held & ~stops
        if not out.any():
            break
        stops |= out
    return delta, float(delta @ g) + damping * float(delta @ delta)


def closed_fit(
    body: Body, state: BodyState, make_rows: MakeRows, constraint: Constraint, *, damping: float | None = None,
    max_iterations: int = 50, tolerance: float = 1e-9,
) -> Fit:  # fmt: skip
    """Minimise Σ ρ(w r²) under equations and joint limits (Levenberg-Marquardt).

    If the equations cannot be satisfied from the start, the fit ends at the nearest state found.

    Parameters
    ----------
    make_rows, damping, max_iterations, tolerance : see `levenberg_marquardt`; tolerance is a share of the cost
    constraint : state -> values c (m,) and Jacobian A (m, n) of the equations
    """
    bounds, held = bounds_of(body, True), lock(body, None)
    state, off = onto(body, state.retract(np.zeros(body.tree.n_dofs), bounds), constraint)
    eq = normal_equations(body, state, make_rows(state))
    if off > CLOSED:
        return Fit(state, eq, 1, False, damping or 0.0)

    def solve(eq: Equations, damping: float) -> tuple[NDArray, float]:
        return _step(eq, damping, constraint, bounds, held)

    def follow(eq: Equations, delta: NDArray) -> Equations | None:
        candidate, off = onto(body, eq.state.retract(delta, bounds), constraint, steps=8)
        return normal_equations(body, candidate, make_rows(candidate)) if off <= CLOSED else None

    return fitted(eq, solve, follow, damping, max_iterations, tolerance)


def closed_step(
    body: Body, state: BodyState, rows: AnyRows | Iterable[AnyRows], constraint: Constraint
) -> Step:
    """One constrained Gauss-Newton step for rows linearised at `state`, for loops with new rows at every step (ICP)."""
    bounds, held = bounds_of(body, True), lock(body, None)
    eq = normal_equations(body, state, rows)
    damping = _kernels_linear.LEAST_DAMPING * float(eq.diagonal.mean()) + 1e-300
    delta, _ = _step(eq, damping, constraint, bounds, held)
    moved, _ = onto(body, state.retract(delta, bounds), constraint)
    return Step(moved, delta, float(np.linalg.norm(delta)), eq)


def on_null_space(covariance: NDArray, A: NDArray) -> NDArray:
    """Restrict a covariance P (n, n) to the null space of A (m, n): P − P Aᵀ (A P Aᵀ)⁺ A P."""
    if not len(A):
        return covariance
    across = A @ covariance
    S = across @ A.T
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    inner = np.linalg.pinv(S * scale[:, None] * scale[None, :], rcond=1e-12, hermitian=True)
    scaled = across * scale[:, None]
    out = covariance - scaled.T @ inner @ scaled
    return 0.5 * (out + out.T)


@dataclass(frozen=True, eq=False)
class ClosureForces:
    """Forces in the closures of a body in static equilibrium, as far as the equilibrium determines them.

    Gear that people clamp, such as a board between two boots, carries forces that active joints balance without any
    load: such forces and torques are named in `undetermined` and have no value. `str()` gives a table.

    Parameters
    ----------
    forces : {closure and direction: [N], of rotations [N m]} on each closure's `point`, in the frame of its `to` (or of
        the world); the opposite force acts on the other side
    torques : {coordinate: [N m], of slides [N]} of the active coordinates
    undetermined : names of equations and active coordinates that the equilibrium does not determine
    unbalanced : (n,) [N, N m] load on the root and the passive coordinates that no closure balances; 0 in equilibrium
    unsupported : passive coordinates whose load nothing balances: there is no equilibrium, and nothing is determined
    """

    forces: dict[str, float]
    torques: dict[str, float]
    undetermined: tuple[str, ...]
    unbalanced: NDArray
    unsupported: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.unsupported:
            stuck = ", ".join(self.unsupported)
            return f"no equilibrium: nothing balances the load on {stuck}. Name what does in `active`."
        lines = [f"{name}: {value:.1f} N{' m' * (' about ' in name)}" for name, value in self.forces.items()]
        lines += [f"torque of {name}: {value:.1f} N m" for name, value in self.torques.items()]
        if self.undetermined:
            lines.append(
                f"not determined: {', '.join(self.undetermined)}. Active joints can press these against each other "
                "without any load. Name fewer joints in `active`, those of one limb for instance, to determine more."
            )
        return "\n".join(lines)


def load_of(body: Body, state: BodyState, points: PointSet, forces: ArrayLike) -> NDArray:
    """Generalised forces (n,) [N, N m]: Σ Jₖᵀ fₖ of forces (K, 3) [N] in the world on K points of a body."""
    screws = body.tree.forward(state.T_world_root, state.angles)[1]
    x, f = body.positions(state, points) - state.T_world_root[:3, 3], np.asarray(forces, float)
    out = np.zeros(body.tree.n_dofs)
    for segment, arm, force in zip(points.segments, x, f):
        out += body.tree.segment_jacobian(screws, int(segment)).T @ np.concatenate([force, np.cross(arm, force)])
    return out


def closure_forces(
    body: Body, state: BodyState, load: NDArray, *, active: Collection[str] | None = None
) -> ClosureForces:
    """Forces in the closures of a body in static equilibrium: the multipliers λ of c = 0 in load + u + Aᵀ λ = 0.

    A is the Jacobian of all closures, u the torques of active coordinates (muscles, motors). Inertial forces of
    accelerated masses must be part of the load; kinefit does not compute them. The paper (P3) has no equation for
    forces.

    Parameters
    ----------
    load : (n,) [N, N m] on the degrees of freedom, such as from `load_of`; a joint's torque is its own entry
    active : names of the active coordinates; default: all of the person's, none of the gear's

    Raises
    ------
    BodyError
        The body has no closures, or lacks an active coordinate.
    """
    if not body.closures:
        raise BodyError(f"body '{body.name}' has no closures", remedy="Add [[closure]] to its file.")
    tree = body.tree
    if active is None:
        gear = body.gear_scale[body.segment_scale]
        active = [name for name, s in zip(tree.coordinates, tree.owners) if not gear[s]]
    for name in active:
        check_choice(f"angle of body '{body.name}'", name, tree.coordinates, BodyError)
    held = np.zeros(tree.n_dofs, bool)
    held[[6 + tree.coordinate(name) for name in active]] = True
    held[:6] = not tree.root_free
    A = closed_at(body, state).jacobian
    null = null_space(A[:, ~held].T, load[~held], np.zeros(len(A), bool))
    force, idle = null.back, null.free.T
    balance = load + A.T @ force
    names = [f"{c.name} {row}" for c in body.closures for row in c.row_names]
    joints = {name: 6 + tree.coordinate(name) for name in active}
    among = np.concatenate([idle, idle @ A[:, list(joints.values())]], axis=1)  # in balance without a load
    free = [k for k, size in zip((*names, *joints), np.abs(among).max(axis=0, initial=0.0)) if size > _MIN_SELF_STRESS]
    off = ~held & (np.abs(balance) > _MAX_UNBALANCED * np.abs(load).max())
    unsupported = tuple(name for k, name in enumerate(tree.coordinates) if off[6 + k])
    free = [*names, *joints] if unsupported else free
    return ClosureForces(
        {name: float(f) for name, f in zip(names, force) if name not in free},
        {name: -float(balance[k]) for name, k in joints.items() if name not in free}, tuple(free),
        np.where(held, 0.0, balance), unsupported,
    )  # fmt: skip
