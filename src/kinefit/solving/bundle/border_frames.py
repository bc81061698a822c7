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
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving import _kernels_linear
from kinefit.solving.bundle.arrow import MIN_DIAGONAL_RATIO
from kinefit.solving.equations import columns, dense_pattern, lock, normal_equations, residuals, robust_factors
from kinefit.solving.least_squares import Damping, bounds_of, descend, fit_pixels
from kinefit.solving.rows import AnyRows, DofRows, Rows

POSTURE_SHARE = 0.01
"""Share of the body's posture prior in fits with parameters: in full it would bias lengths."""

MAX_POSE_STEPS = 6
"""Steps of the poses alone after each step with the parameters."""

_INITIAL_DAMPING = 1e-3  # as a share of the pose's mean diagonal
_MIN_COST_FALL = 1e-3  # of a pose's cost: below it the pose has converged
_KERNEL_TOLERANCE = 1e-5  # the same as a share of the cost, in the compiled kernel: the cost is about a hundred

Part = tuple[str, AnyRows]
"""Name of a sensor, and its rows."""


class BorderedProblem(Protocol):
    """Frames with rows that depend on poses and shared parameters.

    Optional attributes make it faster:

    - `touches`: (p,) for each parameter the only segments whose rows depend on it, None for any. Parameters of
      different segments then share an evaluation.
    - `columns(theta, steps, states)`: result of `differences` as far as it is known without changed worlds, else NaN.
    - `packed(theta, frame, state)`: rig and points of a frame with keypoints alone, None for any other. Its pose is
      fitted in one kernel.
    """

    def body(self, theta: NDArray) -> Body:
        """The body with parameters (p,)."""
        ...

    def parts(self, theta: NDArray, frame: int, state: BodyState) -> Sequence[Part]:
        """Rows of one frame's sensors; the same in number and order for all parameters and states."""
        ...


@dataclass(frozen=True, eq=False)
class Weighing:
    """Weights of sensors and of the posture prior.

    Parameters
    ----------
    shares : {sensor: 0..1} factor on the cost of a sensor's rows, below 1 for biased sensors; 1 for sensors not named
    loss : Loss of rows without their own
    posture : share of the body's posture prior
    """

    shares: Mapping[str, float] = field(default_factory=dict)
    loss: Loss = SQUARED
    posture: float = POSTURE_SHARE

    @property
    def most(self) -> float:
        """The largest share of any sensor; the posture prior is multiplied by it."""
        return max(self.shares.values()) if self.shares else 1.0


@dataclass(frozen=True, eq=False)
class FrameEquations:
    """One frame's rows and the equations of its pose.

    Parameters
    ----------
    body, state : at which the rows are linearised
    parts : rows by sensor
    weighing : their weights
    H, g : (n, n), (n,) equations of the pose, posture prior included
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
        """(N,) square root of the rows' shares times robust factors."""
        w = self.weighing
        own = [
            np.sqrt(w.shares.get(sensor, 1.0)) * np.sqrt(robust_factors(rows, w.loss)[0]) for sensor, rows in self.parts
        ]
        return np.concatenate([np.empty(0), *own])

    @cached_property
    def J(self) -> NDArray:
        """(N, n) derivatives by the pose, whitened and softened."""
        own = (columns(rows, self.body, self.state) for _, rows in self.parts)
        blocks = [np.empty((0, len(self.g))), *own]
        return np.asarray(self.factor[:, None] * np.concatenate(blocks))

    @property
    def residual(self) -> NDArray:
        """(N,) residuals, whitened and softened."""
        return np.asarray(self.factor * _stacked(self.parts))

    @cached_property
    def held(self) -> NDArray:
        """(n,) bool: degrees of freedom that are fixed, or at a limit and pulled beyond it."""
        tree, angles, out = self.body.tree, self.state.angles, lock(self.body, None)
        out[6:] |= (angles <= tree.lower) & (self.g[6:] < 0.0)
        out[6:] |= (angles >= tree.upper) & (self.g[6:] > 0.0)
        return out

    @property
    def used(self) -> NDArray:
        """(N,) bool: rows with a weight above 0; a slack rope's row must not depend on its length."""
        used = [np.ones(len(r), bool) if r.weight.ndim == 2 else r.weight > 0.0 for _, r in self.parts]
        return np.concatenate([*used, np.empty(0, bool)])

    def step(self, damping: float) -> tuple[NDArray, float]:
        """Step δ (n,) of the pose alone, and the predicted fall of the cost; `damping` in units of H."""
        n, tree = len(self.g), self.body.tree
        L, move = np.empty((n, n)), np.empty(n)
        fall = _kernels_linear.damped_step(
            self.H, self.g, damping + _floor(self.H), *dense_pattern(n), self.state.angles, tree.lower, tree.upper,
            lock(self.body, None), L, move,
        )  # fmt: skip
        if fall < 0.0:
            free, move = ~self.held, np.zeros(n)
            A = self.H + (damping + _floor(self.H)) * np.eye(n)
            move[free] = np.linalg.lstsq(A[np.ix_(free, free)], self.g[free])[0]
            fall = float(self.g @ move) + damping * float(move @ move)
        return move, float(fall)


def frame_at(
    problem: BorderedProblem, theta: NDArray, frame: int, state: BodyState, weighing: Weighing
) -> FrameEquations:
    """A frame's rows and equations at parameters (p,) and a state.

    Raises
    ------
    ObservationError
        Rows on segments or degrees of freedom that the body lacks.
    """
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
    problem: BorderedProblem, theta: NDArray, states: Sequence[BodyState], weighing: Weighing,
    steps: int = MAX_POSE_STEPS,
) -> tuple[list[FrameEquations], list[BodyState]]:  # fmt: skip
    """Fit every frame's pose alone, for fixed parameters (p,): weakly constrained angles need steps of their own."""
    body, frames, out = problem.body(theta), [], []
    bounds, packed = bounds_of(body, True), getattr(problem, "packed", None)
    posture = weighing.most * weighing.posture
    if any(share != 1.0 for share in weighing.shares.values()):
        packed = None
    for f, state in enumerate(states):
        of_pixels = None if packed is None else packed(theta, f, state)
        if of_pixels is not None and (found := fit_pixels(
            body, state, of_pixels[0], of_pixels[1], None,
            max_iterations=steps, tolerance=_KERNEL_TOLERANCE, posture=posture,
        )):  # fmt: skip
            state, H, g, cost, _ = found
            out.append(state)
            frames.append(FrameEquations(body, state, problem.parts(theta, f, state), weighing, H, g, cost))
            continue
        frame = frame_at(problem, theta, f, state, weighing)
        mean = float(np.trace(frame.H)) / len(frame.H) + 1e-12

        def follow(now: FrameEquations, move: NDArray, f: int = f) -> FrameEquations:
            return frame_at(problem, theta, f, now.state.retract(move, bounds), weighing)

        frame = descend(
            frame, FrameEquations.step, follow, iterations=steps, tolerance=1e-3 * _MIN_COST_FALL,
            nothing=_MIN_COST_FALL, damping=Damping(_INITIAL_DAMPING, most=np.inf).times(mean),
        ).at  # fmt: skip
        frames.append(frame)
        out.append(frame.state)
    return frames, out


def differences(problem: BorderedProblem, theta: NDArray, steps: NDArray, states: Sequence[BodyState]) -> list[NDArray]:
    """(N, p) of every frame: whitened derivatives of rows by the parameters, by central differences with steps (p,).

    Raises
    ------
    ObservationError
        A sensor's rows differ in number or kind between two worlds.
    """
    centre = [problem.parts(theta, f, state) for f, state in enumerate(states)]
    known_columns = getattr(problem, "columns", None)
    if known_columns is None:
        out = [np.full((sum(len(rows) for _, rows in parts), len(theta)), np.nan) for parts in centre]
    else:
        out = known_columns(theta, steps, states)
    unknown = [np.isnan(D) for D in out]
    remaining = np.any([u.any(axis=0) for u in unknown], axis=0)
    if not remaining.any():
        return out
    for D, u in zip(out, unknown):
        D[u] = 0.0
    on = [_segments(parts) for parts in centre]
    touches: Sequence[frozenset[int] | None] = (None,) * len(theta)
    if all(segment is not None for segment in on):
        touches = getattr(problem, "touches", touches)
    for together in apart(touches, np.flatnonzero(remaining)):
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
            dependent = np.flatnonzero(k >= 0)
            dependent = dependent[unknown[f][dependent, k[dependent]]]
            out[f][dependent, k[dependent]] = away[dependent] / steps[k[dependent]]
    return out


def _by_rows(
    problem: BorderedProblem, theta: NDArray, change: NDArray, frame: int, state: BodyState, parts: Sequence[Part]
) -> NDArray:
    """(N,) half the difference of whitened residuals between parameters `theta` minus and plus `change`."""
    ends = [problem.parts(theta + sign * change, frame, state) for sign in (1.0, -1.0)]
    for moved in ends:
        _same(parts, moved)
    return (_stacked(ends[1]) - _stacked(ends[0])) / 2.0


def _owner(together: Sequence[int], touches: Sequence[frozenset[int] | None], count: int) -> NDArray | None:
    """(S,) the one of some parameters on which each segment's rows depend, -1 for none; None if any segment may."""
    out = np.full(count, -1)
    for k in together:
        touched = touches[k]
        if touched is None:
            return None
        out[list(touched)] = k
    return out


def _segments(parts: Sequence[Part]) -> NDArray | None:
    """(N,) the segment of every row; None if a row may depend on several."""
    segments = [rows.segment if isinstance(rows, Rows | DofRows) else None for _, rows in parts]
    known = [segment for segment in segments if segment is not None]
    return np.concatenate([np.zeros(0, np.int64), *known]) if len(known) == len(segments) else None


def apart(touches: Sequence[frozenset[int] | None], some: Iterable[int]) -> list[list[int]]:
    """Groups of parameters that may change together, because no row depends on two of a group (greedy colouring).

    Parameters
    ----------
    touches : (p,) for each parameter the only segments whose rows depend on it; None for any: a group of its own
    some : the parameters to group
    """
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


def _floor(H: NDArray) -> float:
    """Least value added to the diagonal of a pose's H (n, n)."""
    return MIN_DIAGONAL_RATIO * float(H.trace()) / len(H) + 1e-12


def gram(A: NDArray, B: NDArray) -> NDArray:
    """Aᵀ B (n, m) of matrices (N, n) and (N, m), without threads."""
    out = np.zeros((A.shape[1], B.shape[1]))
    _kernels_linear.gram(np.ascontiguousarray(A), np.ascontiguousarray(B), out)
    return out


def _stacked(parts: Sequence[Part]) -> NDArray:
    """(N,) whitened residuals of all rows of a frame."""
    return np.concatenate([residuals(r) for _, r in parts]) if parts else np.empty(0)


def _same(parts: Sequence[Part], moved: Sequence[Part]) -> None:
    """Check that rows of one match correspond one to one in both worlds."""
    remedy = "Always give all rows of a match, with weight 0 for inactive ones."
    for (sensor, a), (other, b) in zip(parts, moved):
        if sensor != other or len(a) != len(b) or type(a) is not type(b):
            problem = f"sensor '{sensor}' gives {len(a)} rows of a match, but {len(b)} with another body"
            raise ObservationError(problem, remedy=remedy)
    if len(parts) != len(moved):
        sensor = max(parts, moved, key=len)[-1][0]
        problem = f"sensor '{sensor}' gives other kinds of rows of the same match with another body"
        raise ObservationError(problem, remedy=remedy)
