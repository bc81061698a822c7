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
from kinefit.solvers import _kernels_border, _kernels_linear
from kinefit.solvers.equations import lock
from kinefit.solvers.whitened import Pose, columns, residuals, softening

POSTURE = 0.01
"""Share of the body's posture prior that holds poses here: in full it would bend lengths."""

_FIRST = 1e-3  # damping to begin with, as a share of the poses' mean diagonal
_LITTLE = 1e-9  # damping, as such a share, that is as good as none
_STIFF = 0.01  # of the poses' damping that parameters have: their prior holds them, few angles have one
_MOST = 1e8  # damping, as such a share, at which nothing is left to be gained
_NEAR = 3e-3  # [m, rad] of moves within which derivatives by parameters stay as they are
_LEAST = 3.0  # [1/m², 1/rad²] damping of poses when they move with parameters
_SETTLE, _SETTLED = 6, 1e-3  # steps of a pose by itself, and the fall of its cost at which it rests
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
class _Frame:
    """One frame's rows and the equations of its pose."""

    parts: Sequence[Part]
    factor: NDArray  # (N,) √ of shares and robust factors
    J: NDArray  # (N, n) whitened and softened, by the pose
    left: NDArray  # (N,) residuals, likewise
    H: NDArray  # (n, n)
    g: NDArray  # (n,)
    held: NDArray  # (n,) bool, at a limit or fixed: does not move
    cost: float

    @property
    def felt(self) -> NDArray:
        """(N,) bool, rows with a weight: a slack rope's row must not feel its length."""
        felt = [np.ones(len(r), bool) if r.weight.ndim == 2 else r.weight > 0.0 for _, r in self.parts]
        return np.concatenate(felt) if felt else np.empty(0, bool)

    def step(self, damping: float) -> tuple[NDArray, float]:
        """δ (n,) of the pose alone, and the predicted fall of the cost."""
        move = _solved(self.H, self.g[:, None], self.held, damping)[:, 0]
        return move, float(self.g @ move) + damping * float(move @ move)


@dataclass(frozen=True, eq=False)
class _Block:
    """One frame's part of the arrow."""

    frame: _Frame
    by_theta: NDArray  # (N, p) whitened, as it was found
    felt: NDArray  # (N,) bool
    B: NDArray  # (n, p)
    S: NDArray  # (p, p)
    b: NDArray  # (p,)


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
    tolerance: float = 1e-4,
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
    theta, bounds = np.array(theta, float), _bounds(problem.body(theta))
    frames, states = task.settle(theta, [s.retract(np.zeros(6 + len(s.angles)), bounds) for s in states])
    cost, blocks = task.cost(theta, frames), task.blocks(theta, states, frames, None)
    mean = float(np.mean([np.trace(f.H) / len(f.H) for f in frames])) if frames else 1.0
    damping, growth, converged, iteration, far = _FIRST * mean, 2.0, False, 0, 0.0
    for iteration in range(1, max_iterations + 1):
        delta, moves, predicted = task.step(theta, blocks, damping)
        if predicted <= tolerance * cost + 1e-300:
            converged = True
            break
        trial = theta + delta
        settled, moved = task.settle(trial, [s.retract(m, bounds) for s, m in zip(states, moves, strict=True)])
        new = task.cost(trial, settled)
        damping, growth = _kernels_linear.adapt(damping, growth, cost - new, predicted)
        damping = max(damping, _LITTLE * mean)
        if new < cost:
            far += max(float(np.abs(a.difference(b)).max()) for a, b in zip(states, moved)) + np.abs(delta).max()
            theta, states, frames, cost = trial, moved, settled, new
            near = blocks if far <= _NEAR else None
            far = far if near else 0.0
            blocks = task.blocks(theta, states, frames, near)
        elif damping > _MOST * mean:
            converged = True
            break
    information = _information(blocks, len(theta), lock(problem.body(theta), None))
    return Bordered(theta, tuple(states), information, prior, cost, iteration, converged)


def _bounds(body: Body) -> tuple[NDArray, NDArray]:
    return body.tree.lower, body.tree.upper


@dataclass(frozen=True, eq=False)
class _Task:
    """A problem with all that weighs it."""

    problem: Problem
    prior: Prior
    steps: NDArray
    shares: Mapping[str, float]
    loss: Loss
    posture: float

    @property
    def _most(self) -> float:
        """The largest share of a sensor."""
        return max(self.shares.values()) if self.shares else 1.0

    @property
    def _least(self) -> float:
        """Damping of poses in steps with θ: angles that hardly anything holds settle by themselves."""
        return _LEAST * self._most

    def cost(self, theta: NDArray, frames: Sequence[_Frame]) -> float:
        """Of rows, postures and prior."""
        away = theta - self.prior.mean
        return float(away @ self.prior.information @ away) + sum(f.cost for f in frames)

    def frame(self, theta: NDArray, f: int, state: BodyState) -> _Frame:
        """Equations of one frame's pose; its posture weighs no more than the sensor that counts most."""
        body = self.problem.body(theta)
        tree, parts, pose, n = body.tree, self.problem.parts(theta, f, state), Pose.of(body, state), body.tree.n_dofs
        pull = self._most * self.posture / np.square(tree.spread)
        away, factors, cost = state.angles - tree.usual, [], 0.0
        for sensor, rows in parts:
            share = self.shares.get(sensor, 1.0)
            soft, own = softening(rows, self.loss)
            factors.append(np.sqrt(share) * soft)
            cost += share * own
        factor = np.concatenate([*factors, np.empty(0)])
        J = factor[:, None] * np.concatenate([*(columns(r, pose) for _, r in parts), np.empty((0, n))])
        left = factor * _stacked(parts)
        H, g, held = _gram(J, J), left @ J, lock(body, None)
        H[range(6, n), range(6, n)] += pull
        g[6:] -= pull * away
        held[6:] |= (state.angles <= tree.lower) & (g[6:] < 0.0)
        held[6:] |= (state.angles >= tree.upper) & (g[6:] > 0.0)
        return _Frame(parts, factor, J, left, H, g, held, cost + float(pull @ np.square(away)))

    def settle(self, theta: NDArray, states: Sequence[BodyState]) -> tuple[list[_Frame], list[BodyState]]:
        """Every frame's pose brought near its own minimum: each has its own angles that hardly anything holds."""
        bounds, frames, out = _bounds(self.problem.body(theta)), [], []
        for f, state in enumerate(states):
            frame = self.frame(theta, f, state)
            damping, growth = _FIRST * float(np.trace(frame.H)) / len(frame.H) + 1e-12, 2.0
            for _ in range(_SETTLE):
                move, predicted = frame.step(damping)
                if predicted <= _SETTLED * (1.0 + 1e-3 * frame.cost):
                    break
                moved = state.retract(move, bounds)
                new = self.frame(theta, f, moved)
                damping, growth = _kernels_linear.adapt(damping, growth, frame.cost - new.cost, predicted)
                if new.cost < frame.cost:
                    frame, state = new, moved
            frames.append(frame)
            out.append(state)
        return frames, out

    def blocks(
        self, theta: NDArray, states: Sequence[BodyState], frames: Sequence[_Frame], near: Sequence[_Block] | None
    ) -> list[_Block]:
        """The frames' parts of the arrow, with the derivatives by θ of `near` blocks where those will do."""
        felt = [frame.felt for frame in frames]
        if near is not None and all(np.array_equal(a.felt, b) for a, b in zip(near, felt, strict=True)):
            by_theta = [block.by_theta for block in near]
        else:
            by_theta = self._differences(theta, states, frames)
        out = []
        for frame, D, some in zip(frames, by_theta, felt, strict=True):
            T = (frame.factor * some)[:, None] * D
            out.append(_Block(frame, D, some, _gram(frame.J, T), _gram(T, T), frame.left @ T))
        return out

    def _differences(self, theta: NDArray, states: Sequence[BodyState], frames: Sequence[_Frame]) -> list[NDArray]:
        """(N, p) of every frame: how far each row's point moves, whitened, with each parameter."""
        out = [np.zeros((len(frame.left), len(theta))) for frame in frames]
        for k, step in enumerate(self.steps):
            for sign in (-1.0, 1.0):
                other = theta.copy()
                other[k] += sign * step
                for f, (state, frame) in enumerate(zip(states, frames, strict=True)):
                    moved = self.problem.parts(other, f, state)
                    _same(frame.parts, moved)
                    out[f][:, k] -= sign * _stacked(moved) / (2.0 * step)
        return out

    def step(self, theta: NDArray, blocks: Sequence[_Block], damping: float) -> tuple[NDArray, list[NDArray], float]:
        """δθ (p,), each pose's δ (n,), and the predicted fall of the cost."""
        p = len(theta)
        S = self.prior.information + _STIFF * damping * np.eye(p)
        pull = self.prior.information @ (self.prior.mean - theta)
        b, kept = pull.copy(), []
        for block in blocks:
            frame = block.frame
            back = _solved(frame.H, np.column_stack([block.B, frame.g]), frame.held, damping + self._least)
            both = _gram(block.B, back)
            S += block.S - both[:, :p]
            b += block.b - both[:, p]
            kept.append(back)
        delta = np.linalg.solve(S, b)
        moves = [back[:, p] - back[:, :p] @ delta for back in kept]
        fall = float(delta @ pull) + _STIFF * damping * float(delta @ delta)
        for block, move in zip(blocks, moves, strict=True):
            fall += float(block.b @ delta + block.frame.g @ move) + (damping + self._least) * float(move @ move)
        return delta, moves, fall


def _solved(H: NDArray, right: NDArray, held: NDArray, damping: float) -> NDArray:
    """(n, m) H⁻¹ right of a pose, zero for what is held."""
    n = len(H)
    A, right = H.copy(), np.ascontiguousarray(right).copy()
    A[range(n), range(n)] += damping + _FLOOR * float(np.trace(H)) / n + 1e-12
    A[held], A[:, held], right[held] = 0.0, 0.0, 0.0
    A[held, held] = 1.0
    return right if _kernels_border.solve(A.copy(), right) else np.linalg.lstsq(A, right)[0]


def _gram(A: NDArray, B: NDArray) -> NDArray:
    """(n, m) Aᵀ B."""
    out = np.zeros((A.shape[1], B.shape[1]))
    _kernels_border.gram(np.ascontiguousarray(A), np.ascontiguousarray(B), out)
    return out


def _information(blocks: Sequence[_Block], p: int, known: NDArray) -> NDArray:
    """(p, p) what all frames tell of θ with their poses unknown; limits of joints tell nothing."""
    out = np.zeros((p, p))
    for block in blocks:
        out += block.S - _gram(block.B, _solved(block.frame.H, block.B, known, 0.0))
    return 0.5 * (out + out.T)


def _stacked(parts: Sequence[Part]) -> NDArray:
    """(N,) whitened residuals of all rows of a frame."""
    return np.concatenate([residuals(r) for _, r in parts]) if parts else np.empty(0)


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
