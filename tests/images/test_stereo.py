"""Stereo pairs: a textured wall at a known place, a real board of known squares, rigs any way round."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.oracle import look_at

from kinefit.errors import CalibrationError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.images.depth import to_points
from kinefit.images.stereo import StereoRectifier
from kinefit.readers.calibration.read import read_opencv_stereo

MATRIX = [[290.0, 0, 159.5], [0, 290.0, 119.5], [0, 0, 1]]
NORMAL, OFFSET = np.array([0.1, -0.15, 1.0]) / np.linalg.norm([0.1, -0.15, 1.0]), 2.0  # the wall n·x = offset


def camera(name, place, turn=(0.0, 0.0, 0.0), *, distortion=(), model="radtan"):
    R = se3.exp_so3(np.array(turn))
    return Camera(name, (320, 240), MATRIX, distortion, model, se3.transform(R, -R @ np.array(place)))


def wall(seen_by, seed=0):
    """What a camera sees of the wall, whose grey values are smooth noise, 2 cm wide."""
    texture = np.random.default_rng(seed).random((512, 512)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(texture, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX)
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    ray = seen_by.ray(np.stack([u, v], axis=-1))
    x = seen_by.centre_world + ray * ((OFFSET - NORMAL @ seen_by.centre_world) / (ray @ NORMAL))[..., None]
    at = ((x[..., :2] * 100.0) % 512).astype(np.float32)
    return cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.uint8)


BARREL = (-0.2, 0.05, 0.001, -0.001)
RIGS = {
    "side by side": (camera("a", (0, 0, 0)), camera("b", (0.1, 0, 0))),
    "named the other way round": (camera("a", (0.1, 0, 0)), camera("b", (0, 0, 0))),
    "above each other": (camera("a", (0, 0, 0)), camera("b", (0, 0.1, 0))),
    "turned, with distortion": (
        camera("a", (0, 0, 0), (0.02, 0.08, -0.03), distortion=BARREL),
        camera("b", (0.12, 0.01, 0.02), (-0.01, -0.05, 0.02), distortion=BARREL),
    ),
    "fisheye": (
        camera("a", (0, 0, 0), distortion=(0.02, -0.01, 0.0, 0.0), model="fisheye"),
        camera("b", (0.1, 0, 0), distortion=(0.02, -0.01, 0.0, 0.0), model="fisheye"),
    ),
}


@pytest.mark.parametrize("kind", RIGS)
def test_a_wall_is_where_it_is(kind):
    """Most of it is found, and its distance is off by less than half a pixel's worth, without bias."""
    a, b = RIGS[kind]
    pair = StereoRectifier(a, b, near=1.0, far=4.0)
    moved = pair.disparity(wall(a), wall(b))
    depth = np.nan_to_num(np.float32(pair.camera.matrix[0, 0] * pair.baseline) / moved, nan=0.0)
    points = to_points(depth, pair.camera)
    assert moved.shape == pair.camera.size[::-1]
    assert len(points) == np.isfinite(moved).sum() > 0.7 * 320 * 240
    off = points @ NORMAL - OFFSET
    assert np.median(np.abs(off)) < pair.deviation(2.0, 0.2)
    assert abs(np.median(off)) < pair.deviation(2.0, 0.1)
    depth = pair.depth(wall(a), wall(b))
    assert np.all((depth == 0) | ((depth >= 0.99) & (depth <= 4.01)))


def test_the_rectified_view_is_a_camera_of_the_rig():
    """A world point seen by both original cameras lies on one row of both rectified views, f·b/z apart."""
    a, b = RIGS["turned, with distortion"]
    pair = StereoRectifier(a, b, near=1.0, far=4.0)
    x = np.random.default_rng(1).uniform((-0.4, -0.3, 1.5), (0.4, 0.3, 3.0), (50, 3))
    z = (x @ pair.camera.T_camera_world[:3, :3].T + pair.camera.T_camera_world[:3, 3])[:, 2]
    assert pair.baseline == pytest.approx(np.linalg.norm([0.12, 0.01, 0.02]))
    images = [np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.uint8)]
    for point, depth in zip(x, z):
        for image, seen_by in zip(images, (a, b)):
            image[:] = 0
            u, v = np.rint(seen_by.project(point)).astype(int)
            cv2.circle(image, (int(u), int(v)), 3, 255, -1)
        left, right = (np.argwhere(v > 100).mean(axis=0)[::-1] for v in pair.rectify(*images))
        np.testing.assert_allclose(left, pair.camera.project(point), atol=0.8)
        assert abs(left[1] - right[1]) < 1.2  # discs are drawn at whole pixels of either image
        assert abs(left[0] - right[0] - pair._offset - pair.camera.matrix[0, 0] * pair.baseline / depth) < 1.3


def test_a_frame_is_that_of_a_depth_sensor():
    a, b = RIGS["side by side"]
    pair = StereoRectifier(a, b, near=1.0, far=4.0, name="head")
    frame = pair.frame(wall(a), wall(b), 0.5)
    assert (frame.sensor, frame.time, frame.size) == ("head", 0.5, pair.camera.size)
    colour = [np.repeat(wall(c)[..., None], 3, axis=2) for c in (a, b)]
    np.testing.assert_allclose(pair.depth(*colour), frame.depth, atol=0.05)


def test_without_texture_there_is_no_depth():
    a, b = RIGS["side by side"]
    flat = np.full((240, 320), 128, np.uint8)
    assert (StereoRectifier(a, b).depth(flat, flat) > 0).mean() < 0.05


def test_what_cannot_work_is_refused():
    a, b = RIGS["side by side"]
    away = camera("b", (0.1, 0, 0), (0, np.pi, 0))
    cases = [
        (lambda: StereoRectifier(a, camera("b", (0, 0, 0))), CalibrationError, "at the same position"),
        (lambda: StereoRectifier(a, away), CalibrationError, "look in different"),
        (lambda: StereoRectifier(a, camera("b", (0, 0, 1.0))), CalibrationError, "along their baseline"),
        (lambda: StereoRectifier(a, camera("b", (3.0, 0, 0)), near=1.0, far=2.0), ObservationError, "near="),
        (
            lambda: StereoRectifier(a, camera("b", (8.0, 0, 0)), near=6.0, far=7.0),
            CalibrationError,
            "the second camera sees only",
        ),
        (lambda: StereoRectifier(a, b, near=2.0, far=1.0), ObservationError, "0 < near < far"),
        (lambda: StereoRectifier(a, b, near=np.nan), ObservationError, "0 < near < far"),
        (lambda: StereoRectifier(a, b).depth(wall(a)[:100], wall(b)), ObservationError, "camera a"),
        (lambda: StereoRectifier(a, b).depth(wall(a), wall(b).astype(float)), ObservationError, "camera b"),
    ]
    for make, error, message in cases:
        with pytest.raises(error, match=message):
            make()


def test_converging_cameras_share_their_view():
    """Two cameras a metre apart that look at one place see it in both windows."""
    a = replace(look_at("a", (-0.5, 0, 0), (0, 0, 3.0), distortion=()), size=(1280, 960))
    b = replace(look_at("b", (0.5, 0, 0), (0, 0, 3.0), distortion=()), size=(1280, 960))
    pair = StereoRectifier(a, b, near=2.5, far=4.0)
    uv = pair.camera.project([0, 0, 3.0])
    f_b_z = pair.camera.matrix[0, 0] * pair.baseline / 3.0
    assert 0 < uv[0] < pair.camera.size[0] and 0 < uv[0] - f_b_z - pair._offset < pair.camera.size[0]


def board(pair, left, right):
    """(6, 9, 3) [m] corners of the board in the rectified camera's frame, depth the median of 7 x 7 pixels."""
    view, _ = pair.rectify(left, right)
    found, corners = cv2.findChessboardCorners(view, (9, 6))
    assert found
    corners = cv2.cornerSubPix(view, corners, (4, 4), (-1, -1), (3, 30, 0.01)).reshape(-1, 2)
    depth = pair.depth(left, right)
    z = []
    for u, v in np.rint(corners).astype(int):
        near = depth[v - 3 : v + 4, u - 3 : u + 4]
        z.append(np.median(near[near > 0]) if (near > 0).sum() > 10 else np.nan)
    ray = np.c_[(corners - pair.camera.matrix[:2, 2]) / pair.camera.matrix[0, 0], np.ones(len(corners))]
    return (ray * np.array(z)[:, None]).reshape(6, 9, 3)


def test_squares_of_a_real_board(data_dir):
    """13 pairs, their own calibration: squares within 1 % of their size, corners within 1 mm of a plane at 0.3 m."""
    folder = data_dir("stereo_opencv_chessboard")
    rig = read_opencv_stereo(folder / "intrinsics.yml", folder / "extrinsics.yml", unit=0.025, image_size=(640, 480))
    pair = StereoRectifier(*rig.cameras, near=0.2, far=1.5)
    squares, flat = [], []
    for k in (1, 4, 6, 9, 13):
        images = [cv2.imread(str(folder / f"{side}{k:02d}.jpg"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")]
        x = board(pair, *images)
        squares += [np.nanmedian(np.linalg.norm(np.diff(x, axis=axis), axis=-1)) for axis in (0, 1)]
        points = x.reshape(-1, 3)[np.isfinite(x).all(axis=-1).ravel()]
        centre = np.median(points, axis=0)
        kept = points[np.abs(points - centre).max(axis=1) < 0.2]  # stripes of a board match one period beside
        normal = np.linalg.svd(kept - kept.mean(axis=0))[2][-1]
        flat.append(np.median(np.abs((kept - kept.mean(axis=0)) @ normal)))
    assert abs(np.mean(squares) / 0.025 - 1.0) < 0.01
    assert np.median(flat) < 1e-3
