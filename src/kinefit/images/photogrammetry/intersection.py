"""Points in space from their images: where the rays of cameras intersect; of one camera, where its ray meets a surface.

The surface is the plane z = 0, or a body whose motion is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape
from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces.places import nearest
from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate

_MAX_ITERATIONS = 5  # of Gauss-Newton, from the close solution with equal weights
_TOLERANCE = 1e-9  # [m] step at which the iteration ends
_MIN_DETERMINANT = 1e-15  # of the normal matrix, relative to the cube of its trace: parallel rays
_MIN_RAY_ANGLE = np.deg2rad(0.5)  # [rad] at which the sigma of distance is 100 times that across
_MIN_PIXEL_SIGMA = 1e-6  # [px] added to each match: identical images have no residuals


@dataclass(frozen=True, eq=False)
class Intersections:
    """Intersections of rays.

    Parameters
    ----------
    x_world : (N, 3) [m]; NaN with fewer than two cameras
    covariance : (N, 3, 3) [m²] due to the image points, without errors of the calibration
    parallax : (N,) [px] RMS reprojection error
    """

    x_world: NDArray
    covariance: NDArray
    parallax: NDArray

    @property
    def std(self) -> NDArray:
        """(N, 3) [m] standard deviations along the world's axes."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def intersect(rig: Rig, uv: NDArray, covariance: NDArray) -> Intersections:
    """Triangulate points by least squares, weighted by the covariance of each image point.

    Parameters
    ----------
    rig : C cameras
    uv : (N, C, 2) [px] image points; NaN where not visible
    covariance : (N, C, 2, 2) [px²]

    Raises
    ------
    ObservationError
        Shapes disagree.
    CalibrationError
        The cameras' rays are nearly parallel, so that distances are undetermined.
    """
    check_shape(uv, ("N", len(rig), 2), "places")
    check_shape(covariance, (*uv.shape, 2), "covariances of places")
    visible = np.isfinite(uv).all(axis=2) & np.isfinite(covariance).all(axis=(2, 3))
    points = triangulate(rig, np.where(visible[..., None], uv, np.nan))
    valid = np.isfinite(points).all(axis=1) & (visible.sum(axis=1) >= 2)
    x = np.where(valid[:, None], points, np.nan)
    _check_angles(rig, x)
    weight = np.zeros_like(covariance)
    weight[visible] = np.linalg.inv(covariance[visible] + _MIN_PIXEL_SIGMA**2 * np.eye(2))
    normal = np.full((len(x), 3, 3), np.nan)
    for _ in range(_MAX_ITERATIONS):
        normal, right = np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
        for c, camera in enumerate(rig):
            projected, J = camera.project_with_jacobian(x)
            use = visible[:, c] & np.isfinite(projected).all(axis=1)
            JW = np.einsum("nij,nik->njk", J[use], weight[use, c])
            normal[use] += JW @ J[use]
            right[use] += np.einsum("njk,nk->nj", JW, uv[use, c] - projected[use])
        valid &= np.linalg.det(normal) > _MIN_DETERMINANT * np.trace(normal, axis1=1, axis2=2) ** 3
        step = np.linalg.solve(normal[valid], right[valid][..., None])[..., 0]
        x[valid] += step
        if not len(step) or np.abs(step).max() < _TOLERANCE:
            break
    out = np.full((len(x), 3, 3), np.nan)
    out[valid] = np.linalg.inv(normal[valid])
    x[~valid] = np.nan
    errors = np.stack([((camera.project(x) - uv[:, c]) ** 2).sum(axis=1) for c, camera in enumerate(rig)], axis=1)
    square = np.where(visible, errors, 0.0).sum(axis=1) / np.maximum(visible.sum(axis=1), 1)
    return Intersections(x, out, np.where(valid, np.sqrt(square), np.nan))


def _check_angles(rig: Rig, x: NDArray) -> None:
    """Raise CalibrationError if the cameras stand in one place as seen from the points (N, 3) [m]."""
    middle = x[np.isfinite(x).all(axis=1)]
    if not len(middle):
        return
    rays = np.array([camera.centre_world - np.median(middle, axis=0) for camera in rig])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    widest = np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))
    if widest < _MIN_RAY_ANGLE:
        problem = f"the rays of cameras {', '.join(rig.names)} meet at {np.rad2deg(widest):.2f} degrees at most"
        raise CalibrationError(problem, remedy="Put the cameras further apart, or check the calibration.")


_FLAT_DISTANCE = 1000.0  # [m] of a camera that faces a plane: its rays are parallel to 2 mrad over 2 m
BODY_SIGMA = 0.02  # [m] of the body's surface along a ray
_MAX_MISS = 0.02  # [m] by which a ray may pass the body
_MAX_DISTANCE = 30.0  # [m] of a body from the camera
_MAX_STEPS = 40  # along a ray, each as long as the distance from the body

Ranges = Callable[[int, NDArray], NDArray]
"""Distances (N,) [m] along the rays of image points (N, 2) [px] in a frame; NaN where there is none."""


def flat_camera(size: tuple[int, int], pixel: float) -> Camera:
    """Camera that faces the plane z = 0: a pixel shows `pixel` [m], x to the right, y up, origin at the first pixel."""
    T_camera_world = np.diag([1.0, -1.0, -1.0, 1.0])
    T_camera_world[2, 3] = _FLAT_DISTANCE
    focal = _FLAT_DISTANCE / pixel
    return Camera("image", size, np.diag([focal, focal, 1.0]), T_camera_world=T_camera_world)


def plane_ranges(camera: Camera) -> Ranges:
    """Distances of the world's plane z = 0 from a camera."""
    return lambda frame, uv: -camera.centre_world[2] / camera.ray(uv)[:, 2]


def body_ranges(motion: Motion, camera: Camera) -> Ranges:
    """Distances of a moving body's surface from a camera; none in frames that the motion lacks."""

    def ranges(frame: int, uv: NDArray) -> NDArray:
        best, least = np.full(len(uv), np.nan), np.full(len(uv), _MAX_MISS)
        if frame >= len(motion):
            return best
        ray, along, state = camera.ray(uv), np.zeros(len(uv)), motion.state(frame)
        for _ in range(_MAX_STEPS):
            x = camera.centre_world + along[:, None] * ray
            gap = nearest(motion.body, state, x, max_distance=_MAX_DISTANCE).distance
            best, least = np.where(gap < least, along, best), np.minimum(gap, least)
            along = along + np.maximum(gap, 0.0)
        return best

    return ranges


def at_range(camera: Camera, uv: NDArray, covariance: NDArray, ranges: NDArray, sigma: float = 0.0) -> Intersections:
    """Points of one camera's image at known distances; their parallax is 0, or NaN without a distance.

    Parameters
    ----------
    uv : (N, 2) [px]
    covariance : (N, 2, 2) [px²]
    ranges : (N,) [m] along the rays
    sigma : [m] of the ranges
    """
    ray, known = camera.ray(uv), np.isfinite(ranges)
    x = camera.centre_world + ray * ranges[:, None]
    inverse = np.full((len(uv), 3, 2), np.nan)
    inverse[known] = np.linalg.pinv(camera.project_with_jacobian(x[known])[1])
    spread = inverse @ covariance @ inverse.swapaxes(1, 2) + sigma**2 * ray[:, :, None] * ray[:, None]
    return Intersections(x, spread, np.where(known, 0.0, np.nan))
