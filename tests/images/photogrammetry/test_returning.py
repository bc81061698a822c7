"""Points that vanish from a turning arm come back under their names where its motion says."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from benchmarks.surface_body import cameras, moving_arm
from benchmarks.textured import textured_picture

from kinefit.bodies.surfaces.places import body_mesh
from kinefit.errors import ObservationError
from kinefit.images.photogrammetry.returning import Vanished
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface_tracking import SurfaceTracker, SurfaceTracking
from kinefit.simulation.rendering.scenes import SimulatedScene

RIG = cameras(320)


def turning(frames=9):
    """The arm turns about its own axis by 16 degrees a frame, and back: what was in view goes out of it and returns."""
    motion, k = moving_arm(0, frames), np.arange(frames)
    angles = np.tile(motion.angles[:1], (frames, 1))
    angles[:, motion.body.tree.coordinate("arm_rot_r")] += np.radians(16 * np.minimum(k, k[::-1]))
    return replace(motion, angles=angles)


MOTION = turning()


@pytest.fixture(scope="module")
def images():
    scene = SimulatedScene(MOTION, body_mesh(MOTION.body, around=64))
    return [
        [SplineImage.of(textured_picture(scene, k, camera, grain=0.005, seed=3)) for camera in RIG]
        for k in range(len(MOTION))
    ]


def followed(images, motion):
    tracker = SurfaceTracker(RIG, 30.0, SurfaceTracking(step=8), motion=motion)
    for several in images:
        tracker.update(several)
    return tracker.trajectories()


def gaps(paths):
    """Paths that were interrupted, with the frames before and after."""
    out = []
    for p, live in enumerate(paths.live.T):
        at = np.flatnonzero(live)
        out += [(p, a, b) for a, b in pairwise(at) if b - a > 1]
    return out


def test_lost_points_keep_their_names_only_with_the_motion(images):
    assert not gaps(followed(images, None))
    paths = followed(images, MOTION)
    back = gaps(paths)
    assert len(back) > 10
    off = []
    for p, a, b in back:
        frames = [MOTION.body.tree.forward(np.eye(4), MOTION.angles[k])[0] for k in (a, b)]
        local = [
            [f[s, :9].reshape(3, 3).T @ (paths.x_world[k, p] - f[s, 9:]) for s in range(1, len(f))]
            for f, k in zip(frames, (a, b))
        ]
        off.append(np.linalg.norm(np.subtract(*local), axis=1).min())
    assert np.median(off) < 0.002 and np.mean(np.array(off) > 0.006) < 0.1


def test_what_faces_away_is_not_expected(images):
    vanished = Vanished(RIG, MOTION, 13)
    paths = followed(images[:2], None)
    there = np.flatnonzero(np.isfinite(paths.uv[0]).all(axis=(1, 2)))[::10]
    vanished.remember(0, there, paths.x_world[0, there], paths.uv[0, there], images[0])
    assert len(vanished) == len(there)
    same = vanished.expected(0)
    assert np.linalg.norm(same.uv - paths.uv[0, same.ids], axis=2).max() < 1.0
    assert same.maps == pytest.approx(np.tile(np.eye(2), (len(same.ids), len(RIG), 1, 1)))
    turned = vanished.expected(4)
    assert 0 < len(turned.ids) < len(same.ids)
    vanished.mark_found(4, turned.index)
    assert len(vanished) == len(there) - len(turned.ids)
    assert vanished.expected(len(MOTION)) is None  # the motion has ended


def test_points_off_the_body_are_not_remembered(images):
    vanished = Vanished(RIG, MOTION, 13)
    vanished.remember(0, np.array([4]), np.full((1, 3), 2.0), np.full((1, 3, 2), 50.0), images[0])
    assert len(vanished) == 0 and vanished.expected(1) is None


def test_a_tracker_needs_a_frame_before_it_tells_paths():
    with pytest.raises(ObservationError, match="no frame"):
        SurfaceTracker(RIG, 30.0, motion=MOTION).trajectories()


def test_the_motion_says_when_a_lost_point_comes_back(images):
    """Turned away and back by one angle, a point is due as long before the end as it was lost after the beginning."""
    tracker = SurfaceTracker(RIG, 30.0, SurfaceTracking(step=8), motion=MOTION)
    for several in images:
        tracker.update(several)
    returns = tracker.returns()
    assert len(returns) > 10
    found = [of for of in returns if of.found is not None]
    assert found and all(of.expected is not None and of.lost <= of.expected <= of.found for of in found)
    late = [of.found - of.expected for of in found]
    assert np.median(late) <= 1
    assert not SurfaceTracker(RIG, 30.0).returns()
