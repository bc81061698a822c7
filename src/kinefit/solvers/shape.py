"""A body's shape from many frames: bone lengths and the places of a detector's points, with the poses solved along.

All frames share the shape; each frame's pose is eliminated (Schur complement), so the cost is linear in the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.geometry.camera import Rig
from kinefit.solvers import _kernels, _kernels_shape
from kinefit.solvers.losses import Loss, geman_mcclure


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
        same = [j for j in range(len(points)) if names[j] == other and np.allclose(points.points[j], flipped, atol=1e-6)]
        if same and abs(points.points[k, 2]) < 1e-9 and names[k] == other and not names[k].endswith("_r"):
            sign[k] = 0.0
        elif same and (names[k].endswith("_l") or points.points[k, 2] < -1e-9) and not names[k].endswith("_r"):
            rank = sum(1 for j in range(k) if names[j] == names[k] and np.allclose(points.points[j], points.points[k]))
            lead[k], sign[k] = same[min(rank, len(same) - 1)], -1.0
    return lead, sign


def fit_shape(
    body: Body,
    rig: Rig,
    frames: PixelFrames,
    states: Sequence[BodyState],
    scales: NDArray,
    *,
    scale_sigma: float = 0.1,
    shift_sigma: float = 0.03,
    posture_sigma: NDArray | None = None,
    loss: Loss | None = None,
    max_iterations: int = 12,
    tolerance: float = 1e-4,
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
        Spread of a detector's point about the anatomical one, along each axis.
    posture_sigma : (D,) [rad]
        Spread of the angles about zero; default: half of each range.
    """
    loss = loss or geman_mcclure()
    tree, G, n = body.tree, len(body.scale_groups), body.tree.n_dofs
    base = frames.points.points
    lead, sign = mirror_points(frames.points, tree.segments)
    owners = np.unique(lead)
    first = {int(k): 3 * i for i, k in enumerate(owners)}
    shift_index = np.array([first[int(k)] for k in lead])
    z_sign = np.where(sign == 0.0, 1.0, sign)
    p = G + 3 * len(owners)
    prior = np.concatenate([np.full(G, scale_sigma**-2), np.full(p - G, shift_sigma**-2)])
    for k in np.flatnonzero(sign == 0.0):
        prior[G + shift_index[k] + 2] = 0.002**-2  # a point in the middle stays there
    mean = np.concatenate([scales, np.zeros(p - G)])
    posture = posture_weights(body) if posture_sigma is None else np.asarray(posture_sigma, float) ** -2.0
    theta, states = mean.copy(), list(states)

    def rest_points(theta: NDArray) -> tuple[NDArray, NDArray]:
        factor = theta[:G][body.segment_scale]
        offsets = tree.offsets * factor[np.maximum(tree.parents, 0)][:, None]
        rest = tree.with_offsets(offsets)
        shifts = theta[G:][shift_index[:, None] + np.arange(3)] * np.stack([np.ones_like(z_sign)] * 2 + [z_sign], 1)
        points = base * factor[frames.points.segments][:, None] + shifts
        return rest, points + rest.rest[frames.points.segments]  # type: ignore[return-value]

    def evaluate(theta: NDArray, states: list[BodyState]) -> float:
        moved, rest = rest_points(theta)
        total = float(prior @ (theta - mean) ** 2)
        for f, state in enumerate(states):
            placed, _ = moved.forward(state.T_world_root, state.angles)  # type: ignore[attr-defined]
            total += _kernels_shape.frame_cost(
                frames.points.segments, rest, rig.packed, frames.camera, frames.column, frames.uv[f], frames.weight[f],
                placed, loss.kind, loss.scale,
            ) + float(posture @ state.angles**2)  # fmt: skip
        return total

    cost, damping = evaluate(theta, states), 1e-3
    for _ in range(max_iterations):
        moved, rest = rest_points(theta)
        S, b = np.diag(prior), prior * (mean - theta)
        parts = []
        for f, state in enumerate(states):
            placed, screws = moved.forward(state.T_world_root, state.angles)  # type: ignore[attr-defined]
            H, g = np.zeros((n + p, n + p)), np.zeros(n + p)
            _kernels_shape.frame_system(
                tree.parents, tree.dof_parent, tree.last_dof, tree.offsets, body.segment_scale, G,
                frames.points.segments, rest, base, shift_index, z_sign, rig.packed, frames.camera, frames.column,
                frames.uv[f], frames.weight[f], placed, screws, np.ascontiguousarray(state.T_world_root[:3, 3]),
                loss.kind, loss.scale, H, g,
            )  # fmt: skip
            H += np.tril(H, -1).T
            H[range(6, n), range(6, n)] += posture
            g[6:n] -= posture * state.angles
            parts.append((H[:n, :n], H[:n, n:], g[:n]))
            S += H[n:, n:]
            b += g[n:]
        while True:
            reduced, right, kept = S + damping * np.diag(np.diag(S)), b.copy(), []
            for A, B, g in parts:
                factor = cho_factor(A + damping * np.diag(np.diag(A) + 1e-6 * np.trace(A) / n), check_finite=False)
                both = cho_solve(factor, np.concatenate([B, g[:, None]], axis=1), check_finite=False)
                reduced -= B.T @ both[:, :-1]
                right -= B.T @ both[:, -1]
                kept.append(both)
            delta = np.linalg.solve(reduced, right)
            new_theta = theta + delta
            new_theta[:G] = np.clip(new_theta[:G], 0.3, 3.0)
            new_states = [
                _within(body, s.retract(both[:, -1] - both[:, :-1] @ delta)) for s, both in zip(states, kept, strict=True)
            ]
            new_cost = evaluate(new_theta, new_states)
            if new_cost < cost or damping > 1e6:
                break
            damping *= 10.0
        if new_cost >= cost:
            break
        gain, theta, states, cost = cost - new_cost, new_theta, new_states, new_cost
        damping = max(damping * 0.2, 1e-9)
        if gain < tolerance * cost:
            break
    _, rest = rest_points(theta)
    factor = theta[:G][body.segment_scale]
    shifts = rest - moved_rest(body, theta[:G])[frames.points.segments] - base * factor[frames.points.segments][:, None]
    return Shape(theta[:G].copy(), shifts, tuple(states), cost)


def posture_weights(body: Body) -> NDArray:
    """(D,) [1/rad²] weak prior towards zero: half of each coordinate's range is one standard deviation."""
    half = 0.5 * (body.tree.upper - body.tree.lower)
    return np.where(np.isfinite(half), 1.0 / np.square(np.where(np.isfinite(half), np.maximum(half, 0.05), 1.0)), 0.0)


def moved_rest(body: Body, scales: NDArray) -> NDArray:
    """(S, 3) [m] joint centres at rest of a body with other scales."""
    factor = np.asarray(scales)[body.segment_scale]
    return body.tree.with_offsets(body.tree.offsets * factor[np.maximum(body.tree.parents, 0)][:, None]).rest


def _within(body: Body, state: BodyState) -> BodyState:
    return BodyState(state.T_world_root, np.clip(state.angles, body.tree.lower, body.tree.upper))
