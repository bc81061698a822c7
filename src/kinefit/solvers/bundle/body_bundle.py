"""Bundle adjustment with a body: its shape, its pose in every frame, and the cameras, in one least-squares fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.geometry.camera import Rig
from kinefit.losses import Loss, geman_mcclure
from kinefit.solvers import _kernels_linear
from kinefit.solvers.bundle import _kernels_shape
from kinefit.solvers.bundle.border_frames import POSTURE
from kinefit.solvers.bundle.cameras import (
    COLUMNS,
    TIME,
    CameraPrior,
    PointPixels,
    Reduced,
    moved_rig,
    reduce_points,
    residuals,
    robust_cost,
)
from kinefit.solvers.bundle.shape import PixelFrames, ShapeParameters
from kinefit.solvers.equations import dense_pattern
from kinefit.solvers.least_squares import LEAST_SCALED_DAMPING, relax


@dataclass(frozen=True, eq=False)
class BodyBundle:
    """Cameras, shape and poses that agree best.

    Parameters
    ----------
    rig : Rig
    offsets : (C,) [s]
    theta : (p,) shape parameters.
    states : of all frames.
    x_static : (P, 3) [m]
    cost : float
    S : (C · 10, C · 10) information of the data about the cameras, all else taken out.
    """

    rig: Rig
    offsets: NDArray
    theta: NDArray
    states: tuple[BodyState, ...]
    x_static: NDArray
    cost: float
    S: NDArray


def fit_body_and_cameras(
    model: ShapeParameters,
    rig: Rig,
    frames: PixelFrames,
    velocity: NDArray,
    states: Sequence[BodyState],
    theta: NDArray,
    prior: CameraPrior,
    *,
    static: PointPixels | None = None,
    x_static: NDArray | None = None,
    offsets: NDArray | None = None,
    loss: Loss | None = None,
    max_iterations: int = 15,
    tolerance: float = 1e-3,
) -> BodyBundle:
    """Cameras, shape and poses of least robust pixel error (Schur complement: poses and static points taken out).

    Parameters
    ----------
    model : ShapeParameters with its prior.
    velocity : (F, N, 2) [px/s] of the pixels, for time offsets.
    states, theta, rig, x_static (P, 3) [m], offsets (C,) [s] : where to start.
    prior : CameraPrior
    static : PointPixels of points that do not move.
    """
    loss = loss or geman_mcclure()
    tree, n, p = model.body.tree, model.body.tree.n_dofs, len(model.mean)
    groups, size = len(model.body.scale_groups), len(rig) * COLUMNS
    posture = POSTURE * tree.posture_precision
    chain, depth = dense_pattern(n) if tree.coupled else (tree.chain, tree.depth)
    shape_prior = model.prior
    precision, freedom = prior.precision, prior.freedom
    owner = frames.points.segments
    offsets = np.zeros(len(rig)) if offsets is None else offsets
    x_static = np.zeros((0, 3)) if x_static is None else x_static
    if static is None:
        static = PointPixels(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))

    def target(offsets: NDArray, f: int) -> NDArray:
        return frames.uv[f] - offsets[frames.camera, None] * velocity[f]

    def cost_of(
        rig: Rig, offsets: NDArray, theta: NDArray, states: Sequence[BodyState], x: NDArray
    ) -> float:
        moved, rest, _ = model.geometry(theta)
        away, bent = prior.departure(rig, offsets), theta - model.mean
        total = float(precision @ away**2 + bent @ shape_prior @ bent)
        total += robust_cost(residuals(rig, offsets, static, x), static.weight, loss)[0]
        for f, state in enumerate(states):
            placed, _ = moved.forward(state.T_world_root, state.angles)
            total += tree.posture_cost(state.angles, POSTURE) + _kernels_shape.frame_cost(
                owner, rest, rig.packed, frames.camera, frames.column, target(offsets, f), frames.weight[f],
                frames.shares, placed, loss.kind, loss.scale,
            )  # fmt: skip
        return total

    def systems_of(
        rig: Rig, offsets: NDArray, theta: NDArray, states: Sequence[BodyState]
    ) -> list[tuple[NDArray, NDArray]]:
        out = []
        for f, state in enumerate(states):
            H, g = model.equations(
                theta, state, rig, frames.camera, frames.column, target(offsets, f), frames.weight[f], loss=loss,
                share=frames.shares, freedom=freedom, velocity=velocity[f],
            )
            H[6:n, 6:n] += posture
            g[6:n] -= posture @ (state.angles - tree.usual)
            if not tree.root_free:
                H[:6], H[:, :6], g[:6] = 0.0, 0.0, 0.0
                H[range(6), range(6)] = 1.0
            out.append((H, g))
        return out

    def reduced(
        systems: list[tuple[NDArray, NDArray]], theta: NDArray, rig: Rig, offsets: NDArray, x: NDArray, damping: float
    ) -> tuple[NDArray, NDArray, NDArray, Reduced]:
        points = reduce_points(rig, offsets, freedom, static, x, loss, damping)
        S, b = np.zeros((p + size, p + size)), np.zeros(p + size)
        S[:p, :p], b[:p] = shape_prior, shape_prior @ (model.mean - theta)
        S[p:, p:], b[p:] = points.S, points.b
        kept = np.empty((len(systems), p + size + 1, n))
        for f, (H, g) in enumerate(systems):
            S += H[n:, n:]
            b += g[n:]
            if not _kernels_linear.eliminate(H, g, n, damping, chain, depth, S, b, kept[f]):
                kept[f] = 0.0
        return np.tril(S) + np.tril(S, -1).T, b, kept, points

    cost, damping = cost_of(rig, offsets, theta, states, x_static), 1e-3
    states = list(states)
    for _ in range(max_iterations):
        systems, before = systems_of(rig, offsets, theta, states), cost
        while damping < 1e5:
            S, b, kept, points = reduced(systems, theta, rig, offsets, x_static, damping)
            S[range(p, p + size), range(p, p + size)] += precision
            b[p:] -= precision * prior.departure(rig, offsets)
            delta = np.linalg.solve(S + damping * np.diag(np.diag(S)), b)
            by_camera = delta[p:].reshape(-1, COLUMNS)
            new_theta = theta + delta[:p]
            new_theta[:groups] = np.clip(new_theta[:groups], 0.2, 5.0)
            moves = kept[:, -1] - delta @ kept[:, :-1]
            new_states = [s.retract(m, (tree.lower, tree.upper)) for s, m in zip(states, moves, strict=True)]
            new_rig, new_offsets = moved_rig(rig, by_camera), offsets + by_camera[:, TIME]
            new_x = x_static + points.points_step(delta[p:])
            new = cost_of(new_rig, new_offsets, new_theta, new_states, new_x)
            if new < cost:
                rig, offsets, theta, states, x_static = new_rig, new_offsets, new_theta, new_states, new_x
                cost, damping = new, relax(damping)
                break
            damping *= 10.0
        if not before - cost > tolerance * cost:
            break
    last = systems_of(rig, offsets, theta, states)
    S, _, _, _ = reduced(last, theta, rig, offsets, x_static, LEAST_SCALED_DAMPING)
    body, across, cameras = S[:p, :p], S[:p, p:], S[p:, p:]
    S = cameras - across.T @ np.linalg.solve(body, across)
    return BodyBundle(rig, offsets, theta, tuple(states), x_static, cost, S)
