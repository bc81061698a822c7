"""Fit whole sequences fast: markers and tangent planes, frame after frame, in one compiled call.

Normal equations of all frames of a take from points in pixels and points in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving.equations import lock
from kinefit.solving.least_squares import bounds_of
from kinefit.solving.trajectory import _kernels_smoothing
from kinefit.solving.trajectory._kernels_smoothing import fit_sequence as _fit_sequence
from kinefit.solving.trajectory.smoothing import Equations, MakeEquations

_NO_POINTS = PointSet((), np.empty(0, np.int64), np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class Planes:
    """Tangent planes for points of a body: P points over F frames.

    Parameters
    ----------
    points : PointSet of P points
    x_world : (F, P, 3) [m] a point of each plane; NaN for none
    normal : (F, P, 3) unit normals
    sigma : float [m]
    """

    points: PointSet
    x_world: NDArray
    normal: NDArray
    sigma: float = 0.01


@dataclass(frozen=True, eq=False)
class SequenceFit:
    """Fitted frames: roots (F, 4, 4), angles (F, D), cost Σ ρ (F,) and iterations (F,)."""

    Ts_world_root: NDArray
    angles: NDArray
    costs: NDArray
    iterations: NDArray

    @property
    def last(self) -> BodyState:
        """The state of the last frame."""
        return BodyState(self.Ts_world_root[-1], self.angles[-1])


def fit_sequence(
    body: Body,
    start: BodyState,
    points: PointSet = _NO_POINTS,
    x_world: ArrayLike | None = None,
    *,
    sigma: ArrayLike = 0.005,
    planes: Planes | None = None,
    loss: Loss = SQUARED,
    limits: bool = True,
    locked: NDArray | None = None,
    posture: float = 0.0,
    damping: float = 1e-3,
    max_iterations: int = 200,
    tolerance: float = 1e-6,
) -> SequenceFit:
    """Minimise Σ ρ(w r²) in every frame, each from the solution of the frame before.

    It finds the minimum of `levenberg_marquardt` with `point_rows` and `plane_rows`, without calls from Python.

    Parameters
    ----------
    start : BodyState of the first frame
    points : PointSet of K points on the body
    x_world : (F, K, 3) [m]
        Measured points; NaN for missing ones.
    sigma : scalar or (K,) [m]
    planes : Planes
        Tangent planes for other points, in addition or instead.
    limits : bool
        Whether coordinates stay within their limits.
    locked : (n,) bool
        Degrees of freedom that do not move.
    posture : float
        Share of the body's posture prior, couplings included. It determines what the measurements do not.
    damping : float
        First λ as a share of H's mean diagonal.
    tolerance : float
        A frame ends when its next step is predicted to lower the cost by less than this share.

    Raises
    ------
    ObservationError
        Arrays of other shapes; a standard deviation that is not above 0.
    """
    tree = body.tree
    count = len(planes.x_world) if x_world is None and planes is not None else len(np.asarray(x_world))
    x = np.zeros((count, 0, 3)) if x_world is None else np.array(x_world, float, order="C")
    check_shape(x, (count, len(points), 3), "measured points")
    measured = np.isfinite(x).all(axis=2)
    if not np.all(np.asarray(sigma, float) > 0) or (planes is not None and not planes.sigma > 0):
        raise ObservationError("the standard deviation of points and planes must be positive")
    weight = np.where(measured, 1.0 / np.square(np.broadcast_to(np.asarray(sigma, float), measured.shape[1:])), 0.0)
    order = np.argsort(points.segments, kind="stable")  # rows of one segment in one run
    p = planes or Planes(_NO_POINTS, np.zeros((count, 0, 3)), np.zeros((count, 0, 3)))
    for name, array in (("points", p.x_world), ("normals", p.normal)):
        check_shape(array, (count, len(p.points), 3), f"{name} of planes")
    p_order = np.argsort(p.points.segments, kind="stable")
    lower, upper = bounds_of(body, limits)
    roots, angles = np.empty((count, 4, 4)), np.empty((count, len(tree.coordinates)))
    if count:
        roots[0], angles[0] = start.T_world_root, start.angles
    costs, iterations = np.empty(count), np.empty(count, np.int64)
    _fit_sequence(
        tree.parents, tree.dof_start, tree.chain, tree.depth, tree.prismatic, tree.axes, tree.rest, lower, upper,
        lock(body, locked), points.segments[order], body.points_rest(points)[order],
        np.ascontiguousarray(np.nan_to_num(x[:, order])), np.ascontiguousarray(weight[:, order]),
        p.points.segments[p_order],
        np.ascontiguousarray(body.points_rest(p.points)[p_order].T),
        p_order, np.ascontiguousarray(p.x_world), np.ascontiguousarray(p.normal), 1.0 / p.sigma**2,
        tree.usual, posture, *tree.posture_entries, *tree.coupled_pattern, loss.kind, loss.scale, max_iterations,
        tolerance, damping, roots, angles, costs, iterations,
    )  # fmt: skip
    return SequenceFit(roots, angles, costs, iterations)


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
