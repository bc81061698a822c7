"""A body's shape from many frames: bone lengths and the places of a detector's points, with the poses solved along.

All frames share the shape; each frame's pose is eliminated (Schur complement), so the cost is linear in the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet
from kinefit.geometry.camera import Rig
from kinefit.solvers import _kernels_linear, _kernels_shape
from kinefit.solvers.losses import Loss, geman_mcclure

_MIDDLE = 0.002  # [m] spread of a point in the middle to either side
_POSTURE = 0.01  # share of the posture prior: here lengths matter, and it would bend them


@dataclass(frozen=True, eq=False)
class PixelFrames:
    """Pixels of N measurements over F frames.

    Parameters
    ----------
    points : PointSet of K points on the body (before scaling and shifts).
    camera : (N,) int, index in the rig.
    column : (N,) int, which of the K points.
    uv : (F, N, 2) [px]
    weight : (F, N) [1/px²], 0 where unseen.
    """

    points: PointSet
    camera: NDArray
    column: NDArray
    uv: NDArray
    weight: NDArray


@dataclass(frozen=True, eq=False)
class Shape:
    """Scales (G,) of the body's groups, shifts (K, 3) [m] of its points in their segments, and the frames' states."""

    scales: NDArray
    shifts: NDArray
    states: tuple[BodyState, ...]
    cost: float


def mirror_points(points: PointSet, segments: Sequence[str]) -> tuple[NDArray, NDArray]:
    """For each point the one whose shift it shares, and ±1 for the sign of z: left and right are alike.

    A point's image is the one on the mirrored segment at the mirrored place; a point in the middle is its own, sign 0.
    """
    lead, sign = np.arange(len(points)), np.ones(len(points))
    names = [segments[s] for s in points.segments]
    for k in range(len(points)):
        flipped = points.points[k] * (1.0, 1.0, -1.0)
        other = names[k][:-2] + "_r" if names[k].endswith("_l") else names[k]
        same = [
            j for j in range(len(points)) if names[j] == other and np.allclose(points.points[j], flipped, atol=1e-6)
        ]
        if same and abs(points.points[k, 2]) < 1e-9 and names[k] == other and not names[k].endswith("_r"):
            sign[k] = 0.0
        elif same and (names[k].endswith("_l") or points.points[k, 2] < -1e-9) and not names[k].endswith("_r"):
            rank = sum(1 for j in range(k) if names[j] == names[k] and np.allclose(points.points[j], points.points[k]))
            lead[k], sign[k] = same[min(rank, len(same) - 1)], -1.0
    return lead, sign


@dataclass(frozen=True, eq=False)
class _Parameters:
    """What a shape consists of: scales (G,), then three shifts for each point that leads its mirror images."""

    body: Body
    points: PointSet
    shift: NDArray  # (K,) first shift parameter of each point
    mirror: NDArray  # (K,) ±1, sign of z
    prior: NDArray  # (p,) 1/σ²
    mean: NDArray  # (p,)

    def geometry(self, theta: NDArray) -> tuple[KinematicTree, NDArray, NDArray]:
        """The tree, the points (K, 3) in the root frame at rest, and their shifts (K, 3)."""
        tree, groups = self.body.tree, len(self.body.scale_groups)
        factor = theta[:groups][self.body.segment_scale]
        scaled = tree.with_offsets(tree.offsets * factor[np.maximum(tree.parents, 0)][:, None])
        shifts = theta[groups:][self.shift[:, None] + np.arange(3)]
        shifts[:, 2] *= self.mirror
        owner = self.points.segments
        return scaled, self.points.points * factor[owner][:, None] + shifts + scaled.rest[owner], shifts


def _parameters(body: Body, points: PointSet, scales: NDArray, scale_sigma: float, shift_sigma: float) -> _Parameters:
    lead, sign = mirror_points(points, body.tree.segments)
    leaders = np.unique(lead)
    shift = 3 * np.searchsorted(leaders, lead)
    prior = np.concatenate([np.full(len(scales), scale_sigma**-2), np.full(3 * len(leaders), shift_sigma**-2)])
    prior[len(scales) + shift[sign == 0.0] + 2] = _MIDDLE**-2
    mean = np.concatenate([scales, np.zeros(3 * len(leaders))])
    return _Parameters(body, points, shift, np.where(sign == 0.0, 1.0, sign), prior, mean)


def fit_shape(
    body: Body,
    rig: Rig,
    frames: PixelFrames,
    states: Sequence[BodyState],
    scales: NDArray,
    *,
    scale_sigma: float = 0.1,
    shift_sigma: float = 0.01,
    loss: Loss | None = None,
    max_iterations: int = 12,
    tolerance: float = 1e-3,
) -> Shape:
    """Scales, point shifts and poses that explain the pixels of all frames best (P4-7, P4-8's alternation made joint).

    Parameters
    ----------
    body : Body, unscaled: `scales` and the result refer to it.
    states : one for each frame, near the truth.
    scales : (G,) where to start, and the mean of the prior.
    scale_sigma : float
        Spread of each scale about its start, as a share.
    shift_sigma : float [m]
        Spread of a detector's point about the anatomical one, along each axis. It also decides what the data cannot: a
        point shifted along a joint's turn looks the same as the joint turned.
    loss : Loss of a pixel; default Geman-McClure.
    tolerance : float
        Stop when an iteration lowers the cost by less than this share.
    """
    loss = loss or geman_mcclure()
    tree, n = body.tree, body.tree.n_dofs
    model = _parameters(body, frames.points, np.asarray(scales, float), scale_sigma, shift_sigma)
    posture = _POSTURE * np.square(1.0 / tree.spread)
    p, groups = len(model.mean), len(body.scale_groups)
    owner, cameras = frames.points.segments, rig.packed

    def cost_of(theta: NDArray, states: Sequence[BodyState]) -> float:
        moved, rest, _ = model.geometry(theta)
        total = float(model.prior @ np.square(theta - model.mean))
        for f, state in enumerate(states):
            placed, _ = moved.forward(state.T_world_root, state.angles)
            total += float(posture @ np.square(state.angles - tree.usual)) + _kernels_shape.frame_cost(
                owner, rest, cameras, frames.camera, frames.column, frames.uv[f], frames.weight[f], placed,
                loss.kind, loss.scale,
            )  # fmt: skip
        return total

    def system(theta: NDArray, state: BodyState, f: int) -> tuple[NDArray, NDArray]:
        moved, rest, _ = geometry
        placed, screws = moved.forward(state.T_world_root, state.angles)
        H, g = np.zeros((n + p, n + p)), np.zeros(n + p)
        _kernels_shape.frame_system(
            tree.parents, tree.dof_parent, tree.last_dof, tree.offsets, body.segment_scale, groups, owner, rest,
            frames.points.points, model.shift, model.mirror, cameras, frames.camera, frames.column, frames.uv[f],
            frames.weight[f], placed, screws, np.ascontiguousarray(state.T_world_root[:3, 3]), loss.kind, loss.scale,
            H, g,
        )  # fmt: skip
        H[range(6, n), range(6, n)] += posture
        g[6:n] -= posture * (state.angles - tree.usual)
        if not tree.root_free:
            H[:6], H[:, :6], g[:6] = 0.0, 0.0, 0.0
            H[range(6), range(6)] = 1.0
        return H, g

    def step(theta: NDArray, states: Sequence[BodyState], damping: float) -> tuple[NDArray, list[BodyState]]:
        S, b = np.diag(model.prior), model.prior * (model.mean - theta)
        kept = np.empty((len(states), p + 1, n))
        for f, (H, g) in enumerate(systems):
            S += H[n:, n:]
            b += g[n:]
            if not _kernels_linear.eliminate(H, g, n, damping, tree.chain, tree.depth, S, b, kept[f]):
                kept[f] = 0.0
        S += np.tril(S, -1).T - np.triu(S, 1) + damping * np.diag(np.diag(S))
        delta = np.linalg.solve(S, b)
        moves = kept[:, p] - delta @ kept[:, :p]
        new = theta + delta
        new[:groups] = np.clip(new[:groups], 0.2, 5.0)
        return new, [s.retract(m, (tree.lower, tree.upper)) for s, m in zip(states, moves, strict=True)]

    theta, states = model.mean.copy(), list(states)
    cost, damping = cost_of(theta, states), 1e-3
    for _ in range(max_iterations):
        geometry = model.geometry(theta)
        systems = [system(theta, state, f) for f, state in enumerate(states)]
        new, moved = step(theta, states, damping)
        while not (new_cost := cost_of(new, moved)) < cost and damping < 1e4:
            damping *= 10.0
            new, moved = step(theta, states, damping)
        if not new_cost < cost:
            break
        fall, theta, states, cost = cost - new_cost, new, moved, new_cost
        damping = max(damping * 0.1, 1e-9)
        if fall < tolerance * cost:
            break
    return Shape(theta[:groups].copy(), model.geometry(theta)[2], tuple(states), cost)
