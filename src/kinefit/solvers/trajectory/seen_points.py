"""Normal equations of all frames of a take from keypoints and foot contacts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.geometry.camera import Rig
from kinefit.losses import SQUARED, Loss
from kinefit.solvers.trajectory import _kernels_smoothing
from kinefit.solvers.trajectory.smoothing import Equations, MakeEquations

NO_POINTS = PointSet((), np.empty(0, np.int64), np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Pixels of points of a body in every frame of a take, and contacts.

    Parameters
    ----------
    rig : Rig
    points : PointSet of K entries, one for each measurement; camera : (K,) int, number of its camera in the rig
    uv : (T, K, 2) [px], ignored where weight is 0
    weight : (T, K) [1/px²], 0 where undetected
    loss : Loss of a pixel, in standard deviations
    anchored : PointSet of P points with contacts
    anchors, anchor_weight : (T, P, 3) [m] places of the contacts, and (T, P) [1/m²], 0 without contact
    member, shared : (K,) int, group of points of one segment with a common shift, -1 for none; and (G,) [px²] variance
        of each group's shift, independent in every frame
    """

    rig: Rig
    points: PointSet
    camera: NDArray
    uv: NDArray
    weight: NDArray
    loss: Loss = SQUARED
    anchored: PointSet = field(default_factory=lambda: NO_POINTS)
    anchors: NDArray | None = None
    anchor_weight: NDArray | None = None
    member: NDArray | None = None
    shared: NDArray | None = None

    def equations(self, body: Body) -> MakeEquations:
        """Equations for `trajectory.smoothing.smooth`."""
        tree = body.tree
        T, n = len(self.uv), tree.n_dofs
        uv, weight = np.ascontiguousarray(np.nan_to_num(self.uv)), np.ascontiguousarray(self.weight)
        anchors = np.zeros((T, len(self.anchored), 3)) if self.anchors is None else self.anchors
        anchor_weight = np.zeros(anchors.shape[:2]) if self.anchor_weight is None else self.anchor_weight
        member = np.full(len(self.points), -1) if self.member is None else self.member
        shared = np.zeros(0) if self.shared is None else self.shared
        rest, anchor_rest = body.points_rest(self.points), body.points_rest(self.anchored)

        def make(roots: NDArray, angles: NDArray) -> Equations:
            C, g, cost = np.zeros((T, *tree.chain.shape)), np.empty((T, n)), np.empty(T)
            _kernels_smoothing.pixel_equations(
                roots, angles, self.points.segments, rest, self.rig.packed, self.camera, uv, weight,
                self.anchored.segments, anchor_rest, anchors, anchor_weight, member, shared, self.loss.kind,
                self.loss.scale, tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, tree.chain,
                tree.depth, C, g, cost,
            )  # fmt: skip
            return C, g, cost

        return make

    def variance(self, body: Body, roots: NDArray, angles: NDArray, covariance: NDArray) -> NDArray:
        """(T, K, 2) [px²] variances of projections along u and v, from covariances (T, n, n); NaN if invisible."""
        tree, out = body.tree, np.empty(self.uv.shape)
        _kernels_smoothing.pixel_variance(
            roots, angles, self.points.segments, body.points_rest(self.points), self.rig.packed, self.camera,
            covariance, tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, tree.dof_parent,
            tree.last_dof, out,
        )  # fmt: skip
        return out
