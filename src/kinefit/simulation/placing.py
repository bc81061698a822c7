"""Place a sensor in front of a person, at the shortest distance from which all of the motion is in view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.motion import UP_AXES, Motion

_MARGIN_SHARE = 0.04  # of the image, free around the landmarks
_MIN_DISTANCE = 1.0  # [m]
_MAX_DISTANCE = 20.0  # [m]
_SURFACE_MARGIN = 0.1  # [m] between landmarks and the body's surface


def in_front(
    motion: Motion, camera: Camera, *, distance: float | None = None, azimuth: float = 0.0, height: float = 1.2,
    near: float = 0.0, far: float = np.inf,
) -> Camera:
    """The camera placed in front of a person, looking at the middle of the motion.

    Parameters
    ----------
    motion : Motion
    camera : Camera
        Its intrinsics are kept, its pose is replaced.
    distance : float [m], optional
        From the middle of the motion, along the floor; default: the shortest from which all landmarks are in the image
        and within the range.
    azimuth : float [rad]
        Counter-clockwise seen from above, from the person's forward direction (mean of the root's x axis).
    height : float [m] above the lowest landmark
    near, far : float [m]
        Range of the sensor.

    Raises
    ------
    ObservationError
        There is no distance from which all of the motion is in view and within the range.
    """
    up = np.array(UP_AXES[motion.up])
    points = places(motion)
    along = points @ up
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    forward = motion.Ts_world_root[:, :3, 0].mean(axis=0)
    forward -= (forward @ up) * up
    if np.linalg.norm(forward) < 0.1:  # all directions occur, or the x axis is vertical
        forward = np.roll(up, 1)
    forward /= np.linalg.norm(forward)
    ahead = np.cos(azimuth) * forward + np.sin(azimuth) * np.cross(up, forward)
    eye = middle + (along.min() + height - middle @ up) * up
    for trial in (distance,) if distance is not None else np.arange(_MIN_DISTANCE, _MAX_DISTANCE, 0.05):
        placed = camera.with_pose(look_at(eye + trial * ahead, middle, up))
        if distance is not None or _sees(placed, points, near, far):
            return placed
    depth = float(np.ptp(points @ ahead))
    raise ObservationError(
        f"no place of {camera.name} has the whole motion ({depth:.1f} m deep) in view from {near:g} to {far:g} m",
        remedy="Choose frames in which the person moves less, or give a distance.",
    )


def places(motion: Motion) -> NDArray:
    """(N, 3) [m] all landmarks in all frames, in the world; joint centres for a body without landmarks."""
    if len(motion.body.landmarks):
        return motion.positions().reshape(-1, 3)
    return motion.segment_poses()[..., :3, 3].reshape(-1, 3)


def look_at(eye: NDArray, target: NDArray, up: NDArray) -> NDArray:
    """T_camera_world (4, 4) of a camera at `eye` (3,) [m] that looks at `target` (3,) [m], with `up` (3,) upwards."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ eye
    return T


def beside(camera: Camera, name: str, baseline: float) -> Camera:
    """The same camera, `baseline` [m] to its right: the second of a stereo head."""
    T = np.eye(4)
    T[0, 3] = -baseline
    return Camera(name, camera.size, camera.matrix, camera.distortion, camera.model, T @ camera.T_camera_world)


def _sees(camera: Camera, x_world: NDArray, near: float, far: float) -> bool:
    uv = camera.project(x_world) / camera.size
    z = x_world @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    inside = np.all((uv > _MARGIN_SHARE) & (uv < 1 - _MARGIN_SHARE), axis=1)  # False for NaN
    return bool(inside.all() and z.min() > near + _SURFACE_MARGIN and z.max() < far)
