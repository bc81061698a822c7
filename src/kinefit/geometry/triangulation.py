"""Triangulate points from their pixels in several cameras, by least squares on pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry._kernels_triangulation import triangulate_points
from kinefit.geometry.camera import Camera, Rig


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
