"""A body's shape as parameters (lengths, landmark offsets of a detector), and normal equations of pixels in them.

What cameras see of free points, and of a body with unknown shape and poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import Loss, geman_mcclure
from kinefit.solving.bundle import _kernels
from kinefit.solving.bundle.adjust import BundleProblem, BundleState
from kinefit.solving.bundle.arrow import Arrow, Blocks, assembled
from kinefit.solving.bundle.border_frames import POSTURE_SHARE
from kinefit.solving.bundle.cameras import CameraPrior, PointPixels, pixel_rows
from kinefit.solving.equations import block_diagonal

_MIDLINE_STD = 0.002  # [m] of a midline point to either side
PROPORTIONS = 0.05
"""Standard deviation of one length about the person's size, as a share.

In the 1988 anthropometric survey of U.S. Army personnel (C. Gordon et al., 1989; J. Cheverud et al., 1990) segment
lengths vary by 4 to 6 % and correlate with stature by 0.5 to 0.9, which leaves 2 to 4 %. A detector's points add some.
"""
_UNKNOWN_SIZE_STD = 0.2  # of a person's size, as a share


@dataclass(frozen=True, eq=False)
class PixelFrames:
    """Pixels of N measurements over F frames.

    Parameters
    ----------
    points : PointSet of K points on the body, before scaling and landmark offsets
    camera : (N,) int, index in the rig
    column : (N,) int, which of the K points
    uv : (F, N, 2) [px]
    weight : (F, N) [1/px²], 0 where undetected
    share : (N,) in 0..1
        Factor on a measurement's cost: below 1 for points with correlated errors.
    velocity : (F, N, 2) [px/s] of the pixels, for time offsets
    """

    points: PointSet
    camera: NDArray
    column: NDArray
    uv: NDArray
    weight: NDArray
    share: NDArray
    velocity: NDArray

    def with_offsets(self, offsets: NDArray) -> PixelFrames:
        """The pixels corrected for clocks of cameras that are late by `offsets` (C,) [s]."""
        return replace(self, uv=self.uv - offsets[self.camera, None] * self.velocity)


@lru_cache(maxsize=32)  # every kind of parameters calls it again
def mirror_points(points: PointSet, segments: tuple[str, ...]) -> tuple[NDArray, NDArray]:
    """For each point the number (K,) of the point whose offset it shares, and the sign (K,) of its z.

    Left and right share an offset. A point's mirror image is the point on the mirrored segment at the mirrored place. A
    midline point is its own mirror image, with sign 0.
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
    lead.flags.writeable = sign.flags.writeable = False
    return lead, sign


@dataclass(frozen=True, eq=False)
class ShapeParameters:
    """Parameters of a shape (p,): scales (G,), then a landmark offset (3,) for each point or pair of mirror images."""

    body: Body
    points: PointSet
    shift: NDArray  # (K,) first offset parameter of each point
    mirror: NDArray  # (K,) ±1, sign of z
    prior: NDArray  # (p, p) inverse covariance
    mean: NDArray  # (p,)

    def geometry(self, theta: NDArray) -> tuple[KinematicTree, NDArray, NDArray]:
        """Tree, points (K, 3) [m] in the root frame in the rest pose, offsets (K, 3) [m]; cached for the last theta."""
        key = theta.tobytes()
        if key not in self._latest:
            self._latest.clear()
            self._latest[key] = self._geometry(theta)
        return self._latest[key]

    @cached_property
    def _latest(self) -> dict[bytes, tuple[KinematicTree, NDArray, NDArray]]:
        return {}

    def _geometry(self, theta: NDArray) -> tuple[KinematicTree, NDArray, NDArray]:
        """As `geometry`, computed."""
        tree, groups = self.body.tree, len(self.body.scale_groups)
        factor = theta[:groups][self.body.segment_scale]
        scaled = tree.with_offsets(tree.offsets * factor[np.maximum(tree.parents, 0)][:, None])
        shifts = theta[groups:][self.shift[:, None] + np.arange(3)]
        shifts[:, 2] *= self.mirror
        owner = self.points.segments
        return scaled, self.points.points * factor[owner][:, None] + shifts + scaled.rest[owner], shifts

    def equations(
        self, theta: NDArray, state: BodyState, rig: Rig, place: NDArray, pixels: PixelFrames, f: int, loss: Loss
    ) -> tuple[NDArray, NDArray, float]:
        """Equations of frame f's pixels: H (m, m; lower triangle), g (m,), and their cost.

        Unknowns are the pose (n,), the shape (p,) and the cameras' free parameters, as `CameraPrior.place` lists them.
        """
        tree, body = self.body.tree, self.body
        moved, rest, _ = self.geometry(theta)
        placed, screws = moved.forward(state.T_world_root, state.angles)
        first = tree.n_dofs + len(self.mean)
        size = first + place.max(initial=-1) + 1
        H, g = np.zeros((size, size)), np.zeros(size)
        cost = _kernels.frame_system(
            tree.parents, tree.dof_parent, tree.last_dof, tree.offsets, body.segment_scale, len(body.scale_groups),
            self.points.segments, rest, self.points.points, self.shift, self.mirror, rig.packed, pixels.camera,
            pixels.column, pixels.uv[f], pixels.weight[f], pixels.share, placed, screws,
            np.ascontiguousarray(state.T_world_root[:3, 3]), loss.kind, loss.scale,
            np.where(place < 0, -1, first + place), pixels.velocity[f], H, g,
        )  # fmt: skip
        return H, g, cost


def shape_parameters(
    body: Body, points: PointSet, scales: NDArray, scale_sigma: float, shift_sigma: float
) -> ShapeParameters:
    """Parameters of a body's shape, with their prior: one scale for each group, landmark offsets [m] of points.

    All scales follow the person's size, so an unmeasured length follows the measured ones.

    Parameters
    ----------
    scales : (G,) first estimates of the scales; their median is the size as a share of the body's, known to 20 %
    scale_sigma : standard deviation of each scale about the size, as a share
    shift_sigma : [m] standard deviation of a landmark offset
    """
    lead, sign = mirror_points(points, body.tree.segments)
    leaders = np.unique(lead)
    shift = 3 * np.searchsorted(leaders, lead)
    groups, size = len(scales), float(np.median(scales))
    common = _UNKNOWN_SIZE_STD * size
    prior = np.diag(np.full(groups + 3 * len(leaders), shift_sigma**-2))
    middle = groups + shift[sign == 0.0] + 2
    prior[middle, middle] = _MIDLINE_STD**-2
    prior[:groups, :groups] = np.linalg.inv(np.eye(groups) * (scale_sigma * size) ** 2 + common**2)
    mean = np.concatenate([np.full(groups, size), np.zeros(3 * len(leaders))])
    return ShapeParameters(body, points, shift, np.where(sign == 0.0, 1.0, sign), prior, mean)


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
