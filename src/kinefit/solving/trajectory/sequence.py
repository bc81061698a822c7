"""Fit whole sequences fast: markers and tangent planes, frame after frame, in one compiled call."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.errors import ObservationError
from kinefit.geometry.losses import SQUARED, Loss
from kinefit.solving.equations import lock
from kinefit.solving.least_squares import bounds_of
from kinefit.solving.trajectory._kernels_smoothing import fit_sequence as _fit_sequence

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
