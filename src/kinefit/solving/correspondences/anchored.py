"""Surface points with a fixed correspondence: rows that are valid at any state near that of the match."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.solving.correspondences import _kernels_surface as kernels
from kinefit.solving.rows import Rows


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
    kernels.anchored_rows(frames, segment, x, _checked(normals, count), measured, w, at_surface, data)
    return Rows(data, segment, np.arange(count))


def anchored(rows: Rows, x_world: NDArray, frames: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Measured points (N, 3) [m] of N rows, and their surface points and normals (N, 3) in the root frame at rest.

    Parameters
    ----------
    rows : from `surface_rows`, of measured points x_world (M, 3) [m].
    frames : (S, 12) of the state of the match.
    """
    x, rest, normal = np.empty((3, len(rows), 3))
    kernels.anchors(rows.data, rows.segment, rows.group, frames, _checked(x_world, len(x_world)), x, rest, normal)
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
    kernels.target_rows(frames, segment, x, camera.packed, pixel, slack, 1.0 / sigma**2, data)
    return Rows(data, segment, np.arange(count))


def _checked(array: NDArray, count: int, columns: int = 3) -> NDArray:
    return shaped(array, (count, columns), f"{count} points of a surface with an array")
