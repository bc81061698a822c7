"""Poses of many frames with a border of parameters that they share: damped Gauss-Newton, the poses eliminated.

The normal equations of K frames and p parameters θ have the shape of an arrow: each frame's pose meets only itself and
θ. Taking the poses out (Schur complement) leaves p equations, so the cost grows linearly with the frames. Derivatives
by θ are central differences of whitened residuals √w·r of the same correspondences in two worlds, with the robust
factors held: no sensor needs to know of a parameter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.losses import SQUARED, Loss
from kinefit.rows import AnyRows
from kinefit.solvers import _kernels_linear
from kinefit.solvers.equations import lock
from kinefit.solvers.whitened import Pose, columns, residuals, softening

POSTURE = 0.01
"""Share of the body's posture prior that holds poses here: in full it would bend lengths."""

_FIRST = 1e-3  # damping to begin with, as a share of the poses' mean diagonal
_MOST = 1e8  # damping, as such a share, at which nothing is left to be gained
_FLOOR = 1e-9  # share of a pose's mean diagonal that holds what nothing measures

Part = tuple[str, AnyRows]
"""Rows, and the name of the sensor that made them."""


class Problem(Protocol):
    """What the parameters and the frames are."""

    def body(self, theta: NDArray) -> Body:
        """The body with parameters (p,)."""
        ...

    def parts(self, theta: NDArray, frame: int, state: BodyState) -> Sequence[Part]:
        """Rows of one frame's sensors; the same in number and order for all parameters and states."""
        ...


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
    information : (p, p) what the rows tell of θ, every pose eliminated; without the prior.
    prior : Prior
    cost : float, of rows, postures and prior.
    iterations : int, steps tried.
    converged : bool, False when the iterations were used up.
    """

    theta: NDArray
    states: tuple[BodyState, ...]
    information: NDArray
    prior: Prior
    cost: float
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class _Block:
    """One frame's part of the arrow."""

    H: NDArray  # (n, n)
    B: NDArray  # (n, p)
    S: NDArray  # (p, p)
    g: NDArray  # (n,)
    b: NDArray  # (p,)
    held: NDArray  # (n,) bool, at a limit or fixed: does not move
    fixed: NDArray  # (n,) bool, known


def solve(
    problem: Problem,
    theta: NDArray,
    states: Sequence[BodyState],
    prior: Prior,
    steps: NDArray,
    *,
    shares: Mapping[str, float] | None = None,
    loss: Loss = SQUARED,
    posture: float = POSTURE,
    max_iterations: int = 20,
    tolerance: float = 1e-6,
) -> Bordered:
    """Minimise Σ share·ρ(w r²) over K poses and the parameters that they share, prior and postures included.

    Parameters
    ----------
    problem : Problem
    theta : (p,) to start from.
    states : K, to start from; limits of joints hold.
    prior : Prior
    steps : (p,) of the central differences; parameters are in units of which one is about a metre or a radian.
    shares : {sensor: 0..1}, optional
        How much a sensor's rows count, where its errors last from frame to frame; 1 for those not named.
    loss : Loss of rows without their own.
    posture : share of the body's posture prior that holds the poses.
    tolerance : stop when the predicted fall of the cost is below this share of it.

    Raises
    ------
    ObservationError
        A sensor whose rows differ in number between two worlds; rows that the body cannot take.
    """
    task = _Task(problem, prior, np.asarray(steps, float), dict(shares or {}), loss, posture)
    theta = np.array(theta, float)
    tree = problem.body(theta).tree
    bounds = tree.lower, tree.upper
    states = tuple(s.retract(np.zeros(tree.n_dofs), bounds) for s in states)
    cost, blocks = task.cost(theta, states), task.blocks(theta, states)
    mean = float(np.mean([np.trace(b.H) / len(b.H) for b in blocks])) if blocks else 1.0
    damping, growth, converged, iteration = _FIRST * mean, 2.0, False, 0
    for iteration in range(1, max_iterations + 1):
        delta, moves, predicted = task.step(theta, blocks, damping)
        if predicted <= tolerance * cost + 1e-300:
            converged = True
            break
        trial = theta + delta
        moved = tuple(s.retract(m, bounds) for s, m in zip(states, moves, strict=True))
        new = task.cost(trial, moved)
        damping, growth = _kernels_linear.adapt(damping, growth, cost - new, predicted)
        if new < cost:
            theta, states, cost = trial, moved, new
            blocks = task.blocks(theta, states)
        elif damping > _MOST * mean:
            converged = True
            break
    return Bordered(theta, states, _information(blocks, len(theta)), prior, cost, iteration, converged)


@dataclass(frozen=True, eq=False)
class _Task:
    """A problem with all that weighs it."""

    problem: Problem
    prior: Prior
    steps: NDArray
    shares: Mapping[str, float]
    loss: Loss
    posture: float

    def _pull(self, body: Body) -> NDArray:
        """(D,) weight of the posture prior: no more than the sensor counts that counts most."""
        most = max(self.shares.values()) if self.shares else 1.0
        return np.asarray(most * self.posture / np.square(body.tree.spread))

    def cost(self, theta: NDArray, states: Sequence[BodyState]) -> float:
        """Of rows, postures and prior."""
        body, away = self.problem.body(theta), theta - self.prior.mean
        pull, total = self._pull(body), float(away @ self.prior.information @ away)
        for f, state in enumerate(states):
            total += float(pull @ np.square(state.angles - body.tree.usual))
            for sensor, rows in self.problem.parts(theta, f, state):
                total += self.shares.get(sensor, 1.0) * softening(rows, self.loss)[1]
        return total

    def blocks(self, theta: NDArray, states: Sequence[BodyState]) -> list[_Block]:
        """The frames' parts of the arrow."""
        body = self.problem.body(theta)
        centre = [self.problem.parts(theta, f, s) for f, s in enumerate(states)]
        soft = [
            np.concatenate([np.sqrt(self.shares.get(k, 1.0)) * softening(r, self.loss)[0] for k, r in parts] or [[]])
            for parts in centre
        ]
        by_theta = self._differences(theta, states, centre)
        pull, locked = self._pull(body), lock(body, None)
        out = []
        for state, parts, factor, T in zip(states, centre, soft, by_theta, strict=True):
            pose = Pose.of(body, state)
            n = body.tree.n_dofs
            J = factor[:, None] * np.concatenate([columns(r, pose) for _, r in parts] or [np.empty((0, n))])
            T, left = factor[:, None] * T, factor * _stacked(parts)
            H, g = J.T @ J, J.T @ left
            H[range(6, n), range(6, n)] += pull
            g[6:] -= pull * (state.angles - body.tree.usual)
            held = locked.copy()
            held[6:] |= (state.angles <= body.tree.lower) & (g[6:] < 0.0)
            held[6:] |= (state.angles >= body.tree.upper) & (g[6:] > 0.0)
            out.append(_Block(H, J.T @ T, T.T @ T, g, T.T @ left, held, locked))
        return out

    def _differences(
        self, theta: NDArray, states: Sequence[BodyState], centre: Sequence[Sequence[Part]]
    ) -> list[NDArray]:
        """(N, p) of every frame: how far each row's point moves, whitened, with each parameter."""
        out = [np.zeros((sum(len(r) for _, r in parts), len(theta))) for parts in centre]
        counted = [np.concatenate([_counted(r) for _, r in parts] or [np.empty(0, bool)]) for parts in centre]
        for k, step in enumerate(self.steps):
            for sign in (-1.0, 1.0):
                other = theta.copy()
                other[k] += sign * step
                for f, (state, parts) in enumerate(zip(states, centre, strict=True)):
                    moved = self.problem.parts(other, f, state)
                    _same(parts, moved)
                    out[f][:, k] -= sign * _stacked(moved) / (2.0 * step)
        for rows, some in zip(out, counted, strict=True):
            rows[~some] = 0.0
        return out

    def step(self, theta: NDArray, blocks: Sequence[_Block], damping: float) -> tuple[NDArray, list[NDArray], float]:
        """δθ (p,), each pose's δ (n,), and the predicted fall of the cost."""
        p = len(theta)
        S = self.prior.information + damping * np.eye(p)
        pull = self.prior.information @ (self.prior.mean - theta)
        b, kept = pull.copy(), []
        for block in blocks:
            back = _eliminated(block, block.held, damping)
            S += block.S - block.B.T @ back[:, :p]
            b += block.b - block.B.T @ back[:, p]
            kept.append(back)
        delta = np.linalg.solve(S, b) if p else np.empty(0)
        moves = [back[:, p] - back[:, :p] @ delta for back in kept]
        fall = float(delta @ pull) + damping * float(delta @ delta)
        for block, move in zip(blocks, moves, strict=True):
            fall += float(block.b @ delta + block.g @ move) + damping * float(move @ move)
        return delta, moves, fall


def _eliminated(block: _Block, held: NDArray, damping: float) -> NDArray:
    """(n, p + 1) H⁻¹ [B, g] of a pose, zero for what is held."""
    n = len(block.g)
    A, right = block.H.copy(), np.column_stack([block.B, block.g])
    A[range(n), range(n)] += damping + _FLOOR * float(np.trace(block.H)) / n + 1e-12
    A[held], A[:, held], right[held] = 0.0, 0.0, 0.0
    A[held, held] = 1.0
    return np.linalg.solve(A, right)


def _information(blocks: Sequence[_Block], p: int) -> NDArray:
    """(p, p) what all frames tell of θ with their poses unknown; limits of joints tell nothing."""
    out = np.zeros((p, p))
    for block in blocks:
        out += block.S - block.B.T @ _eliminated(block, block.fixed, 0.0)[:, :p]
    return 0.5 * (out + out.T)


def _stacked(parts: Sequence[Part]) -> NDArray:
    """(N,) whitened residuals of all rows of a frame."""
    return np.concatenate([residuals(r) for _, r in parts]) if parts else np.empty(0)


def _counted(rows: AnyRows) -> NDArray:
    """(N,) bool, rows with a weight: a slack rope's row must not feel its length."""
    return np.ones(len(rows), bool) if rows.weight.ndim == 2 else rows.weight > 0.0


def _same(parts: Sequence[Part], moved: Sequence[Part]) -> None:
    """Rows of one match correspond one to one in all worlds."""
    for (sensor, a), (other, b) in zip(parts, moved):
        if sensor != other or len(a) != len(b) or type(a) is not type(b):
            problem = f"sensor '{sensor}' gives {len(a)} rows of a match, and {len(b)} of the same with another body"
            raise ObservationError(problem, remedy="Give all rows of a match always; weight 0 for one that is not felt.")
    if len(parts) != len(moved):
        sensor = max(parts, moved, key=len)[-1][0]
        problem = f"sensor '{sensor}' gives other kinds of rows of the same match with another body"
        raise ObservationError(problem, remedy="Give all rows of a match always; weight 0 for one that is not felt.")
