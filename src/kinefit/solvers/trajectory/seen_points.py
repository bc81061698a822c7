"""Pixels of a whole take, and points of the body that rest, as normal equations of all its frames."""

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
    """Pixels of points of a body in every frame of a take.

    Parameters
    ----------
    rig : Rig
    points : PointSet of K entries, one for each measurement; camera : (K,) int, which of the rig sees it.
    uv : (T, K, 2) [px], anything where unseen.
    weight : (T, K) [1/px²], 0 where unseen.
    loss : Loss of a pixel, in standard deviations.
    anchored : PointSet of P points that rest now and then.
    anchors, anchor_weight : (T, P, 3) [m] where, and (T, P) [1/m²], 0 where they do not.
    member, shared : (K,) int, which group of points of one segment is shifted together, -1 for none; and (G,) [px²] the
        variance of each group's shift, new in every frame.
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
        """What `smooth` asks for."""
        tree = body.tree
        T, n = len(self.uv), tree.n_dofs
        uv, weight = np.ascontiguousarray(np.nan_to_num(self.uv)), np.ascontiguousarray(self.weight)
        anchors = np.zeros((T, len(self.anchored), 3)) if self.anchors is None else self.anchors
        held = np.zeros(anchors.shape[:2]) if self.anchor_weight is None else self.anchor_weight
        member = np.full(len(self.points), -1) if self.member is None else self.member
        shared = np.zeros(0) if self.shared is None else self.shared
        rest, anchor_rest = body.points_rest(self.points), body.points_rest(self.anchored)

        def make(roots: NDArray, angles: NDArray) -> Equations:
            C, g, cost = np.zeros((T, *tree.chain.shape)), np.empty((T, n)), np.empty(T)
            _kernels_smoothing.pixel_equations(
                roots, angles, self.points.segments, rest, self.rig.packed, self.camera, uv, weight,
                self.anchored.segments, anchor_rest, anchors, held, member, shared, self.loss.kind, self.loss.scale,
                tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, tree.chain, tree.depth, C, g, cost,
            )  # fmt: skip
            return C, g, cost

        return make

    def variance(self, body: Body, roots: NDArray, angles: NDArray, covariance: NDArray) -> NDArray:
        """(T, K, 2) [px²] along u and v, of where the points are seen, from covariances (T, n, n); NaN: not seen."""
        tree, out = body.tree, np.empty(self.uv.shape)
        _kernels_smoothing.pixel_variance(
            roots, angles, self.points.segments, body.points_rest(self.points), self.rig.packed, self.camera,
            covariance, tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, tree.dof_parent,
            tree.last_dof, out,
        )  # fmt: skip
        return out
