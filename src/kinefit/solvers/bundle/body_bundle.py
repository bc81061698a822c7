"""Bundle adjustment with a body: fit its shape, its poses and the cameras jointly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.geometry.camera import Rig
from kinefit.losses import geman_mcclure
from kinefit.solvers import _kernels_linear
from kinefit.solvers.bundle import _kernels_shape
from kinefit.solvers.bundle.border_frames import POSTURE_SHARE
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
from kinefit.solvers.least_squares import LEAST_SCALED_DAMPING, relax

_TOLERANCE = 1e-3  # fall of the cost in an iteration, as a share of it, below which the fit ends


@dataclass(frozen=True, eq=False)
class BundleState:
    """Cameras, shape and poses.

    Parameters
    ----------
    rig : Rig
    offsets : (C,) [s]
    theta : (p,) shape parameters
    states : of all frames
    x_static : (P, 3) [m] static points
    """

    rig: Rig
    offsets: NDArray
    theta: NDArray
    states: Sequence[BodyState]
    x_static: NDArray


@dataclass(frozen=True, eq=False)
class BodyBundle(BundleState):
    """Fitted cameras, shape and poses.

    Parameters
    ----------
    cost : float
    S : (C · 10, C · 10) information of the data on the cameras, all other unknowns eliminated
    """

    cost: float
    S: NDArray


def fit_body_and_cameras(
    model: ShapeParameters,
    frames: PixelFrames,
    start: BundleState,
    prior: CameraPrior,
    *,
    static: PointPixels | None = None,
    max_iterations: int = 15,
) -> BodyBundle:
    """Minimise the robust pixel error over cameras, shape and poses (Schur complement: poses and points eliminated).

    Parameters
    ----------
    model : ShapeParameters with its prior
    frames : PixelFrames, with velocities if time offsets are estimated
    start : BundleState
    prior : CameraPrior
    static : PointPixels of static points
    """
    loss = geman_mcclure()
    tree, n, p = model.body.tree, model.body.tree.n_dofs, len(model.mean)
    groups, size = len(model.body.scale_groups), len(start.rig) * COLUMNS
    posture = POSTURE_SHARE * tree.posture_precision
    chain, depth, _ = tree.coupled_pattern
    shape_prior = model.prior
    precision, freedom = prior.precision, prior.freedom
    owner = frames.points.segments
    if static is None:
        static = PointPixels(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))

    def cost_of(at: BundleState) -> float:
        moved, rest, _ = model.geometry(at.theta)
        pixels = frames.with_offsets(at.offsets)
        camera_change, shape_change = prior.departure(at.rig, at.offsets), at.theta - model.mean
        total = float(precision @ camera_change**2 + shape_change @ shape_prior @ shape_change)
        total += robust_cost(residuals(at.rig, at.offsets, static, at.x_static), static.weight, loss)[0]
        for f, state in enumerate(at.states):
            placed, _ = moved.forward(state.T_world_root, state.angles)
            total += tree.posture_cost(state.angles, POSTURE_SHARE) + _kernels_shape.frame_cost(
                owner, rest, at.rig.packed, frames.camera, frames.column, pixels.uv[f], frames.weight[f],
                frames.shares, placed, loss.kind, loss.scale,
            )  # fmt: skip
        return total

    def systems_of(at: BundleState) -> list[tuple[NDArray, NDArray]]:
        out, pixels = [], frames.with_offsets(at.offsets)
        for f, state in enumerate(at.states):
            H, g = model.equations(at.theta, state, at.rig, pixels, f, loss=loss, freedom=freedom)
            H[6:n, 6:n] += posture
            g[6:n] -= posture @ (state.angles - tree.usual)
            if not tree.root_free:
                H[:6], H[:, :6], g[:6] = 0.0, 0.0, 0.0
                H[range(6), range(6)] = 1.0
            out.append((H, g))
        return out

    def reduced(
        systems: list[tuple[NDArray, NDArray]], at: BundleState, damping: float
    ) -> tuple[NDArray, NDArray, NDArray, Reduced]:
        points = reduce_points(at.rig, at.offsets, freedom, static, at.x_static, loss, damping)
        S, b = np.zeros((p + size, p + size)), np.zeros(p + size)
        S[:p, :p], b[:p] = shape_prior, shape_prior @ (model.mean - at.theta)
        S[p:, p:], b[p:] = points.S, points.b
        solutions = np.empty((len(systems), p + size + 1, n))
        for f, (H, g) in enumerate(systems):
            S += H[n:, n:]
            b += g[n:]
            if not _kernels_linear.eliminate(H, g, n, damping, chain, depth, S, b, solutions[f]):
                solutions[f] = 0.0
        return np.tril(S) + np.tril(S, -1).T, b, solutions, points

    now, cost, damping = start, cost_of(start), 1e-3
    for _ in range(max_iterations):
        systems, before = systems_of(now), cost
        while damping < 1e5:
            S, b, solutions, points = reduced(systems, now, damping)
            S[range(p, p + size), range(p, p + size)] += precision
            b[p:] -= precision * prior.departure(now.rig, now.offsets)
            delta = np.linalg.solve(S + damping * np.diag(np.diag(S)), b)
            by_camera = delta[p:].reshape(-1, COLUMNS)
            theta = now.theta + delta[:p]
            theta[:groups] = np.clip(theta[:groups], 0.2, 5.0)
            moves = solutions[:, -1] - delta @ solutions[:, :-1]
            new = BundleState(
                moved_rig(now.rig, by_camera), now.offsets + by_camera[:, TIME], theta,
                [s.retract(m, (tree.lower, tree.upper)) for s, m in zip(now.states, moves, strict=True)],
                now.x_static + points.points_step(delta[p:]),
            )  # fmt: skip
            if (fallen := cost_of(new)) < cost:
                now, cost, damping = new, fallen, relax(damping)
                break
            damping *= 10.0
        if not before - cost > _TOLERANCE * cost:
            break
    S, _, _, _ = reduced(systems_of(now), now, LEAST_SCALED_DAMPING)
    body, across, cameras = S[:p, :p], S[:p, p:], S[p:, p:]
    S = cameras - across.T @ np.linalg.solve(body, across)
    return BodyBundle(now.rig, now.offsets, now.theta, tuple(now.states), now.x_static, cost, S)
