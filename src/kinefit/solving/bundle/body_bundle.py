"""What cameras see of free points, and of a body with unknown shape and poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.losses import Loss, geman_mcclure
from kinefit.solving.bundle.adjust import BundleProblem, BundleState
from kinefit.solving.bundle.arrow import Arrow, Blocks, assembled
from kinefit.solving.bundle.border_frames import POSTURE_SHARE
from kinefit.solving.bundle.cameras import CameraPrior, PointPixels, pixel_rows
from kinefit.solving.bundle.shape import PixelFrames, ShapeParameters
from kinefit.solving.equations import block_diagonal

_INVISIBLE_SQUARE = 1e6  # squared residual, in variances, of a point that its camera cannot see
_SCALE_LIMITS = 0.2, 5.0  # of a length


@dataclass(frozen=True, eq=False)
class PointProblem(BundleProblem):
    """Pixels of free points, the blocks of a `BundleState`.

    Parameters
    ----------
    points : PointPixels
    loss : Loss of a pixel
    """

    points: PointPixels
    loss: Loss = field(default_factory=geman_mcclure)

    def linearised(self, state: BundleState, prior: CameraPrior) -> tuple[Arrow, float, None]:
        """Equations and cost."""
        pixels, x = self.points, state.blocks
        uv = pixels.uv - state.offsets[pixels.camera, None] * pixels.motion
        A = pixel_rows(state.rig, prior, pixels.camera, x[pixels.point], uv, motion=pixels.motion)
        s2 = pixels.weight * np.sum(A[..., -1] ** 2, axis=1)
        visible = np.isfinite(s2)
        A[~visible] = 0.0
        rho, factor = self.loss.weigh(np.where(visible, s2, _INVISIBLE_SQUARE))
        grams = A.swapaxes(1, 2) @ ((pixels.weight * factor)[:, None, None] * A)
        return assembled(grams, pixels.camera, pixels.point, prior.free, len(x)), float(rho.sum()), None

    def moved(self, state: BundleState, delta: NDArray, moves: Sequence[NDArray]) -> BundleState:
        """The state with moved points."""
        return replace(state, blocks=state.blocks + moves[0])


@dataclass(frozen=True, eq=False)
class BodyProblem(PointProblem):
    """Pixels of free points, and of a body whose shape is before the cameras in the border.

    Parameters
    ----------
    model : ShapeParameters with its prior
    frames : PixelFrames of the body
    """

    model: ShapeParameters = field(kw_only=True)
    frames: PixelFrames = field(kw_only=True)

    def linearised(self, state: BundleState, prior: CameraPrior) -> tuple[Arrow, float, None]:
        """Equations and cost, the poses as a second kind of blocks."""
        arrow, cost, _ = super().linearised(state, prior)
        model, tree = self.model, self.model.body.tree
        n, p, F = tree.n_dofs, len(state.theta), len(state.states)
        m, pixels, away = p + len(arrow.g), self.frames.with_offsets(state.offsets), model.mean - state.theta
        posture, cost = POSTURE_SHARE * tree.posture_precision, cost + float(away @ model.prior @ away)
        border, pull = block_diagonal(model.prior, arrow.H), np.concatenate([model.prior @ away, arrow.g])
        H, g, B = np.empty((F, n, n)), np.empty((F, n)), np.empty((F, n, m))
        for f, pose in enumerate(state.states):
            whole, gradient, more = model.equations(state.theta, pose, state.rig, prior.place, pixels, f, self.loss)
            H[f], g[f], B[f] = whole[:n, :n], gradient[:n], whole[n:, :n].T
            border += np.tril(whole[n:, n:]) + np.tril(whole[n:, n:], -1).T
            pull += gradient[n:]
            H[f, 6:, 6:] += posture
            g[f, 6:] -= posture @ (pose.angles - tree.usual)
            cost += more + tree.posture_cost(pose.angles, POSTURE_SHARE)
        H = np.tril(H) + np.tril(H, -1).swapaxes(1, 2)
        if not tree.root_free:
            H[:, :6], H[:, :, :6], B[:, :6], g[:, :6] = np.eye(6, n), np.eye(n, 6), 0.0, 0.0
        (of_points,) = arrow.blocks
        padded = Blocks(of_points.H, of_points.g, np.pad(of_points.B, ((0, 0), (0, 0), (p, 0))))
        return Arrow(border, pull, (padded, Blocks(H, g, B))), cost, None

    def moved(self, state: BundleState, delta: NDArray, moves: Sequence[NDArray]) -> BundleState:
        """The state with moved points, shape and poses; lengths and coordinates stay within their limits."""
        tree, groups, theta = self.model.body.tree, len(self.model.body.scale_groups), state.theta + delta
        theta[:groups] = np.clip(theta[:groups], *_SCALE_LIMITS)
        states = [s.retract(m, (tree.lower, tree.upper)) for s, m in zip(state.states, moves[1], strict=True)]
        return replace(super().moved(state, delta, moves), theta=theta, states=states)
