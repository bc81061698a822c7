"""Bright points: centroids of drawn spheres, their paths before one camera and two, and doubt."""

import cv2
import numpy as np
import pytest
from tests.images.photogrammetry import scenes

from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.bright_points import BrightPointTracker, find_spots, nearest_spots
from kinefit.images.photogrammetry.intersection import flat_camera
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface_tracking import SurfaceTracking

SIZE = (200, 150)


def drawn(centres, rng, diameter=6.0, noise=2.0, size=SIZE):
    """Grey values of spheres at (N, 2) [px] on shaded skin, eight samples a pixel along each side."""
    u, v = np.meshgrid(*((np.arange(8 * n) + 0.5) / 8 - 0.5 for n in size))
    fine = 80.0 + 0.2 * u
    for centre in centres:
        fine[np.hypot(u - centre[0], v - centre[1]) < diameter / 2] = 200.0
    image = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    return np.clip(np.rint(image + rng.normal(0.0, noise, image.shape)), 0, 255)


@pytest.mark.parametrize("diameter", [4, 7, 12])
def test_centroids_are_right_to_a_tenth_of_a_pixel(diameter):
    rng, off = np.random.default_rng(diameter), []
    for _ in range(20):
        centre = 25 + rng.uniform(-0.5, 0.5, 2)
        uv, _ = find_spots(drawn([centre], rng, diameter, size=(50, 50)), 2 * diameter)
        assert len(uv) == 1
        off.append(np.linalg.norm(uv[0] - centre))
    assert np.sqrt(np.mean(np.square(off))) < 0.1


def test_wide_long_and_faint_spots_are_none():
    rng = np.random.default_rng(0)
    image = drawn([(50, 50)], rng, noise=0.5)
    u, v = scenes.pixels(SIZE).T.reshape(2, *SIZE[::-1])
    image[np.hypot(u - 140, v - 100) < 15] = 200
    image[100:103, 40:60], image[30:33, 150:153] = 200, image[30:33, 150:153] + 8
    uv, _ = find_spots(image, 12)
    np.testing.assert_allclose(uv, [(50, 50)], atol=0.1)


def test_paths_of_one_camera_keep_their_names_through_missing_frames_and_end_behind_something():
    rng = np.random.default_rng(1)
    tracker = BrightPointTracker(Rig((flat_camera(SIZE, 1e-3),)), 30.0, SurfaceTracking(reach=8), diameter=12)
    start = np.array([(40.0, 40.0), (100.0, 80.0), (60.0, 110.0)])
    for k in range(14):
        shown = [place for p, place in enumerate(start + k * np.array([4.0, 1.5])) if not (p == 0 and 4 <= k <= 6)]
        image = drawn(shown, rng)
        if k >= 8:
            image[int(95 + 1.5 * k) : int(125 + 1.5 * k), 40:180] = 80.0  # the third is behind something for good
        tracker.update([SplineImage.of(image)])
    paths = tracker.trajectories()
    assert paths.live.shape[1] == 3
    order = np.argsort(paths.uv[0, :, 0, 0])
    uv, live = paths.uv[:, order, 0], paths.live[:, order]
    truth = (start + np.arange(14)[:, None, None] * np.array([4.0, 1.5]))[:, [0, 2, 1]]
    assert live[:, 2].all() and not live[4:7, 0].any() and live[7:, 0].all() and not live[9:, 1].any()
    assert np.linalg.norm(uv - truth, axis=2)[live].max() < 0.3
    np.testing.assert_allclose(paths.x_world[0, order, :2], 1e-3 * truth[0] * (1, -1), atol=3e-4)


def test_points_before_two_and_three_cameras_are_associated_by_their_rays():
    rng, rig = np.random.default_rng(2), scenes.three()
    x = np.array([(-0.1, -0.05, 0.02), (0.05, 0.06, -0.03), (0.12, -0.08, 0.05), (0.0, 0.0, 0.0)])
    for cameras in (rig.cameras[:2], rig.cameras):
        tracker = BrightPointTracker(Rig(cameras), 30.0, diameter=12)
        for k in range(4):
            moved = x + k * np.array([0.004, 0.002, -0.003])
            tracker.update([SplineImage.of(drawn(view.project(moved), rng, size=view.size)) for view in cameras])
        paths = tracker.trajectories()
        assert paths.live.all() and paths.live.shape == (4, 4)
        off = np.linalg.norm(paths.x_world[-1][:, None] - moved[None], axis=2).min(axis=1)
        assert off.max() < 2e-3
        assert (off / np.linalg.norm(paths.std[-1], axis=1)).max() < 4


def test_a_spot_in_doubt_is_taken_by_no_point():
    gaps = np.array([[1.0, 9.0, 30.0], [9.0, 4.0, 5.0], [30.0, 30.0, 30.0]])
    np.testing.assert_array_equal(nearest_spots(gaps, 8.0), [0, -1, -1])
    np.testing.assert_array_equal(nearest_spots(np.array([[1.0], [1.5]]), 8.0), [-1, -1])
    assert len(nearest_spots(np.zeros((0, 3)), 8.0)) == 0
    np.testing.assert_array_equal(nearest_spots(np.zeros((2, 0)), 8.0), [-1, -1])
