"""Plücker lines and planes: distances of points and lines to them, and their derivatives (P1 2.3, P3 eqs. 4-5).

A line is (n, m): unit direction n and moment m = x × n of any of its points x [m]. A plane is (n, d): unit normal and
n·x = d [m]. Shapes are given for one leading axis (N,); all functions take any leading axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry._kernels_triangulation import triangulate_points
from kinefit.geometry.camera import Camera, Rig


def _unit(v: NDArray, what: str) -> NDArray:
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm)) or np.any(norm < 1e-12):
        raise ObservationError(f"{what} of length zero or not finite", remedy="Give two different points.")
    return v / norm


def perpendiculars(directions: NDArray) -> tuple[NDArray, NDArray]:
    """Two unit directions (N, 3) each, orthogonal to unit directions (N, 3) and to each other."""
    first = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=-1)])
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, np.cross(directions, first)


def line_through(a: NDArray, b: NDArray) -> NDArray:
    """Plücker lines (N, 6) from points a to points b, both (N, 3) [m]."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return line_along(a, b - a)


def line_along(x: NDArray, direction: NDArray) -> NDArray:
    """Plücker lines (N, 6) through x (N, 3) [m] along directions (N, 3) of any length."""
    n = _unit(np.asarray(direction, float), "a line's direction")
    return np.concatenate([np.broadcast_to(n, np.broadcast_shapes(n.shape, np.shape(x))), np.cross(x, n)], -1)


def plane_through(line: NDArray, x: NDArray) -> NDArray:
    """Planes (N, 4) = (n, d) through Plücker lines (N, 6) and points (N, 3) [m] off them."""
    foot = np.cross(line[..., :3], line[..., 3:])
    n = _unit(np.cross(line[..., :3], np.asarray(x, float) - foot), "a plane's normal")
    return np.concatenate([n, np.sum(n * x, -1, keepdims=True)], -1)


def move_line(T: NDArray, line: NDArray) -> NDArray:
    """Lines (N, 6) moved by T (N, 4, 4)."""
    n = (T[..., :3, :3] @ line[..., :3, None])[..., 0]
    m = (T[..., :3, :3] @ line[..., 3:, None])[..., 0] + np.cross(T[..., :3, 3], n)
    return np.concatenate([n, m], -1)


def point_line(x: NDArray, line: NDArray) -> NDArray:
    """Residual vectors x × n − m (N, 3) [m] of points and lines; their norms are the distances (P3 eq. 4)."""
    return np.cross(x, line[..., :3]) - line[..., 3:]


def point_plane(x: NDArray, plane: NDArray) -> NDArray:
    """Signed distances n·x − d (N,) [m] of points to planes; the derivative by x is n."""
    return np.sum(plane[..., :3] * x, -1) - plane[..., 3]


def line_plane(line: NDArray, plane: NDArray) -> NDArray:
    """Residuals (N, 4) of lines that should lie in planes: tilt, and offset along the normal.

    The first entry is the sine of the angle between them [rad]; the other three are the vector [m] from the plane to
    the line's foot point along the plane's normal. All four vanish exactly when the line lies in the plane (P1 2.3).
    """
    n_line, n_plane = line[..., :3], plane[..., :3]
    foot = np.cross(n_line, line[..., 3:])
    tilt = np.sum(n_line * n_plane, -1, keepdims=True)
    return np.concatenate([tilt, point_plane(foot, plane)[..., None] * n_plane], -1)


def closest_points(line_a: NDArray, line_b: NDArray) -> tuple[NDArray, NDArray]:
    """Closest points (N, 3) [m] of two lines (N, 6) (of parallel ones: the feet from the origin)."""
    a, b = line_a[..., :3], line_b[..., :3]
    foot_a, foot_b = np.cross(a, line_a[..., 3:]), np.cross(b, line_b[..., 3:])
    gap, across = foot_b - foot_a, np.cross(a, b)
    sine2 = np.sum(across**2, -1)  # not 1 − cos², which loses all digits of small angles
    parallel = sine2 < 1e-24
    safe = np.where(parallel, 1.0, sine2)
    s = np.where(parallel, 0.0, np.sum(np.cross(gap, b) * across, -1) / safe)
    t = np.where(parallel, -np.sum(gap * b, -1), np.sum(np.cross(gap, a) * across, -1) / safe)
    return foot_a + s[..., None] * a, foot_b + t[..., None] * b


def triangulate(rig: Rig, points_px: ArrayLike, weights: ArrayLike | None = None) -> NDArray:
    """Triangulate points by least weighted squared pixel error, from all cameras.

    Parameters
    ----------
    rig : Rig of C cameras
    points_px : (N, C, 2) [px]
        In the image frame of each camera's calibration; NaN if not detected.
    weights : (N, C), optional
        Weights >= 0 of the squared errors; default 1.

    Returns
    -------
    x_world : (N, 3) [m]
        NaN if fewer than two cameras detected the point or their rays are parallel.

    Raises
    ------
    ObservationError
        Arrays of other shapes, or weights that are negative or not finite.
    """
    return _run(rig, points_px, weights, np.inf)[0]


def triangulate_robust(
    rig: Rig, points_px: ArrayLike, weights: ArrayLike | None = None, *, max_residual_px: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Triangulate points from the consensus of cameras with the largest total weight.

    Uses all cameras if they agree; else the pair of cameras whose point has most support, and all that agree with it.

    Parameters
    ----------
    rig, points_px, weights : as in `triangulate`
    max_residual_px : float [px]
        Largest reprojection error of an inlier.

    Returns
    -------
    x_world : (N, 3) [m]
        NaN where no two cameras agree.
    inliers : (N, C) bool
        Cameras that agree.
    residual_px : (N, C) [px]
        Reprojection error in every camera that detected the point; infinite behind the camera, NaN if not detected.

    Raises
    ------
    ObservationError
        As `triangulate`, or a limit that is not positive.
    """
    if not max_residual_px > 0:
        raise ObservationError(f"largest pixel error {max_residual_px}", remedy="Give a positive number of pixels.")
    return _run(rig, points_px, weights, float(max_residual_px))


def _run(rig: Rig, points_px: ArrayLike, weights: ArrayLike | None, limit: float) -> tuple[NDArray, NDArray, NDArray]:
    points = np.array(shaped(points_px, ("points", len(rig), 2), "points"))
    detected = np.isfinite(points).all(-1)
    weight = np.ones(detected.shape) if weights is None else np.array(weights, dtype=float, order="C")
    if weight.shape != detected.shape or np.any(weight[detected] < 0) or not np.isfinite(weight[detected]).all():
        raise ObservationError(
            f"weights have shape {weight.shape} or a negative or missing value",
            remedy=f"Give {detected.shape}, finite and not negative.",
        )
    weight = np.where(detected, weight, 0.0)
    x_world = np.empty((len(points), 3))
    inliers, residual = np.empty(detected.shape, dtype=bool), np.empty(detected.shape)
    triangulate_points(rig.packed, points, weight, limit, x_world, inliers, residual)
    return x_world, inliers, residual


def placed(camera: Camera, x: NDArray, uv: NDArray) -> NDArray:
    """Place a shape in the world by its pixels: points (N, K, 3) [m]; any leading axes.

    Finds the common shift of all points that minimises the sum of squared distances from their rays. NaN where fewer
    than two points are known.

    Parameters
    ----------
    camera : Camera
    x : (N, K, 3) [m] along the image's u and v and away from the camera, from any origin; NaN if unknown
    uv : (N, K, 2) [px] detections; NaN for none
    """
    rays = camera.ray(uv) @ camera.T_camera_world[:3, :3].T
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    known = np.isfinite(x).all(axis=-1) & np.isfinite(rays).all(axis=-1)
    across = np.where(known[..., None, None], across, 0.0)
    pulled = np.einsum("...kij,...kj->...i", across, np.where(known[..., None], x, 0.0))
    total = across.sum(axis=-3)
    enough = (known.sum(axis=-1) > 1) & (np.linalg.eigvalsh(total)[..., 0] > 1e-9)
    shift = -np.linalg.solve(np.where(enough[..., None, None], total, np.eye(3)), pulled[..., None])[..., 0]
    at = x + np.where(enough[..., None], shift, np.nan)[..., None, :]
    return se3.apply(np.linalg.inv(camera.T_camera_world), at)
