"""Point to surface: a measured point should lie on the body, anywhere or on one segment (P2 2.3; P4, eq. 15).

Surface points with a fixed correspondence: rows that are valid at any state near that of the match.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.metaballs import LEVEL
from kinefit.bodies.surfaces.places import nearest_lines
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.solving.correspondences import _kernels, targets
from kinefit.solving.rows import Rows


def surface_rows(
    body: Body,
    state: BodyState,
    x_world: ArrayLike,
    *,
    max_distance: float = 0.1,
    sigma: ArrayLike = 0.01,
    segment: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    exact: bool = False,
    frames: NDArray | None = None,
) -> Rows:
    """One row for each point x: the surface's nearest point p = x − d n should lie d further along its normal n.

    This is point-to-plane along the model's normal: sliding of the nearest point on the surface has no cost.

    Parameters
    ----------
    x_world : (N, 3) [m]
        Measured points; NaN for none. The rows' `group` is the index of the point.
    max_distance : float [m], largest distance of a point with a row.
    sigma : scalar or (N,) [m]
    segment : (N,) int, or one for all, optional
        Segment of each point if known, -1 for any.
    viewpoint : (3,) [m], optional
        Position of the sensor: points whose nearest surface faces away from it make no row.
    exact : bool
        See `nearest`.
    frames : (S, 12), optional, for a body whose joints move with its angles.

    Raises
    ------
    ObservationError
        As `nearest`; a viewpoint that is no point.
    """
    x = shaped(x_world, ("N", 3), "points on surfaces")
    present = np.isfinite(x).all(axis=1)
    weight = targets.weights(sigma, present, "points on surfaces")
    eye, min_facing = np.zeros(3), -np.inf
    if viewpoint is not None:
        eye, min_facing = shaped(viewpoint, (3,), "a viewpoint", finite=True), 0.0
    frames = targets.of_segments(body, state, frames)
    lines = targets.lines(x)
    distance, normal, owner = nearest_lines(body, frames, lines, max_distance, segment, exact=exact)
    data, owners, group = _kernels.buffers(len(x))
    count = _kernels.surface_rows(lines, distance, normal, owner, weight, eye, min_facing, data, owners, group)
    return Rows(np.ascontiguousarray(data[:, :count]), owners[:count], group[:count])


def field_rows(
    body: Body, state: BodyState, x_world: ArrayLike, segment: ArrayLike, *, sigma: ArrayLike = 1.0
) -> Rows:
    """One row for each point: the field F of its segment's metaballs should be 1/2, r = F − 1/2 (P4, eqs. 14 and 15).

    A segment that moves by δ along the gradient n = ∇F lowers F at the point by n·δ. So n is in [1/m], not a unit
    vector, and r has no unit. Derivatives are exact.

    Parameters
    ----------
    x_world : (N, 3) [m]
        Measured points; NaN for none. The rows' `group` is the index of the point.
    segment : (N,) int, or one for all
        Segment of each point; a point of a segment without metaballs, or of -1, makes no row.
    sigma : scalar or (N,), no unit
        Standard deviation of F at each point.

    Raises
    ------
    ObservationError
        Points or standard deviations of the wrong shape.
    """
    x, present = targets.array(x_world, 3, len(np.asarray(x_world)), "points in fields")
    weight, owner = targets.weights(sigma, present, "points in fields"), np.broadcast_to(segment, len(x))
    frames, slope, residual = targets.of_segments(body, state), np.zeros(x.shape), np.full(len(x), np.nan)
    for limb in body.surfaces:
        if isinstance(limb, Metaballs):
            f, own = frames[limb.segment], present & (owner == limb.segment)
            R = f[:9].reshape(3, 3)
            d = limb.derivatives((x[own] - f[9:]) @ R - body.tree.rest[limb.segment])
            slope[own], residual[own] = d.by_point @ R.T, d.value - LEVEL
    used = np.flatnonzero(np.isfinite(residual))
    return Rows.of(owner[used], x[used], slope[used], residual[used], weight[used], used)


def anchored_rows(
    frames: NDArray,
    segment: NDArray,
    points: NDArray,
    normals: NDArray,
    x_world: NDArray,
    *,
    weight: ArrayLike = 1e4,
    at_surface: bool = True,
) -> Rows:
    """One row for each surface point x: r = n·(q − x) to a measured point q, along the normal n, which rotates with x.

    Parameters
    ----------
    frames : (S, 12) of the segments: `body.tree.forward(state.T_world_root, state.angles)[0]`, or of joints that move.
    segment : (N,) int
    points, normals : (N, 3) [m] of the surface, in the root frame at rest; see `SurfaceAnchors`.
    x_world : (N, 3) [m] measured.
    weight : scalar or (N,) [1/m²]
    at_surface : bool
        Whether a row's point is q's projection on the tangent plane, as in `surface_rows`, or q itself, as in
        `depth_image_rows`. The derivative is the same.

    Raises
    ------
    ObservationError
        Arrays of other sizes.
    """
    count = len(segment)
    x, measured = _checked(points, count), _checked(x_world, count)
    w = np.ascontiguousarray(np.broadcast_to(np.asarray(weight, float), count))
    data = np.empty((8, count))
    _kernels.anchored_rows(frames, segment, x, _checked(normals, count), measured, w, at_surface, data)
    return Rows(data, segment, np.arange(count))


def anchored(rows: Rows, x_world: NDArray, frames: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Measured points (N, 3) [m] of N rows, and their surface points and normals (N, 3) in the root frame at rest.

    Parameters
    ----------
    rows : from `surface_rows`, of measured points x_world (M, 3) [m].
    frames : (S, 12) of the state of the match.
    """
    x, rest, normal = np.empty((3, len(rows), 3))
    _kernels.anchors(rows.data, rows.segment, rows.group, frames, _checked(x_world, len(x_world)), x, rest, normal)
    return x, rest, normal


def target_rows(
    frames: NDArray,
    segment: NDArray,
    points: NDArray,
    camera: Camera,
    target: NDArray,
    *,
    slack: float = 0.0,
    sigma: float = 2.0,
) -> Rows:
    """One row for each point of the body: its pixel should lie within `slack` of a target.

    With the distance d and g = −∂d/∂x: n = g/|g|, r = (d − slack)/|g|, w = |g|²/σ², the exact linearisation. A point
    within `slack`, or outside of the camera's view, gets weight 0.

    Parameters
    ----------
    frames : (S, 12) of the segments: `body.tree.forward(state.T_world_root, state.angles)[0]`, or of joints that move.
    segment : (N,) int; points : (N, 3) [m] in the root frame at rest.
    target : (N, 2) [px]
    slack, sigma : float [px]

    Raises
    ------
    ObservationError
        Arrays of other sizes, a standard deviation that is not positive.
    """
    if not sigma > 0:
        raise ObservationError(f"a standard deviation of {sigma} px", remedy="Give a positive number of pixels.")
    count = len(segment)
    data, x, pixel = np.empty((8, count)), _checked(points, count), _checked(target, count, 2)
    _kernels.target_rows(frames, segment, x, camera.packed, pixel, slack, 1.0 / sigma**2, data)
    return Rows(data, segment, np.arange(count))


def _checked(array: NDArray, count: int, columns: int = 3) -> NDArray:
    return shaped(array, (count, columns), f"{count} points of a surface with an array")
