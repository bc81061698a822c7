"""Pose of a closed 3D contour from its contour in an image, as published by Rosenhahn and Klette (P1 2.2).

1. The contour is a Fourier series; its low-pass approximation comes first, then higher frequencies.
2. Each of its points is paired with the nearest point of the image's contour (ICP), which defines a projection ray or,
   with the contour's direction there, a plane (P1 2.1: 3D point to 2D line).
3. The twist of the pose solves the linear constraints of all pairs, and Rodrigues' formula converts it to a motion;
   this is iterated to convergence.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.surfaces.fourier import FourierCurve
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.geometry.lines import perpendiculars

__all__ = ["ContourFit", "pose_of_contour"]

_GOOD_DISTANCE_PX = 2.0  # mean distance of matching contours; Zhang's D
_CURVE_POINTS = 200
_MAX_CYCLES = 30  # of each approximation
_MIN_STEP = 1e-5  # [m, rad] at which the cycles of one approximation end

By = Literal["rays", "planes"]


class ContourFit(NamedTuple):
    """A pose: T_world_object (4, 4), root mean square distance of the contours [px], and the number of cycles."""

    T_world_object: NDArray
    error: float
    cycles: int


def pose_of_contour(
    curve: FourierCurve,
    T_world_object: ArrayLike,
    camera: Camera,
    contour: NDArray,
    *,
    orders: Sequence[int] = (2, 8),
    by: By = "planes",
    reach: float = 80.0,
) -> ContourFit:
    """Estimate the pose of a closed curve from its contour in one image.

    Parameters
    ----------
    curve : FourierCurve in the object's frame.
    T_world_object : (4, 4) initial pose.
    camera : Camera
    contour : (4, N) u, v [px] and the unit normal there, from `images.silhouette.outline`.
    orders : highest frequencies of the low-pass approximations that come first; then the whole curve.
    by : "rays", a point to the ray of its partner, or "planes", to the plane through the contour's tangent there, along
        which it may slide.
    reach : float [px], largest distance of a pair at first; later limits follow from the distances.

    Raises
    ------
    ObservationError
        An invalid contour, or one without a point near the curve.
    """
    target = np.asarray(contour, float)
    if target.ndim != 2 or len(target) != 4 or target.shape[1] < 6 or not np.isfinite(target).all():
        raise ObservationError(f"a contour of shape {target.shape}", remedy="Give (4, N): u, v and the normal there.")
    fixed = _lines(camera, target)
    T, done = np.array(T_world_object, float), 0
    levels = [*(order for order in orders if order < curve.order), curve.order]
    for order in levels:
        points, bound = curve.low_pass(order).samples(_CURVE_POINTS), reach
        for _ in range(_MAX_CYCLES):
            x = se3.apply(T, points)
            near, distance = _nearest(camera.project(x), target[:2])
            pairs = distance < _max_pair_distance(distance, bound)
            if pairs.sum() < 6:
                raise ObservationError("no contour is near the curve", remedy="Start nearer to it, or widen the reach.")
            delta = _twist(x[pairs], camera.centre_world, *(part[near[pairs]] for part in fixed), by=by)
            T, done = se3.exp(delta) @ T, done + 1
            if np.linalg.norm(delta) < _MIN_STEP:
                break
    _, distance = _nearest(camera.project(se3.apply(T, curve.samples(_CURVE_POINTS))), target[:2])
    return ContourFit(T, float(np.sqrt(np.mean(distance**2))), done)


def _lines(camera: Camera, contour: NDArray) -> tuple[NDArray, NDArray]:
    """Rays (N, 3) of the contour's points, and normals (N, 3) of the planes through its tangents, in the world."""
    (u, v), (a, b) = contour[:2], contour[2:]
    rays = camera.ray(np.stack([u, v], axis=1))
    along = camera.ray(np.stack([u - b, v + a], axis=1))
    normals = np.cross(rays, along)
    return rays, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _nearest(uv: NDArray, contour: NDArray) -> tuple[NDArray, NDArray]:
    """Index (K,) of the nearest point of a contour (2, N) for each point (K, 2), and its distance [px]."""
    square = (uv[:, :1] - contour[0]) ** 2 + (uv[:, 1:] - contour[1]) ** 2
    square = np.where(np.isfinite(square), square, np.inf)
    near = np.argmin(square, axis=1)
    return near, np.sqrt(square[np.arange(len(near)), near])


def _max_pair_distance(distance: NDArray, bound: float) -> float:
    """Largest distance [px] of a pair: the mean plus some standard deviations, fewer for distant contours.

    Source: Zhang, Iterative point matching for registration of free-form curves and surfaces (IJCV 13, 1994), 2.4.
    """
    near = distance[distance < bound]
    if not near.size:
        return bound
    mean, deviation = float(near.mean()), float(near.std())
    for times, deviations in ((1.0, 3.0), (3.0, 2.0), (6.0, 1.0)):
        if mean < times * _GOOD_DISTANCE_PX:
            return min(mean + deviations * deviation, bound)
    return bound


def _twist(x: NDArray, centre: NDArray, rays: NDArray, normals: NDArray, *, by: By) -> NDArray:
    """Twist (v, ω) (6,) in the world that moves points (K, 3) to lines through the centre, or to planes.

    Weighted by the inverse distance along the ray, which gives the angle at the camera. Solved about the points'
    centre, so that rotations and shifts have similar magnitudes.
    """
    far = np.linalg.norm(x - centre, axis=1)
    if by == "planes":
        directions, owner = normals, np.arange(len(x))
    else:
        directions = np.concatenate(perpendiculars(rays))
        owner = np.tile(np.arange(len(x)), 2)
    middle = x.mean(axis=0)
    w = (1.0 / far)[owner]
    rows = np.concatenate([directions, np.cross((x - middle)[owner], directions)], axis=1) * w[:, None]
    residual = np.sum(directions * (centre - x)[owner], axis=1) * w
    local: NDArray = np.linalg.lstsq(rows, residual, rcond=1e-9)[0]
    return np.concatenate([local[:3] + np.cross(middle, local[3:]), local[3:]])
