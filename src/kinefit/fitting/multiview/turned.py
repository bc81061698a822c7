"""One of two cameras that was rotated about itself since the calibration."""

from __future__ import annotations

import numpy as np

from kinefit.fitting.multiview.views import KeypointViews
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera

_TURN_RANGE = np.radians(1.5), np.radians(15.0)  # of a camera that was moved; calibrated ones: up to 0.7 degrees
_TURN_ROUNDS = 25  # of reweighted least squares
_MAX_TURNED_ERROR = 0.15  # after the rotation, as a share of the limit: a detector's noise is 0.07
_MIN_TURN_GAIN = 2.0  # of the error before to that after: up to 1.5 in pairs of real cameras as calibrated
_MAX_OTHER_RATIO = 0.85  # of that error to the other camera's: about the vertical, both rotations leave nearly the same
_MIN_SINE = 0.15  # of the angle between ray and baseline
_MIN_TURN_POINTS = 100  # in both images


def turned_cameras(views: KeypointViews) -> tuple[Camera, ...]:
    """Of two cameras that disagree those that agree if they are rotated about themselves, as they then stand.

    Empty if they agree as they are or with no rotation. Both, the better first, where a rotation of either explains the
    keypoints; one where a rotation of the other leaves a larger error.
    """
    if len(views.rig) != 2:
        return ()
    found = sorted((_turned(views, c) for c in (0, 1)), key=lambda one: one[0])
    (error, _, angle, camera), (other_error, _, _, other) = found
    is_near = error < _MAX_TURNED_ERROR * views.limit and _TURN_RANGE[0] < angle < _TURN_RANGE[1]
    if not is_near or min(before for _, before, _, _ in found) < _MIN_TURN_GAIN * error:
        return ()
    return (camera,) if error < _MAX_OTHER_RATIO * other_error else (camera, other)


def _turned(views: KeypointViews, c: int) -> tuple[float, float, float, Camera]:
    """Median epipolar errors [px] after and before the rotation of a camera about itself that fits the other's rays.

    And its angle [rad], and the camera as it then stands.
    """
    own, other = views.rig.cameras[c], views.rig.cameras[1 - c]
    rays, others = (camera.ray(uv) for camera, uv in zip((own, other), np.moveaxis(views.pixels(), 1, 0)[[c, 1 - c]]))
    base = other.centre_world - own.centre_world
    normals = np.cross(base / max(np.linalg.norm(base), 1e-9), others)
    sines = np.linalg.norm(normals, axis=1, keepdims=True)
    known = np.isfinite(rays + normals).all(axis=1) & (sines[:, 0] > _MIN_SINE * np.linalg.norm(others, axis=1))
    if known.sum() < _MIN_TURN_POINTS:
        return np.inf, np.inf, 0.0, own
    rays, normals, R = rays[known], (normals / sines)[known], np.eye(3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    for _ in range(_TURN_ROUNDS):
        there = rays @ R.T
        off = np.sum(normals * there, axis=1)
        weight = 1.0 / (1.0 + np.square(off / (2.0 * np.median(np.abs(off)) + 1e-12)))
        step = np.linalg.lstsq(weight[:, None] * np.cross(there, normals), -weight * off, rcond=None)[0]
        R = se3.exp_so3(step) @ R
    T_world = se3.transform(R, own.centre_world - R @ own.centre_world)
    errors = [own.matrix[0, 0] * float(np.median(np.abs(np.sum(normals * x, axis=1)))) for x in (rays @ R.T, rays)]
    angle = float(np.linalg.norm(se3.log_so3(R)))
    return errors[0], errors[1], angle, own.with_pose(own.T_camera_world @ se3.inverse(T_world))
