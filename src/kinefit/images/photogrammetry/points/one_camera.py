"""Place the image points of a single camera in space: on the plane z = 0, or on a body whose motion is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces.places import nearest
from kinefit.geometry.camera import Camera
from kinefit.images.photogrammetry.intersection import Intersections

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
