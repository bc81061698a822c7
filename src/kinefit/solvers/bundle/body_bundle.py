"""Bundle adjustment: cameras with free points, and with a body's shape and poses (B. Triggs et al., 1999)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.geometry.camera import Rig
from kinefit.losses import Loss, geman_mcclure
from kinefit.solvers.bundle.arrow import Arrow, Blocks
from kinefit.solvers.bundle.border_frames import POSTURE_SHARE
from kinefit.solvers.bundle.cameras import COLUMNS, TIME, CameraPrior, PointPixels, moved_rig, point_arrow
from kinefit.solvers.bundle.shape import PixelFrames, ShapeParameters
from kinefit.solvers.equations import block_diagonal
from kinefit.solvers.least_squares import descend

_SCALE_LIMITS = 0.2, 5.0  # of a length


@dataclass(frozen=True, eq=False)
class BundleState:
    """Cameras, points, and shape and poses of a body.

    Parameters
    ----------
    rig : Rig
    offsets : (C,) [s]
    x_static : (P, 3) [m] free points
    theta : (p,) shape parameters
    states : of all frames
    """

    rig: Rig
    offsets: NDArray
    x_static: NDArray
    theta: NDArray = field(default_factory=lambda: np.zeros(0))
    states: Sequence[BodyState] = ()


@dataclass(frozen=True, eq=False)
class Bundle(BundleState):
    """A state, its cost with the priors, and its equations without the cameras' prior.

    Parameters
    ----------
    cost : float
    arrow : Arrow, shape parameters before those of the cameras
    """

    cost: float = 0.0
    arrow: Arrow = field(kw_only=True)

    @cached_property
    def S(self) -> NDArray:
        """(C · 10, C · 10) information of the data on the cameras, all other unknowns eliminated."""
        p, S = len(self.theta), self.arrow.reduced(*self.arrow.relative(0.0))[0]
        return np.asarray(S[p:, p:] - S[p:, :p] @ np.linalg.solve(S[:p, :p], S[:p, p:]))


def adjust(
    start: BundleState,
    prior: CameraPrior,
    points: PointPixels | None = None,
    *,
    model: ShapeParameters | None = None,
    frames: PixelFrames | None = None,
    loss: Loss | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-4,
) -> Bundle:
    """Minimise the robust pixel error over cameras, free points, shape and poses (Schur complement).

    Parameters
    ----------
    prior : CameraPrior
        Free parameters and their priors. Without priors only the damping fixes the gauge (position, rotation, scale).
    points : PointPixels of the free points
    model : ShapeParameters with its prior; None if no body is seen
    frames : PixelFrames of the body, with velocities if time offsets are estimated
    tolerance : float
        Share of the cost; a step that is predicted to lower it by less is not taken.
    """
    loss, points = loss or geman_mcclure(), points or PointPixels.none()

    def at(rig: Rig, offsets: NDArray, x: NDArray, theta: NDArray, states: Sequence[BodyState]) -> Bundle:
        arrow, cost = point_arrow(rig, offsets, prior.freedom, points, x, loss)
        if model is not None and frames is not None:
            arrow, more = _with_body(arrow, model, frames, BundleState(rig, offsets, x, theta, states), prior, loss)
            cost += more
        return Bundle(rig, offsets, x, theta, states, cost + prior.cost(rig, offsets), arrow=arrow)

    def solve(now: Bundle, damping: float) -> tuple[tuple[NDArray, list[NDArray]], float]:
        information, pull = prior.equations(now.rig, now.offsets)
        before = np.zeros(len(now.theta))
        both = np.concatenate([before, information]), np.concatenate([before, pull])
        return now.arrow.with_prior(*both).relative_step(damping)

    def follow(now: Bundle, move: tuple[NDArray, list[NDArray]]) -> Bundle | None:
        (delta, (x, *poses)), p, theta, states = move, len(now.theta), now.theta, now.states
        if model is not None:
            tree, groups, theta = model.body.tree, len(model.body.scale_groups), theta + delta[:p]
            theta[:groups] = np.clip(theta[:groups], *_SCALE_LIMITS)
            states = [s.retract(m, (tree.lower, tree.upper)) for s, m in zip(states, poses[0], strict=True)]
        try:
            rig, late = moved_rig(now.rig, delta[p:].reshape(-1, COLUMNS)), delta[p:].reshape(-1, COLUMNS)[:, TIME]
            return at(rig, now.offsets + late, now.x_static + x, theta, states)
        except ValueError:  # no camera: its distortion overflows
            return None

    begin = at(start.rig, start.offsets, start.x_static, start.theta, start.states)
    return descend(begin, solve, follow, iterations=max_iterations, tolerance=tolerance, damping=1e-3).at


def _with_body(
    arrow: Arrow, model: ShapeParameters, frames: PixelFrames, at: BundleState, prior: CameraPrior, loss: Loss
) -> tuple[Arrow, float]:
    """The arrow of cameras and points, with the poses as blocks and the shape before the cameras; the body's cost."""
    tree, n, p, F = model.body.tree, model.body.tree.n_dofs, len(at.theta), len(at.states)
    m, pixels, away = p + len(arrow.g), frames.with_offsets(at.offsets), model.mean - at.theta
    posture, cost = POSTURE_SHARE * tree.posture_precision, float(away @ model.prior @ away)
    border, pull = block_diagonal(model.prior, arrow.H), np.concatenate([model.prior @ away, arrow.g])
    H, g, B = np.empty((F, n, n)), np.empty((F, n)), np.empty((F, n, m))
    for f, state in enumerate(at.states):
        whole, gradient, more = model.equations(at.theta, state, at.rig, pixels, f, loss=loss, freedom=prior.freedom)
        H[f], g[f], B[f] = whole[:n, :n], gradient[:n], whole[n:, :n].T
        border += np.tril(whole[n:, n:]) + np.tril(whole[n:, n:], -1).T
        pull += gradient[n:]
        H[f, 6:, 6:] += posture
        g[f, 6:] -= posture @ (state.angles - tree.usual)
        cost += more + tree.posture_cost(state.angles, POSTURE_SHARE)
    H = np.tril(H) + np.tril(H, -1).swapaxes(1, 2)
    if not tree.root_free:
        H[:, :6], H[:, :, :6], B[:, :6], g[:, :6] = np.eye(6, n), np.eye(n, 6), 0.0, 0.0
    (of_points,) = arrow.blocks
    padded = Blocks(of_points.H, of_points.g, np.pad(of_points.B, ((0, 0), (0, 0), (p, 0))))
    return Arrow(border, pull, (padded, Blocks(H, g, B))), cost
