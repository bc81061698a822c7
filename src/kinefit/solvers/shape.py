"""A body's shape from many frames: bone lengths and the places of a detector's points, with the poses solved along.

All frames share the shape; each frame's pose is eliminated (Schur complement), so the cost is linear in the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet
from kinefit.geometry.camera import Rig
from kinefit.losses import SQUARED, Loss, geman_mcclure
from kinefit.solvers import _kernels, _kernels_linear, _kernels_shape
from kinefit.solvers.equations import dense_pattern

_MIDDLE = 0.002  # [m] spread of a point in the middle to either side
PROPORTIONS = 0.05
"""How far one length departs from the person's size, as a share.

In the 1988 anthropometric survey of U.S. Army personnel (C. Gordon et al., 1989; J. Cheverud et al., 1990) segment
lengths vary by 4 to 6 % and correlate with stature by 0.5 to 0.9, which leaves 2 to 4 %; and a detector's points are
not quite the body's.
"""
_UNKNOWN_SIZE, _KNOWN_SIZE = 0.2, 0.02  # one standard deviation of a person's size, as a share; shoes, posture, a guess
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
    share : (N,) in 0..1, optional
        How much of a measurement counts beyond the loss: below 1 for points whose errors come together.
    """

    points: PointSet
    camera: NDArray
    column: NDArray
    uv: NDArray
    weight: NDArray
    share: NDArray | None = None

    @property
    def shares(self) -> NDArray:
        """(N,) the share, 1 by default."""
        return np.ones(len(self.column)) if self.share is None else self.share


@dataclass(frozen=True, eq=False)
class Shape:
    """Scales (G,) of the body's groups, shifts (K, 3) [m] of its points in their segments, and the frames' states.

    `parameters` tells what the shape's p parameters are, `theta` (p,) their values, `information` (p, p) what the
    pixels alone tell of them (poses eliminated), `prior` (p, p) what was known before.
    """

    scales: NDArray
    shifts: NDArray
    states: tuple[BodyState, ...]
    cost: float
    parameters: ShapeParameters
    theta: NDArray
    information: NDArray
    prior: NDArray


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
class ShapeParameters:
    """What a shape consists of: scales (G,), then three shifts for each point that leads its mirror images."""

    body: Body
    points: PointSet
    shift: NDArray  # (K,) first shift parameter of each point
    mirror: NDArray  # (K,) ±1, sign of z
    prior: NDArray  # (p, p) inverse covariance
    mean: NDArray  # (p,)

    def geometry(self, theta: NDArray) -> tuple[KinematicTree, NDArray, NDArray]:
        """What `_geometry` gives; the latest is kept, for it is asked once for every frame."""
        key = theta.tobytes()
        if key not in self._latest:
            self._latest.clear()
            self._latest[key] = self._geometry(theta)
        return self._latest[key]

    @cached_property
    def _latest(self) -> dict[bytes, tuple[KinematicTree, NDArray, NDArray]]:
        return {}

    def _geometry(self, theta: NDArray) -> tuple[KinematicTree, NDArray, NDArray]:
        """The tree, the points (K, 3) in the root frame at rest, and their shifts (K, 3)."""
        tree, groups = self.body.tree, len(self.body.scale_groups)
        factor = theta[:groups][self.body.segment_scale]
        scaled = tree.with_offsets(tree.offsets * factor[np.maximum(tree.parents, 0)][:, None])
        shifts = theta[groups:][self.shift[:, None] + np.arange(3)]
        shifts[:, 2] *= self.mirror
        owner = self.points.segments
        return scaled, self.points.points * factor[owner][:, None] + shifts + scaled.rest[owner], shifts

    def equations(
        self, theta: NDArray, state: BodyState, rig: Rig, camera: NDArray, column: NDArray, uv: NDArray,
        weight: NDArray, *, loss: Loss = SQUARED, share: NDArray | None = None, freedom: NDArray | None = None,
        velocity: NDArray | None = None,
    ) -> tuple[NDArray, NDArray]:
        """One frame's pixels as H (n + p, n + p; lower triangle) and g: degrees of freedom, then shape, then cameras.

        camera, column (N,) int, uv (N, 2) [px] and weight (N,) [1/px²] as in `PixelFrames`. With `freedom` (C, 10) the
        cameras' parameters follow (see `solvers.cameras`); velocity (N, 2) [px/s] of the pixels tells of their times.
        """
        tree, body = self.body.tree, self.body
        moved, rest, _ = self.geometry(theta)
        placed, screws = moved.forward(state.T_world_root, state.angles)
        first = tree.n_dofs + len(self.mean)
        size = first + (0 if freedom is None else freedom.size)
        H, g = np.zeros((size, size)), np.zeros(size)
        _kernels_shape.frame_system(
            tree.parents, tree.dof_parent, tree.last_dof, tree.offsets, body.segment_scale, len(body.scale_groups),
            self.points.segments, rest, self.points.points, self.shift, self.mirror, rig.packed, camera, column, uv,
            weight, np.ones(len(weight)) if share is None else share, placed, screws,
            np.ascontiguousarray(state.T_world_root[:3, 3]), loss.kind, loss.scale,
            np.empty((0, 0)) if freedom is None else freedom, -1 if freedom is None else first,
            np.zeros(uv.shape) if velocity is None else velocity, H, g,
        )  # fmt: skip
        return H, g

    def jacobian(self, theta: NDArray, state: BodyState, rig: Rig, camera: NDArray, column: NDArray) -> NDArray:
        """(N, 2, n + p) derivatives of every measurement's pixel by degrees of freedom and shape; zero where unseen."""
        tree, body = self.body.tree, self.body
        moved, rest, _ = self.geometry(theta)
        placed, screws = moved.forward(state.T_world_root, state.angles)
        J = np.zeros((len(column), 2, tree.n_dofs + len(self.mean)))
        _kernels_shape.frame_jacobian(
            tree.parents, tree.dof_parent, tree.last_dof, tree.offsets, body.segment_scale, len(body.scale_groups),
            self.points.segments, rest, self.points.points, self.shift, self.mirror, rig.packed, camera, column, placed,
            screws, np.ascontiguousarray(state.T_world_root[:3, 3]), J,
        )  # fmt: skip
        return J

    def pixels(self, theta: NDArray, state: BodyState, rig: Rig, camera: NDArray, column: NDArray) -> NDArray:
        """(N, 2) [px] where every measurement's point is seen; NaN where it cannot be."""
        moved, rest, _ = self.geometry(theta)
        f, _ = moved.forward(state.T_world_root, state.angles)
        f = f[self.points.segments]
        x = (f[:, :9].reshape(-1, 3, 3) @ rest[:, :, None])[..., 0] + f[:, 9:]
        out = np.empty((len(column), 2))
        for c, one in enumerate(rig):
            out[camera == c] = one.project(x[column[camera == c]])
        return out

    def joint_moves(self, theta: NDArray, state: BodyState) -> tuple[NDArray, NDArray]:
        """How joint centres move (S, 3, n) with the degrees of freedom, and (S, 3, p) with the shape."""
        tree = self.body.tree
        moved, _, _ = self.geometry(theta)
        frames, screws = moved.forward(state.T_world_root, state.angles)
        moves = np.empty((len(tree.segments), 3, tree.n_dofs))
        _kernels.joint_moves(frames, screws, moved.rest, state.T_world_root, tree.dof_parent, tree.last_dof, moves)
        stretch = np.empty((len(tree.segments), len(self.body.scale_groups), 3))
        _kernels_shape.scale_motion(tree.parents, tree.offsets, self.body.segment_scale, frames, stretch)
        shape = np.zeros((len(tree.segments), 3, len(self.mean)))
        shape[:, :, : stretch.shape[1]] = stretch.swapaxes(1, 2)
        return moves, shape

    def with_lengths(self, scales: NDArray, covariance: NDArray) -> ShapeParameters:
        """The same with another prior of the scales: their mean (G,) and covariance (G, G)."""
        mean, prior, groups = self.mean.copy(), self.prior.copy(), len(scales)
        mean[:groups], prior[:groups, :groups] = scales, np.linalg.inv(covariance)
        return replace(self, mean=mean, prior=prior)


def shape_parameters(
    body: Body, points: PointSet, scales: NDArray, scale_sigma: float, shift_sigma: float, *, whole: float | None = None
) -> ShapeParameters:
    """What a body's shape consists of, and its prior: one scale a group, shifts of points [m].

    All scales follow the person's size: `whole` (known to 2 %), or else the middle of `scales`, loosely; each differs
    from it by the share `scale_sigma`. So a length that nothing measures goes with those that something does.
    """
    lead, sign = mirror_points(points, body.tree.segments)
    leaders = np.unique(lead)
    shift = 3 * np.searchsorted(leaders, lead)
    groups, size = len(scales), float(np.median(scales)) if whole is None else whole
    common = (_UNKNOWN_SIZE if whole is None else _KNOWN_SIZE) * size
    prior = np.diag(np.full(groups + 3 * len(leaders), shift_sigma**-2))
    middle = groups + shift[sign == 0.0] + 2
    prior[middle, middle] = _MIDDLE**-2
    prior[:groups, :groups] = np.linalg.inv(np.eye(groups) * (scale_sigma * size) ** 2 + common**2)
    mean = np.concatenate([np.full(groups, size), np.zeros(3 * len(leaders))])
    return ShapeParameters(body, points, shift, np.where(sign == 0.0, 1.0, sign), prior, mean)


def fit_shape(
    body: Body,
    rig: Rig,
    frames: PixelFrames,
    states: Sequence[BodyState],
    scales: NDArray,
    *,
    scale_sigma: float = PROPORTIONS,
    shift_sigma: float = 0.01,
    whole: float | None = None,
    lengths: tuple[NDArray, NDArray] | None = None,
    start: NDArray | None = None,
    loss: Loss | None = None,
    max_iterations: int = 12,
    tolerance: float = 1e-3,
) -> Shape:
    """Scales, point shifts and poses that explain the pixels of all frames best (P4-7, P4-8's alternation made joint).

    Parameters
    ----------
    body : Body, unscaled: `scales` and the result refer to it.
    states : one for each frame, near the truth.
    scales : (G,) where to start; their middle is the person's size, if `whole` is not given.
    scale_sigma : float
        Spread of each scale about the person's size, as a share.
    whole : float, optional
        The person's size, as a share of the body's, where the stature is known.
    lengths : scales (G,) and their covariance (G, G), optional
        What another trial of the same person tells of them, in place of proportions.
    start : (p,) parameters to start from, as an earlier fit of these points left them; default: the scales, no shifts.
    shift_sigma : float [m]
        Spread of a detector's point about the anatomical one, along each axis. It also decides what the data cannot: a
        point shifted along a joint's turn looks the same as the joint turned.
    loss : Loss of a pixel; default Geman-McClure.
    tolerance : float
        Stop when an iteration lowers the cost by less than this share.
    """
    loss = loss or geman_mcclure()
    tree, n = body.tree, body.tree.n_dofs
    model = shape_parameters(body, frames.points, np.asarray(scales, float), scale_sigma, shift_sigma, whole=whole)
    if lengths is not None:
        model = model.with_lengths(*lengths)
    posture = _POSTURE * tree.posture_precision
    chain, depth = dense_pattern(n) if tree.coupled else (tree.chain, tree.depth)
    p, groups = len(model.mean), len(body.scale_groups)
    owner, cameras = frames.points.segments, rig.packed

    def cost_of(theta: NDArray, states: Sequence[BodyState]) -> float:
        moved, rest, _ = model.geometry(theta)
        bent = theta - model.mean
        total = float(bent @ model.prior @ bent)
        for f, state in enumerate(states):
            placed, _ = moved.forward(state.T_world_root, state.angles)
            total += tree.posture_cost(state.angles, _POSTURE) + _kernels_shape.frame_cost(
                owner, rest, cameras, frames.camera, frames.column, frames.uv[f], frames.weight[f],
                frames.shares, placed, loss.kind, loss.scale,
            )  # fmt: skip
        return total

    def system(theta: NDArray, state: BodyState, f: int) -> tuple[NDArray, NDArray]:
        H, g = model.equations(
            theta, state, rig, frames.camera, frames.column, frames.uv[f], frames.weight[f], loss=loss,
            share=frames.shares,
        )
        H[6:n, 6:n] += posture
        g[6:n] -= posture @ (state.angles - tree.usual)
        if not tree.root_free:
            H[:6], H[:, :6], g[:6] = 0.0, 0.0, 0.0
            H[range(6), range(6)] = 1.0
        return H, g

    def step(theta: NDArray, states: Sequence[BodyState], damping: float) -> tuple[NDArray, list[BodyState]]:
        S, b = model.prior.copy(), model.prior @ (model.mean - theta)
        kept = np.empty((len(states), p + 1, n))
        for f, (H, g) in enumerate(systems):
            S += H[n:, n:]
            b += g[n:]
            if not _kernels_linear.eliminate(H, g, n, damping, chain, depth, S, b, kept[f]):
                kept[f] = 0.0
        S = np.tril(S) + np.tril(S, -1).T
        S += damping * np.diag(np.diag(S))
        delta = np.linalg.solve(S, b)
        moves = kept[:, p] - delta @ kept[:, :p]
        new = theta + delta
        new[:groups] = np.clip(new[:groups], 0.2, 5.0)
        return new, [s.retract(m, (tree.lower, tree.upper)) for s, m in zip(states, moves, strict=True)]

    theta, states = np.concatenate([scales, np.zeros(p - groups)]) if start is None else start, list(states)
    cost, damping = cost_of(theta, states), 1e-3
    for _ in range(max_iterations):
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
    information = np.zeros((p, p))
    for f, state in enumerate(states):
        H, g = system(theta, state, f)
        information += H[n:, n:]
        _kernels_linear.eliminate(H, g, n, 1e-9, chain, depth, information, np.zeros(p), np.empty((p + 1, n)))
    information += np.tril(information, -1).T - np.triu(information, 1)
    return Shape(
        theta[:groups].copy(), model.geometry(theta)[2], tuple(states), cost, model, theta, information,
        model.prior,
    )  # fmt: skip
