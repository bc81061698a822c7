"""Place the image points of a single camera in space: on the plane z = 0, or on a body whose motion is known."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body_surfaces import body_mesh
from kinefit.geometry.camera import Camera
from kinefit.motion import Motion
from kinefit.photogrammetry.intersection import Intersections
from kinefit.rendering import render_body

_FLAT_DISTANCE = 1000.0  # [m] of a camera that faces a plane: its rays are parallel to 2 mrad over 2 m
BODY_SIGMA = 0.02  # [m] of the body's surface along a ray
_CONTOUR_PX = 10  # beyond the body's contour in which a point still belongs to it

Depth = Callable[[int, NDArray], NDArray]
"""Depths (N,) [m] along the optical axis of image points (N, 2) [px] in a frame; NaN or inf where there is none."""


def flat_camera(size: tuple[int, int], pixel: float) -> Camera:
    """Camera that faces the plane z = 0: a pixel shows `pixel` [m], x to the right, y up, origin at the first pixel."""
    T_camera_world = np.diag([1.0, -1.0, -1.0, 1.0])
    T_camera_world[2, 3] = _FLAT_DISTANCE
    focal = _FLAT_DISTANCE / pixel
    return Camera("image", size, np.diag([focal, focal, 1.0]), T_camera_world=T_camera_world)


def plane_depth(camera: Camera) -> Depth:
    """Depth of the world's plane z = 0 in a camera."""

    def depth(frame: int, uv: NDArray) -> NDArray:
        ray = camera.ray(uv)
        return np.asarray(-camera.centre_world[2] / ray[:, 2] * (ray @ camera.T_camera_world[2, :3]))

    return depth


def body_depth(motion: Motion, camera: Camera) -> Depth:
    """Depth of a moving body's surface in a camera; none in frames that the motion lacks."""
    mesh = body_mesh(motion.body)

    def depth(frame: int, uv: NDArray) -> NDArray:
        if frame >= len(motion):
            return np.full(len(uv), np.nan)
        image = render_body(motion.body, motion.state(frame), camera, mesh=mesh).depth
        around = cv2.erode(image, np.ones((2 * _CONTOUR_PX + 1,) * 2, np.uint8))
        u, v = np.clip(np.rint(uv).astype(int), 0, np.array(camera.size) - 1).T
        return np.where(np.isfinite(image[v, u]), image[v, u], around[v, u]).astype(float)

    return depth


def at_depth(camera: Camera, uv: NDArray, covariance: NDArray, depth: NDArray, sigma: float = 0.0) -> Intersections:
    """Points of one camera's image at known depths; their parallax is 0, or NaN without a depth.

    Parameters
    ----------
    uv : (N, 2) [px]
    covariance : (N, 2, 2) [px²]
    depth : (N,) [m] along the optical axis
    sigma : [m] along the ray
    """
    ray = camera.ray(uv)
    known = np.isfinite(depth)
    x = camera.centre_world + ray * (np.where(known, depth, np.nan) / (ray @ camera.T_camera_world[2, :3]))[:, None]
    inverse = np.full((len(uv), 3, 2), np.nan)
    inverse[known] = np.linalg.pinv(camera.project_with_jacobian(x[known])[1])
    spread = inverse @ covariance @ inverse.swapaxes(1, 2) + sigma**2 * ray[:, :, None] * ray[:, None]
    return Intersections(x, spread, np.where(known, 0.0, np.nan))
