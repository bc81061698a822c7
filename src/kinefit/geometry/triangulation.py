"""Triangulation: pixels of one point in several cameras -> the point, by least squares on pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.errors import ObservationError
from kinefit.geometry._kernels_triangulation import triangulate_points
from kinefit.geometry.camera import Rig


def triangulate(rig: Rig, points_px: ArrayLike, weights: ArrayLike | None = None) -> NDArray:
    """Points of least weighted squared pixel error, using every camera that saw them.

    Parameters
    ----------
    points_px : (N, C, 2) [px]
        In the image frame of each camera's calibration; NaN where unseen.
    weights : (N, C), optional
        Non-negative, multiplying the squared error; 0 where unseen.

    Returns
    -------
    x_world : (N, 3) [m]
        NaN where fewer than two cameras saw the point or their rays are parallel.
    """
    return _run(rig, points_px, weights, np.inf)[0]


def triangulate_robust(
    rig: Rig, points_px: ArrayLike, weights: ArrayLike | None = None, *, max_residual_px: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Points that the largest weight of cameras agrees on.

    All cameras if they agree; else the pair of cameras whose point most others support, and all that agree with it.

    Parameters
    ----------
    points_px, weights : as in `triangulate`
    max_residual_px : float [px]
        Largest pixel error of a camera that agrees.

    Returns
    -------
    x_world : (N, 3) [m]
        NaN where no two cameras agree.
    inliers : (N, C) bool
        Cameras that agree.
    residual_px : (N, C) [px]
        Pixel error in every camera that saw the point; infinite where the point is behind it, NaN where unseen.
    """
    if not max_residual_px > 0:
        raise ObservationError(f"largest pixel error {max_residual_px}", remedy="Give a positive number of pixels.")
    return _run(rig, points_px, weights, float(max_residual_px))


def _run(rig: Rig, points_px: ArrayLike, weights: ArrayLike | None, limit: float) -> tuple[NDArray, NDArray, NDArray]:
    points = np.array(shaped(points_px, ("points", len(rig), 2), "points"))
    seen = np.isfinite(points).all(-1)
    weight = np.ones(seen.shape) if weights is None else np.array(weights, dtype=float, order="C")
    if weight.shape != seen.shape or np.any(weight[seen] < 0) or not np.isfinite(weight[seen]).all():
        raise ObservationError(
            f"weights have shape {weight.shape} or a negative or missing value",
            remedy=f"Give {seen.shape}, finite and not negative.",
        )
    weight = np.where(seen, weight, 0.0)
    x_world = np.empty((len(points), 3))
    inliers, residual = np.empty(seen.shape, dtype=bool), np.empty(seen.shape)
    triangulate_points(rig.packed, points, weight, limit, x_world, inliers, residual)
    return x_world, inliers, residual
