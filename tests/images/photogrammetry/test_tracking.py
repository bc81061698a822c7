"""Surfaces followed through drawn videos, and the filters on their paths."""

import numpy as np
import pytest
from tests.images.photogrammetry import scenes

from kinefit.errors import CalibrationError, ObservationError, TrackingError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface_tracking import SurfaceTracker, SurfaceTracking
from kinefit.images.photogrammetry.trajectories import Trajectories, filtered, has_neighbours, uniform, within_bounds

TEXTURE = scenes.Texture(0.005, 3)


def pose(k):
    return se3.transform(se3.exp_so3(np.array([0.02 * k, 0.1, 0.01 * k])), np.array([0.006 * k, 0.002 * k, 0.004 * k]))


@pytest.fixture(scope="module")
def tracked():
    rig, rng = Rig(scenes.three().cameras[:2]), np.random.default_rng(0)
    tracker = SurfaceTracker(rig, 30.0, SurfaceTracking(step=12, reach=6))
    for k in range(5):
        tracker.update([scenes.plane_image(view, TEXTURE, pose(k), 1.0, rng) for view in rig])
    return tracker.trajectories()


def test_points_stay_on_the_surface_and_where_they_were(tracked):
    local = np.stack([se3.apply(se3.inverse(pose(k)), x) for k, x in enumerate(tracked.x_world)])
    assert np.nanmax(np.abs(local[..., 2])) < 2e-3
    first = np.argmax(tracked.live, axis=0)
    drift = np.linalg.norm(local - local[first, np.arange(local.shape[1])], axis=2)
    assert np.nanpercentile(drift, 99) < 1e-3
    assert np.nanmedian(np.abs(local[..., 2]) / np.linalg.norm(tracked.std, axis=2)) < 1.5


def test_lost_points_are_made_again(tracked):
    started = tracked.live[0].sum()
    assert tracked.live.shape[1] > started > 80
    assert tracked.live[-1, started:].any() and (tracked.live.sum(axis=1) > 0.8 * started).all()


def test_velocity_and_acceleration_of_a_parabola():
    t = np.arange(8) / 10.0
    x = (0.5 * 3.0 * t**2)[:, None, None] * np.array([1.0, 0.0, 0.0])
    x = np.repeat(x, 2, axis=1)
    x[5:, 1] = np.nan
    paths = Trajectories(t, x, np.zeros_like(x), np.zeros((8, 2, 2, 2)))
    np.testing.assert_allclose(paths.velocity[1:-1, 0, 0], 3.0 * t[1:-1], atol=1e-9)
    np.testing.assert_allclose(paths.acceleration[1:-1, 0, 0], 3.0, atol=1e-9)
    assert np.isfinite(paths.velocity[4, 1]).all() and np.isnan(paths.velocity[5, 1]).all()
    assert np.isnan(paths.acceleration[4, 1]).all()


def field_of_paths():
    """Twenty points that move alike, of which one leaves the others at frame 6."""
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.05, 0.05, (20, 3))
    x = start + 0.01 * np.arange(12)[:, None, None] * np.array([1.0, 0, 0]) + 1e-5 * rng.normal(size=(12, 20, 3))
    x[6:, 4, 1] += 0.004 * np.arange(1, 7)
    return Trajectories(np.arange(12) / 30.0, x, np.full_like(x, 1e-4), np.zeros((12, 20, 2, 2)))


def test_a_point_that_leaves_its_neighbours_is_cut_off():
    paths = field_of_paths()
    good = uniform(paths, radius=0.1, limit=0.05)
    assert good[:4].all() and not good[7:, 4].any() and good[:, :4].all()
    kept = paths.kept(good)
    assert kept.live[:5, 4].all() and not kept.live[7:, 4].any() and kept.live[:, 5].all()
    assert not paths.kept(good, shortest=8).live[:, 4].any()  # too short to be kept at all


def test_bounds_on_speed_and_acceleration():
    paths = field_of_paths()
    assert within_bounds(paths, speed=1.0, acceleration=100.0).all()
    assert not within_bounds(paths, speed=0.2, acceleration=100.0).any()
    harsh = within_bounds(paths, speed=1.0, acceleration=2.0)
    assert not harsh[5:7, 4].all() and harsh[:, 5].all()
    with pytest.raises(ObservationError):
        within_bounds(paths, speed=0.0, acceleration=1.0)


def test_a_surface_that_vanishes_and_images_that_change_are_refused():
    rig, rng = Rig(scenes.three().cameras[:2]), np.random.default_rng(0)
    tracker = SurfaceTracker(rig, 30.0, SurfaceTracking(step=20))
    with pytest.raises(ObservationError, match="no frame"):
        tracker.trajectories()
    tracker.update([scenes.plane_image(view, TEXTURE, pose(0), 1.0, rng) for view in rig])
    with pytest.raises(CalibrationError, match="camera a"):
        tracker.update([SplineImage.of(np.zeros((100, 100)))] * 2)
    blank = [SplineImage.of(rng.normal(size=(150, 200))) for _ in rig]
    with pytest.raises(TrackingError, match="frame 1"):
        tracker.update(blank)


def test_both_filters_and_the_neighbours_in_turn():
    """A jump is cut by bounds, a drift by its neighbours, and a point that is alone by having none."""
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.05, 0.05, (20, 3))
    start[7] = [1.0, 0.0, 0.0]
    x = start + 0.01 * np.arange(12)[:, None, None] * np.array([1.0, 0, 0]) + 1e-5 * rng.normal(size=(12, 20, 3))
    x[6:, 4, 1] += 0.004 * np.arange(1, 7)
    x[8:, 2, 2] += 0.5
    paths = Trajectories(np.arange(12) / 30.0, x, np.full_like(x, 1e-4), np.zeros((12, 20, 2, 2)))
    assert not has_neighbours(paths, radius=0.1)[:, 7].any() and has_neighbours(paths, radius=0.1)[:8, :4].all()
    kept, cut = filtered(paths, radius=0.1, bounds=(2.0, 100.0), neighbours=True)
    assert not kept.live[:, 7].any() and not kept.live[7:, 4].any() and not kept.live[8:, 2].any()
    assert cut["bounds"] >= 4 and cut["uniformity"] >= 5 and cut["neighbours"] == 12
    good = np.setdiff1d(np.arange(20), [2, 4, 7])
    assert kept.live[:, good].all()
    free, cut = filtered(paths, radius=0.1)
    assert cut["bounds"] == 0 and not free.live[9:, 2].any()  # its neighbours do not jump


def test_paths_that_were_cut_no_longer_judge_their_neighbours():
    """A wrong point whose surroundings are wrong points passes the second filter alone, and not once those are cut."""
    rng, along = np.random.default_rng(0), [*np.arange(-0.2, 0.001, 0.01), 0.02, 0.025, 0.105, 0.2]
    wrong = slice(len(along) - 4, len(along) - 1)
    x = np.array(along)[:, None] * np.array([1.0, 0, 0]) + 1e-5 * rng.normal(size=(12, len(along), 3))
    x[:, wrong, 2] += 0.02 * np.arange(12)[:, None]
    paths = Trajectories(np.arange(12) / 30.0, x, np.full_like(x, 1e-4), np.zeros((12, len(along), 2, 2)))
    once = paths.kept(uniform(paths, radius=0.1))
    assert once.live[:, -2].all() and not once.live[:, -4:-2].any()
    kept, cut = filtered(paths, radius=0.1)
    assert (kept.live == once.live).all() and cut["neighbours"] == 0
    kept, cut = filtered(paths, radius=0.1, neighbours=True)
    assert not kept.live[:, wrong].any() and cut["neighbours"] == 12  # the last one is alone
    assert kept.live[:, :-4].all()
