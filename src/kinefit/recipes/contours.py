"""Pose of a closed 3D contour from its contour in an image, as Rosenhahn and Klette print it (P1 2.2).

1. The contour is a Fourier series; its low-pass approximation comes first, then higher frequencies.
2. Each of its points is paired with the nearest point of the image's contour (ICP), which stands for a ray of
   projection, or, with the contour's direction there, for a plane (P1 2.1: 3D point to 2D line).
3. The twist of the pose follows from the linear constraints of all pairs at once, and Rodrigues' formula makes a motion
   of it; again until nothing moves.
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

_GOOD = 2.0  # [px] mean distance of contours that belong together; Zhang's D
_SAMPLES = 200  # points of the curve
_MAX_CYCLES = 30  # of each approximation
_MIN_STEP = 1e-5  # [m, rad] of a cycle that ends those of one approximation

By = Literal["rays", "planes"]


class ContourFit(NamedTuple):
    """A pose: T_world_object (4, 4), root mean square distance of the contours [px], and the cycles it took."""

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
    """Pose of a closed curve whose contour in one image is known.

    Parameters
    ----------
    curve : FourierCurve in the object's frame.
    T_world_object : (4, 4) to begin with.
    contour : (4, N) u, v [px] and the unit normal there, as `images.silhouette.outline` gives them.
    orders : highest frequencies of the low-pass approximations that come first; then the whole curve.
    by : "rays", a point to the ray of its partner, or "planes", to the plane through the contour's tangent there, so
        that contours glide along each other.
    reach : float [px] beyond which no points are paired at first; then it follows from the distances themselves.

    Raises
    ------
    ObservationError
        A contour that is none; no point of it near the curve.
    """
    seen = np.asarray(contour, float)
    if seen.ndim != 2 or len(seen) != 4 or seen.shape[1] < 6 or not np.isfinite(seen).all():
        raise ObservationError(f"a contour of shape {seen.shape}", remedy="Give (4, N): u, v and the normal there.")
    fixed = _lines(camera, seen)
    T, done = np.array(T_world_object, float), 0
    levels = [*(order for order in orders if order < curve.order), curve.order]
    for order in levels:
        points, bound = curve.low_pass(order).samples(_SAMPLES), reach
        for _ in range(_MAX_CYCLES):
            x = se3.apply(T, points)
            near, distance = _nearest(camera.project(x), seen[:2])
            pairs = distance < _kept(distance, bound)
            if pairs.sum() < 6:
                raise ObservationError("no contour is near the curve", remedy="Start nearer to it, or widen the reach.")
            delta = _twist(x[pairs], camera.centre_world, *(part[near[pairs]] for part in fixed), by=by)
            T, done = se3.exp(delta) @ T, done + 1
            if np.linalg.norm(delta) < _MIN_STEP:
                break
    _, distance = _nearest(camera.project(se3.apply(T, curve.samples(_SAMPLES))), seen[:2])
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


def _kept(distance: NDArray, bound: float) -> float:
    """[px] up to which pairs count: the mean and so many deviations of their distances, fewer while they are far apart.

    Zhang, Iterative point matching for registration of free-form curves and surfaces (IJCV 13, 1994), 2.4.
    """
    near = distance[distance < bound]
    if not near.size:
        return bound
    mean, deviation = float(near.mean()), float(near.std())
    for times, deviations in ((1.0, 3.0), (3.0, 2.0), (6.0, 1.0)):
        if mean < times * _GOOD:
            return min(mean + deviations * deviation, bound)
    return bound


def _twist(x: NDArray, centre: NDArray, rays: NDArray, normals: NDArray, *, by: By) -> NDArray:
    """(6,) twist (v, ω) in the world that brings points (K, 3) to lines through the centre, or to planes.

    Weighed by the distance along the ray, so that what counts is the angle at the camera; about the points' middle, so
    that turns and shifts are of one size.
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
