"""A body's size and where its markers sit, from many frames at once, with the poses solved along.

All frames share scales and marker offsets; each frame's pose is eliminated (Schur complement). A joint's place shows in
how the markers of two segments move about it, so this is also the functional calibration of joint centres and axes: of
all joints together, by least squares, with what is known of bodies where a trial does not move a joint enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError
from kinefit.losses import Loss, geman_mcclure
from kinefit.solvers import _kernels_linear, _kernels_marker_shape
from kinefit.solvers.shape import PROPORTIONS, ShapeParameters

_UNKNOWN_SIZE, _KNOWN_SIZE = 0.2, 0.02  # one standard deviation of a person's size, as a share, as in `solvers.shape`
_POSTURE = 0.01  # share of the posture prior: it decides what the markers leave open, and bends nothing else
_LIMITS = (0.2, 5.0)  # of a scale


@dataclass(frozen=True, eq=False)
class MarkerShape:
    """Scales (G,) of a body's groups, offsets (K, 3) [m] of its markers in their segments, and the frames' states.

    `covariance` (p, p) tells how sure scales and offsets are, for weights that are inverse variances.
    """

    scales: NDArray
    offsets: NDArray
    states: tuple[BodyState, ...]
    cost: float
    covariance: NDArray

    @property
    def scale_std(self) -> NDArray:
        """(G,) standard deviation of every scale."""
        return np.sqrt(np.diag(self.covariance)[: len(self.scales)])


def marker_parameters(
    body: Body, points: PointSet, spread: NDArray, size: float, *, known: bool = False, proportions: float = PROPORTIONS
) -> ShapeParameters:
    """What a shape consists of, and its prior: one scale a group, then three offsets a marker.

    All scales follow the person's size, each differing from it by the share `proportions`; spread (K,) [m] of each
    marker about where the set has it, along each axis.
    """
    groups, count = len(body.scale_groups), len(points)
    common = (_KNOWN_SIZE if known else _UNKNOWN_SIZE) * size
    prior = np.diag(np.concatenate([np.ones(groups), np.repeat(spread, 3) ** -2.0]))
    prior[:groups, :groups] = np.linalg.inv(np.eye(groups) * (proportions * size) ** 2 + common**2)
    mean = np.concatenate([np.full(groups, size), np.zeros(3 * count)])
    return ShapeParameters(body, points, 3 * np.arange(count), np.ones(count), prior, mean)


def fit_marker_shape(
    parameters: ShapeParameters,
    x_world: NDArray,
    weight: NDArray,
    states: Sequence[BodyState],
    *,
    share: NDArray | float = 1.0,
    start: NDArray | None = None,
    loss: Loss | None = None,
    max_iterations: int = 15,
    tolerance: float = 1e-3,
) -> MarkerShape:
    """Scales, offsets and poses that explain the markers of all frames best.

    Parameters
    ----------
    parameters : of the generic body, from `marker_parameters`.
    x_world : (F, K, 3) [m], anything where the weight is 0.
    weight : (F, K) [1/m²], 0 where unseen.
    states : F, near the truth.
    share : scalar or (F,), how much of a frame counts beyond its loss: below 1 for frames whose errors come together.
    start : (p,) parameters to begin with; default: the prior's mean.
    loss : default Geman-McClure.
    tolerance : stop when an iteration lowers the cost by less than this share.

    Raises
    ------
    ObservationError
        Shapes that do not belong together, or no frame.
    """
    body, loss = parameters.body, loss or geman_mcclure()
    tree, n, groups, p = body.tree, body.tree.n_dofs, len(body.scale_groups), len(parameters.mean)
    count = len(parameters.points)
    if not len(states) or np.shape(x_world) != (len(states), count, 3) or np.shape(weight) != (len(states), count):
        raise ObservationError(
            f"{len(states)} states with markers {np.shape(x_world)} and weights {np.shape(weight)}",
            remedy=f"Give (frames, {count}, 3) and (frames, {count}), one state a frame.",
        )
    x, weight = np.ascontiguousarray(np.nan_to_num(x_world), float), np.ascontiguousarray(weight, float)
    counts = np.broadcast_to(np.asarray(share, float), len(states))
    posture, owner = _POSTURE * np.square(1.0 / tree.spread), parameters.points.segments

    def cost_of(theta: NDArray, states: Sequence[BodyState]) -> float:
        moved, rest, _ = parameters.geometry(theta)
        bent = theta - parameters.mean
        total = float(bent @ parameters.prior @ bent)
        for f, state in enumerate(states):
            placed, _ = moved.forward(state.T_world_root, state.angles)
            own = _kernels_marker_shape.marker_cost(owner, rest, x[f], weight[f], placed, loss.kind, loss.scale)
            total += float(counts[f]) * (own + float(posture @ np.square(state.angles - tree.usual)))
        return total

    def system(theta: NDArray, state: BodyState, f: int) -> tuple[NDArray, NDArray]:
        H, g = marker_equations(parameters, theta, state, x[f], weight[f], loss)
        H[range(6, n), range(6, n)] += posture
        g[6:n] -= posture * (state.angles - tree.usual)
        H, g = counts[f] * H, counts[f] * g
        held = np.zeros(len(g), bool)
        held[:6] = not tree.root_free
        held[6:n] = ((state.angles <= tree.lower) & (g[6:n] < 0)) | ((state.angles >= tree.upper) & (g[6:n] > 0))
        H[held], H[:, held], g[held] = 0.0, 0.0, 0.0
        H[held, held] = 1.0
        return H, g

    def eliminated(damping: float) -> tuple[NDArray, NDArray, NDArray]:
        S, b = parameters.prior.copy(), parameters.prior @ (parameters.mean - theta)
        kept = np.empty((len(systems), p + 1, n))
        for f, (H, g) in enumerate(systems):
            S += H[n:, n:]
            b += g[n:]
            if not _kernels_linear.eliminate(H, g, n, damping, tree.chain, tree.depth, S, b, kept[f]):
                kept[f] = 0.0
        return np.tril(S) + np.tril(S, -1).T, b, kept

    def step(damping: float) -> tuple[NDArray, list[BodyState]]:
        S, b, kept = eliminated(damping)
        delta = np.linalg.solve(S + damping * np.diag(np.diag(S)), b)
        new = theta + delta
        new[:groups] = np.clip(new[:groups], *_LIMITS)
        moves = kept[:, p] - delta @ kept[:, :p]
        return new, [s.retract(m, (tree.lower, tree.upper)) for s, m in zip(states, moves, strict=True)]

    theta, states = np.array(parameters.mean if start is None else start, float), list(states)
    cost, damping = cost_of(theta, states), 1e-3
    systems = [system(theta, state, f) for f, state in enumerate(states)]
    for _ in range(max_iterations):
        new, moved = step(damping)
        while not (new_cost := cost_of(new, moved)) < cost and damping < 1e4:
            damping *= 10.0
            new, moved = step(damping)
        if not new_cost < cost:
            break
        fall, theta, states, cost = cost - new_cost, new, moved, new_cost
        systems = [system(theta, state, f) for f, state in enumerate(states)]
        damping = max(damping * 0.1, 1e-9)
        if fall < tolerance * cost:
            break
    covariance = np.linalg.inv(eliminated(1e-9)[0])
    return MarkerShape(theta[:groups].copy(), parameters.geometry(theta)[2], tuple(states), cost, covariance)


def marker_equations(
    parameters: ShapeParameters, theta: NDArray, state: BodyState, x_world: NDArray, weight: NDArray, loss: Loss
) -> tuple[NDArray, NDArray]:
    """One frame's markers as H (n + p, n + p; lower triangle) and g (n + p): degrees of freedom, scales, offsets."""
    body = parameters.body
    tree, size = body.tree, body.tree.n_dofs + len(parameters.mean)
    moved, rest, _ = parameters.geometry(theta)
    placed, screws = moved.forward(state.T_world_root, state.angles)
    H, g = np.zeros((size, size)), np.zeros(size)
    _kernels_marker_shape.marker_system(
        tree.parents, tree.dof_parent, tree.last_dof, tree.offsets, body.segment_scale, len(body.scale_groups),
        parameters.points.segments, rest, parameters.points.points, parameters.shift, x_world, weight, placed, screws,
        np.ascontiguousarray(state.T_world_root[:3, 3]), loss.kind, loss.scale, H, g,
    )  # fmt: skip
    return H, g
