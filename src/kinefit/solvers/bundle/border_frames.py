"""One frame of a fit with shared parameters: its rows, the equations of its pose, and derivatives by parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.losses import SQUARED, Loss
from kinefit.rows import AnyRows, Rows
from kinefit.solvers import _kernels_border, _kernels_linear
from kinefit.solvers.bundle.whitened import PoseScrews, columns, residuals, softening
from kinefit.solvers.equations import dense_pattern, lock, normal_equations
from kinefit.solvers.pixels import fit_pixels

POSTURE = 0.01
"""Share of the body's posture prior that holds poses here: in full it would bend lengths."""

SETTLING = 6
"""Steps that a pose takes by itself, at most, after each one with the parameters."""

_FIRST = 1e-3  # damping to begin with, as a share of the pose's mean diagonal
_SETTLED = 1e-3  # fall of a pose's cost at which it rests
_RESTING = 1e-5  # the same, as a share of the cost, in one kernel: some hundred pixels cost about that many
_FLOOR = 1e-9  # share of a pose's mean diagonal that holds what nothing measures

Part = tuple[str, AnyRows]
"""Rows, and the name of the sensor that made them."""


class BorderedProblem(Protocol):
    """What the parameters and the frames are.

    It may have `touches`, of each parameter the segments on which alone rows can feel it, None for anywhere: those of
    different segments then share an evaluation. It may have `columns(theta, steps, states)`, what `differences` gives
    as far as it is known without other worlds, NaN where it is not. It may have `packed(theta, frame, state)`, a rig
    and the points of a frame of which pixels alone are measured, None for any other: its pose settles in one kernel.
    """

    def body(self, theta: NDArray) -> Body:
        """The body with parameters (p,)."""
        ...

    def parts(self, theta: NDArray, frame: int, state: BodyState) -> Sequence[Part]:
        """Rows of one frame's sensors; the same in number and order for all parameters and states."""
        ...


@dataclass(frozen=True, eq=False)
class Weighing:
    """How much everything counts.

    Parameters
    ----------
    shares : {sensor: 0..1} how much a sensor's rows count, where its errors last; 1 for those not named.
    loss : Loss of rows without their own.
    posture : share of the body's posture prior that holds the poses.
    """

    shares: Mapping[str, float] = field(default_factory=dict)
    loss: Loss = SQUARED
    posture: float = POSTURE

    @property
    def most(self) -> float:
        """The share of the sensor that counts most; postures count no more."""
        return max(self.shares.values()) if self.shares else 1.0


@dataclass(frozen=True, eq=False)
class FrameEquations:
    """One frame's rows and the equations of its pose.

    Parameters
    ----------
    body, state : what they are about
    parts : its rows, by sensor
    weighing : how much they count
    H, g : (n, n), (n,) equations of the pose, with its posture prior
    cost : float
    """

    body: Body
    state: BodyState
    parts: Sequence[Part]
    weighing: Weighing
    H: NDArray
    g: NDArray
    cost: float

    @cached_property
    def factor(self) -> NDArray:
        """(N,) square root of shares and robust factors."""
        w = self.weighing
        own = [np.sqrt(w.shares.get(sensor, 1.0)) * softening(rows, w.loss)[0] for sensor, rows in self.parts]
        return np.concatenate([np.empty(0), *own])

    @cached_property
    def J(self) -> NDArray:
        """(N, n) derivatives by the pose, whitened and softened."""
        pose = PoseScrews.of(self.body, self.state)
        every = [np.empty((0, len(self.g))), *(columns(rows, pose) for _, rows in self.parts)]
        return np.asarray(self.factor[:, None] * np.concatenate(every))

    @property
    def left(self) -> NDArray:
        """(N,) residuals, whitened and softened."""
        return np.asarray(self.factor * _stacked(self.parts))

    @cached_property
    def held(self) -> NDArray:
        """(n,) bool, at a limit that it presses on, or fixed: does not move."""
        tree, angles, out = self.body.tree, self.state.angles, lock(self.body, None)
        out[6:] |= (angles <= tree.lower) & (self.g[6:] < 0.0)
        out[6:] |= (angles >= tree.upper) & (self.g[6:] > 0.0)
        return out

    @property
    def felt(self) -> NDArray:
        """(N,) bool, rows with a weight: a slack rope's row must not feel its length."""
        felt = [np.ones(len(r), bool) if r.weight.ndim == 2 else r.weight > 0.0 for _, r in self.parts]
        return np.concatenate([*felt, np.empty(0, bool)])

    def step(self, damping: float) -> tuple[NDArray, float]:
        """δ (n,) of the pose alone, and the predicted fall of the cost."""
        n, tree = len(self.g), self.body.tree
        L, move = np.empty((n, n)), np.empty(n)
        fall = _kernels_linear.damped_step(
            self.H, self.g, damping + _floor(self.H), *dense_pattern(n), self.state.angles, tree.lower, tree.upper,
            lock(self.body, None), L, move,
        )  # fmt: skip
        if fall < 0.0:
            move = solved(self.H, self.g[:, None], self.held, damping)[:, 0]
            fall = float(self.g @ move) + damping * float(move @ move)
        return move, float(fall)


def frame_at(
    problem: BorderedProblem, theta: NDArray, frame: int, state: BodyState, weighing: Weighing
) -> FrameEquations:
    """A frame's rows and equations at parameters (p,) and a state."""
    body = problem.body(theta)
    parts = problem.parts(theta, frame, state)
    shares = [weighing.shares.get(sensor, 1.0) for sensor, _ in parts]
    found = normal_equations(body, state, [rows for _, rows in parts], loss=weighing.loss, shares=shares)
    H, g, posture = found.matrix, found.gradient, weighing.most * weighing.posture
    pull = posture * body.tree.posture_precision
    away = state.angles - body.tree.usual
    H[6:, 6:] += pull
    g[6:] -= pull @ away
    return FrameEquations(body, state, parts, weighing, H, g, found.cost + float(away @ pull @ away))


def settle(
    problem: BorderedProblem, theta: NDArray, states: Sequence[BodyState], weighing: Weighing, steps: int = SETTLING
) -> tuple[list[FrameEquations], list[BodyState]]:
    """Every frame's pose brought near its own minimum: each has other angles that hardly anything holds."""
    body, frames, out = problem.body(theta), [], []
    bounds, packed = limits(body), getattr(problem, "packed", None)
    posture = weighing.most * weighing.posture
    if any(share != 1.0 for share in weighing.shares.values()):
        packed = None
    for f, state in enumerate(states):
        of_pixels = None if packed is None else packed(theta, f, state)
        if of_pixels is not None and (found := fit_pixels(
            body, state, of_pixels[0], of_pixels[1], None,
            max_iterations=steps, tolerance=_RESTING, posture=posture,
        )):  # fmt: skip
            state, H, g, cost, _ = found
            out.append(state)
            frames.append(FrameEquations(body, state, problem.parts(theta, f, state), weighing, H, g, cost))
            continue
        frame = frame_at(problem, theta, f, state, weighing)
        mean = float(np.trace(frame.H)) / len(frame.H) + 1e-12
        damping, growth, least = _FIRST * mean, 2.0, _kernels_linear.LEAST_DAMPING * mean
        for _ in range(steps):
            move, predicted = frame.step(damping)
            if predicted <= _SETTLED * (1.0 + 1e-3 * frame.cost):
                break
            moved = state.retract(move, bounds)
            new = frame_at(problem, theta, f, moved, weighing)
            damping, growth = _kernels_linear.adapt(damping, growth, frame.cost - new.cost, predicted, least)
            if new.cost < frame.cost:
                frame, state = new, moved
        frames.append(frame)
        out.append(state)
    return frames, out


def limits(body: Body) -> tuple[NDArray, NDArray]:
    """(D,) lower and upper ends of every coordinate."""
    return body.tree.lower, body.tree.upper


def differences(problem: BorderedProblem, theta: NDArray, steps: NDArray, states: Sequence[BodyState]) -> list[NDArray]:
    """(N, p) of every frame: how far each row's point moves, whitened, with each parameter; central differences.

    Raises
    ------
    ObservationError
        A sensor whose rows differ in number or kind between two worlds.
    """
    centre = [problem.parts(theta, f, state) for f, state in enumerate(states)]
    told = getattr(problem, "columns", None)
    if told is None:
        out = [np.full((sum(len(rows) for _, rows in parts), len(theta)), np.nan) for parts in centre]
    else:
        out = told(theta, steps, states)
    unknown = [np.isnan(D) for D in out]
    left = np.any([u.any(axis=0) for u in unknown], axis=0)
    if not left.any():
        return out
    for D, u in zip(out, unknown):
        D[u] = 0.0
    on = [_segments(parts) for parts in centre]
    touches: Sequence[frozenset[int] | None] = (None,) * len(theta)
    if all(segment is not None for segment in on):
        touches = getattr(problem, "touches", touches)
    for together in apart(touches, np.flatnonzero(left)):
        change = np.zeros(len(theta))
        change[together] = steps[together]
        owner = _owner(together, touches, len(problem.body(theta).tree.segments))
        for f, (state, parts) in enumerate(zip(states, centre, strict=True)):
            if not unknown[f][:, together].any():
                continue
            away = _by_rows(problem, theta, change, f, state, parts)
            segment = on[f]
            k = np.full(len(away), together[0])
            if owner is not None and segment is not None:
                k = owner[segment]
            felt = np.flatnonzero(k >= 0)
            felt = felt[unknown[f][felt, k[felt]]]
            out[f][felt, k[felt]] = away[felt] / steps[k[felt]]
    return out


def _by_rows(
    problem: BorderedProblem, theta: NDArray, change: NDArray, frame: int, state: BodyState, parts: Sequence[Part]
) -> NDArray:
    """(N,) how far each row's point moves with half the change, whitened: from its rows on either side."""
    ends = [problem.parts(theta + sign * change, frame, state) for sign in (1.0, -1.0)]
    for moved in ends:
        _same(parts, moved)
    return (_stacked(ends[1]) - _stacked(ends[0])) / 2.0


def _owner(together: Sequence[int], touches: Sequence[frozenset[int] | None], count: int) -> NDArray | None:
    """(S,) which of some parameters each of so many segments feels, -1 for none; None for one felt everywhere."""
    out = np.full(count, -1)
    for k in together:
        touched = touches[k]
        if touched is None:
            return None
        out[list(touched)] = k
    return out


def _segments(parts: Sequence[Part]) -> NDArray | None:
    """(N,) the segment of every row; None where a row may be about several."""
    if not all(isinstance(rows, Rows) for _, rows in parts):
        return None
    return np.concatenate([np.zeros(0, np.int64), *(rows.segment for _, rows in parts if isinstance(rows, Rows))])


def apart(touches: Sequence[frozenset[int] | None], some: Iterable[int]) -> list[list[int]]:
    """Some parameters that may change together, as no row feels two of them: greedily; None feels everywhere."""
    groups: list[tuple[list[int], set[int]]] = []
    out: list[list[int]] = []
    for k in map(int, some):
        segments = touches[k]
        if segments is None:
            out.append([k])
            continue
        for members, taken in groups:
            if not taken & segments:
                members.append(k)
                taken |= segments
                break
        else:
            groups.append(([k], set(segments)))
    return out + [members for members, _ in groups]


def solved(H: NDArray, right: NDArray, held: NDArray, damping: float) -> NDArray:
    """(n, m) H⁻¹ right of a pose, zero for what is held."""
    A, right = H.copy(), np.ascontiguousarray(right).copy()
    A.flat[:: len(H) + 1] += damping + _floor(H)
    A[held], A[:, held], right[held] = 0.0, 0.0, 0.0
    A[held, held] = 1.0
    return right if _kernels_border.solve(A.copy(), right) else np.linalg.lstsq(A, right)[0]


def _floor(H: NDArray) -> float:
    """What is added to the diagonal of a pose's equations (n, n) in any case."""
    return _FLOOR * float(H.trace()) / len(H) + 1e-12


def gram(A: NDArray, B: NDArray) -> NDArray:
    """(n, m) Aᵀ B."""
    out = np.zeros((A.shape[1], B.shape[1]))
    _kernels_border.gram(np.ascontiguousarray(A), np.ascontiguousarray(B), out)
    return out


def _stacked(parts: Sequence[Part]) -> NDArray:
    """(N,) whitened residuals of all rows of a frame."""
    return np.concatenate([residuals(r) for _, r in parts]) if parts else np.empty(0)


def _same(parts: Sequence[Part], moved: Sequence[Part]) -> None:
    """Rows of one match correspond one to one in all worlds."""
    remedy = "Give all rows of a match always; weight 0 for one that is not felt."
    for (sensor, a), (other, b) in zip(parts, moved):
        if sensor != other or len(a) != len(b) or type(a) is not type(b):
            problem = f"sensor '{sensor}' gives {len(a)} rows of a match, and {len(b)} of the same with another body"
            raise ObservationError(problem, remedy=remedy)
    if len(parts) != len(moved):
        sensor = max(parts, moved, key=len)[-1][0]
        problem = f"sensor '{sensor}' gives other kinds of rows of the same match with another body"
        raise ObservationError(problem, remedy=remedy)
