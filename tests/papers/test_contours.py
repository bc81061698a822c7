"""Pose of a closed 3D contour from its contour in an image."""

import cv2
import numpy as np
import pytest

from kinefit.bodies.surfaces.fourier import FourierCurve
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.images.silhouette import outline
from kinefit.papers.contours import pose_of_contour

CAMERA = Camera("cam", (320, 240), np.array([[280.0, 0, 159.5], [0, 280.0, 119.5], [0, 0, 1]]),
                T_camera_world=se3.exp(np.array([0.1, 0.0, 0.2, 0.05, -0.1, 0.0])))  # fmt: skip
U = 2 * np.pi * np.arange(48) / 48
R = 0.12 + 0.02 * np.cos(2 * U) + 0.015 * np.sin(3 * U) + 0.01 * np.cos(5 * U + 1)
CURVE = FourierCurve.of(np.stack([R * np.cos(U), R * np.sin(U), 0.04 * np.sin(2 * U)], axis=1), 8)


def placed(turn):
    T = np.eye(4)
    T[:3, :3] = se3.exp_so3(np.array(turn)) @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = [0.02, -0.03, 0.6]
    return T


def seen(T):
    """The contour of the loop's inside, drawn at four times the size."""
    ring = CAMERA.project(se3.apply(T, CURVE.samples(600)))
    ring = np.rint(16 * (4 * ring + 1.5)).astype(np.int32)
    mask = cv2.fillPoly(np.zeros((960, 1280), np.uint8), [ring], 255, shift=4)
    return outline(cv2.resize(mask, (320, 240), interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize("by", ["rays", "planes"])
def test_a_bent_loop_is_found(by):
    truth = placed([0.3, -0.2, 0.4])
    start = se3.exp(np.array([0.01, 0.02, -0.02, 0.1, 0.1, -0.1])) @ truth
    fit = pose_of_contour(CURVE, start, CAMERA, seen(truth), by=by)
    x = CURVE.samples(40)
    off = np.linalg.norm(CAMERA.project(se3.apply(fit.T_world_object, x)) - CAMERA.project(se3.apply(truth, x)), axis=1)
    assert off.mean() < 1.0 and fit.error < 1.0 and fit.cycles > 3


def test_what_is_no_contour_or_far_away_is_refused():
    with pytest.raises(ObservationError, match=r"shape \(2, 100\)"):
        pose_of_contour(CURVE, placed([0, 0, 0]), CAMERA, np.zeros((2, 100)))
    away = seen(placed([0, 0, 0]))
    away[0] += 2000.0
    with pytest.raises(ObservationError, match="near the curve"):
        pose_of_contour(CURVE, placed([0, 0, 0]), CAMERA, away, reach=5.0)
