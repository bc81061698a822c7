"""Normal equations of all frames of a take from points in pixels and points in metres."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving.trajectory import _kernels_smoothing
from kinefit.solving.trajectory.smoothing import Equations, MakeEquations

NO_POINTS = PointSet((), np.empty(0, np.int64), np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of a body in every frame of a take: in pixels (keypoints) and in metres (markers, foot contacts).

    Parameters
    ----------
    rig : Rig
    points : PointSet of K entries, one for each measurement; camera : (K,) int, number of its camera in the rig
    uv : (T, K, 2) [px], ignored where weight is 0
    weight : (T, K) [1/px²], 0 where undetected
    loss : Loss of a pixel, in standard deviations
    placed : PointSet of P points in metres
    places, place_weight : (T, P, 3) [m], ignored where the weight (T, P) [1/m²] is 0; None for no points
    place_loss, robust : Loss of the first `robust` points in metres; the others are never outliers
    member, shared : (K,) int, group of points of one segment with a common shift, -1 for none; and (G,) [px²] variance
        of each group's shift, independent in every frame
    """

    rig: Rig
    points: PointSet
    camera: NDArray
    uv: NDArray
    weight: NDArray
    loss: Loss = SQUARED
    placed: PointSet = field(default_factory=lambda: NO_POINTS)
    places: NDArray | None = None
    place_weight: NDArray | None = None
    place_loss: Loss = SQUARED
    robust: int = 0
    member: NDArray | None = None
    shared: NDArray | None = None

    @classmethod
    def in_metres(cls, points: PointSet, places: NDArray, weight: NDArray, loss: Loss = SQUARED) -> SeenPoints:
        """Points in metres alone, all with one loss: places (T, K, 3) [m], weight (T, K) [1/m²]."""
        none = np.zeros(0, np.int64), np.zeros((len(places), 0, 2)), np.zeros((len(places), 0))
        return cls(
            Rig(()), NO_POINTS, *none, placed=points, places=places, place_weight=weight, place_loss=loss,
            robust=len(points),
        )  # fmt: skip

    def equations(self, body: Body) -> MakeEquations:
        """Equations for `trajectory.smoothing.smooth`."""
        tree = body.tree
        T, n = len(self.uv), tree.n_dofs
        uv, weight = np.ascontiguousarray(np.nan_to_num(self.uv)), np.ascontiguousarray(self.weight)
        places = np.zeros((T, len(self.placed), 3)) if self.places is None else np.ascontiguousarray(self.places)
        place_weight = np.zeros(places.shape[:2]) if self.place_weight is None else self.place_weight
        member = np.full(len(self.points), -1) if self.member is None else self.member
        shared = np.zeros(0) if self.shared is None else self.shared
        rest, placed_rest = body.points_rest(self.points), body.points_rest(self.placed)

        def make(roots: NDArray, angles: NDArray) -> Equations:
            C, g, cost = np.zeros((T, *tree.chain.shape)), np.empty((T, n)), np.empty(T)
            _kernels_smoothing.pixel_equations(
                roots, angles, self.points.segments, rest, self.rig.packed, self.camera, uv, weight,
                self.placed.segments, placed_rest, places, np.ascontiguousarray(place_weight), self.robust,
                self.place_loss.kind, float(self.place_loss.scale), member, shared, self.loss.kind,
                float(self.loss.scale), tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, tree.chain,
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
