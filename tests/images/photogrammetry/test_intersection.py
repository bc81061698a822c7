"""Points of one camera: on a plane, on a body, matched back and anchored to their first image."""

import numpy as np
import pytest
from benchmarks.accuracy.surfaces.surface_body import moving_arm
from tests.images.photogrammetry import scenes

from kinefit.bodies.surfaces.places import nearest
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.intersection import at_range, body_ranges, flat_camera, plane_ranges
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface_tracking import SurfaceTracker, SurfaceTracking

SIZE = (160, 120)
MOVE = np.array([1.7, -0.9])  # [px] per frame


def shifted(texture, k, rng, noise=2.0):
    grey = texture(scenes.pixels(SIZE) - k * MOVE).reshape(SIZE[::-1])
    return grey + noise * rng.normal(size=grey.shape)


@pytest.fixture(scope="module")
def paths():
    """Twelve images of a texture that moves; from the sixth on, another one hides a part of it."""
    rng, texture, other = np.random.default_rng(0), scenes.Texture(1.5, 1), scenes.Texture(1.5, 2)
    tracker = SurfaceTracker(Rig((flat_camera(SIZE, 1e-3),)), 30.0, SurfaceTracking(window=15, step=12))
    for k in range(12):
        image = shifted(texture, k, rng)
        if k >= 5:
            image[:, 90:] = shifted(other, 0, rng)[:, 90:]
        tracker.update([SplineImage.of(image)])
    return tracker.trajectories()


def test_points_of_a_plane_are_followed_without_drift(paths):
    shift = paths.uv[:, :, 0] - paths.uv[0, :, 0] - np.arange(12)[:, None, None] * MOVE
    assert paths.live[-1].sum() > 15
    off = np.linalg.norm(shift[-1], axis=1)
    assert np.nanmax(off) < 0.3
    assert np.sqrt(np.nanmean(off**2)) < 1.5 * np.sqrt(np.nanmean(np.linalg.norm(shift[2], axis=1) ** 2))
    live = paths.live
    np.testing.assert_allclose(paths.x_world[live][:, :2], 1e-3 * paths.uv[:, :, 0][live] * (1, -1), atol=1e-9)
    assert np.abs(paths.x_world[live][:, 2]).max() < 1e-9


def test_hidden_points_are_lost_and_no_new_ones_are_made(paths):
    hidden = paths.uv[4, :, 0, 0] > 90 + 8
    assert hidden.sum() > 10
    assert not paths.live[6:, hidden].any()
    assert paths.live.shape[1] == paths.live[0].sum()


def test_standard_deviations_of_a_plane_are_those_of_the_match_times_the_pixel():
    camera = flat_camera(SIZE, 2e-3)
    uv, covariance = np.array([[10.0, 20.0], [150.0, 110.0]]), np.tile(np.diag([0.01, 0.04]), (2, 1, 1))
    found = at_range(camera, uv, covariance, plane_ranges(camera)(0, uv))
    np.testing.assert_allclose(found.x_world, np.column_stack([2e-3 * uv * (1, -1), np.zeros(2)]), atol=1e-9)
    np.testing.assert_allclose(found.std[:, :2], np.tile([2e-4, 4e-4], (2, 1)), rtol=1e-3)


def test_rays_end_on_the_body_and_beside_it_nowhere():
    motion = moving_arm(0, 1)
    body, state = motion.body, motion.state(0)
    middle = body.tree.forward(state.T_world_root, state.angles)[0][:, 9:].mean(axis=0)
    camera = scenes.camera("a", middle + np.array([0.0, 0.0, -1.5]), middle)
    uv = scenes.pixels(camera.size)[::37]
    ranges = body_ranges(motion, camera)(0, uv)
    on = np.isfinite(ranges)
    assert 20 < on.sum() < len(uv) - 20
    x = at_range(camera, uv, np.tile(0.01 * np.eye(2), (len(uv), 1, 1)), ranges, 0.02)
    gap = nearest(body, state, x.x_world[on], max_distance=1.0).distance
    assert np.percentile(np.abs(gap), 50) < 1e-3 and gap.max() < 0.021
    along = np.einsum("ni,nij,nj->n", camera.ray(uv)[on], x.covariance[on], camera.ray(uv)[on])
    np.testing.assert_allclose(np.sqrt(along), 0.02, rtol=1e-2)
    assert np.isnan(x.parallax[~on]).all()
    assert np.isnan(body_ranges(motion, camera)(1, uv)).all()
