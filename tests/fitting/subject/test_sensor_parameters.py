"""Extrinsics that silhouettes, depth images and clouds of points tell, beside markers that hold the world."""

import numpy as np
import pytest
from tests.fitting.subject import measured
from tests.sensors.scenes import ring

from kinefit.bodies.rendering import render_body
from kinefit.bodies.surfaces.places import sample
from kinefit.fitting.frame.routing import Sensors
from kinefit.fitting.subject.fit import fit_subject
from kinefit.fitting.subject.subject import CameraExtrinsics, moved_rig
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, PointCloud, SilhouetteFrame
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings

BODY = measured.HUMANOID


def turned(rig, degrees=0.5):
    """Every camera turned about an axis of its own."""
    random = np.random.default_rng(4)
    twists = np.zeros((len(rig), 6))
    axes = random.normal(size=(len(rig), 3))
    twists[:, 3:] = np.radians(degrees) * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Rig(tuple(c.with_pose(se3.exp(t) @ c.T_camera_world) for c, t in zip(rig, twists))), twists


def frame(kind, state, camera, known, time):
    """What a camera sees where it stands, told as if it stood where it is `known`."""
    if kind == "cloud":
        x, n, segment = (np.asarray(a) for a in sample(BODY, 1500))
        f = Scene(BODY, state, Rig(())).frames[segment]
        R = f[:, :9].reshape(-1, 3, 3)
        x, n = np.einsum("nij,nj->ni", R, x) + f[:, 9:], np.einsum("nij,nj->ni", R, n)
        x = x[np.sum(n * (camera.centre_world - x), axis=1) > 0]
        T = known.T_world_camera @ camera.T_camera_world
        return PointCloud(camera.name, time, x @ T[:3, :3].T + T[:3, 3], known.centre_world, on_body=True)
    drawn = render_body(BODY, state, camera)
    if kind == "silhouette":
        return SilhouetteFrame(camera.name, time, drawn.seen.copy())
    return DepthFrame(camera.name, time, np.where(np.isfinite(drawn.depth), drawn.depth, 0.0))


@pytest.mark.parametrize("kind", ["silhouette", "depth", "cloud"])
def test_cameras_that_are_turned_by_half_a_degree_come_back(kind):
    known = ring(2, away=2.5)
    known = Rig(tuple(c.with_pose(c.T_camera_world @ se3.exp([0, 0.9, 0, 0, 0, 0])) for c in known))
    rig, twists = turned(known)
    states = measured.people(4)
    sensors = Sensors(known, 10.0, {f"silhouette {n}": 1.0 for n in known.names}, TrackSettings(), on_body=known.names)
    steps = measured.markers(BODY, states, points="HANIM_45")
    for k, (state, step) in enumerate(zip(states, steps)):
        frames = [frame(kind, state, *pair, k / 10) for pair in zip(rig, known)]
        step += sensors.measurements(frames, Scene(BODY, state, known, time=k / 10))
    found = fit_subject(BODY, known, steps, states, [CameraExtrinsics(known, None, (1e-3, 0.01))], rounds=4)
    away = np.abs(found.mean - twists.ravel()).reshape(-1, 6)[:, 3:]
    assert np.degrees(away).max() < 0.1
    assert np.degrees(found.std.reshape(-1, 6)[:, 3:]).max() < 0.2


def with_errors(cameras, moved, share):
    """The same after a fit that found such twists [stated deviations], with so large a share of variance left."""
    prior = cameras.information
    information = prior * (1.0 / share - 1.0)
    found = np.repeat(cameras.std, 3) * np.reshape(moved, (-1, 6))
    return cameras.with_errors_of(slice(None), found.ravel() * (1.0 - share), information, prior)


def test_errors_of_cameras_are_as_large_as_a_take_shows():
    cameras, random = CameraExtrinsics(ring(4), None, (0.003, 0.002)), np.random.default_rng(3)
    right = random.normal(size=24)
    assert np.all(with_errors(cameras, np.zeros(24), 0.05).factors < 0.5)
    assert np.allclose(with_errors(cameras, right, 1.0).factors, 1.0)
    for off in (1.0, 6.0):  # of the whole calibration
        found = with_errors(cameras, off * right, 0.05)
        assert np.all((found.factors > 0.6 * off) & (found.factors < 1.5 * off))
        assert found.wrong == (off > 1.0)
    right[:6] *= 0.3
    right[6:12] += 20.0
    far = with_errors(cameras, right, 0.05)
    assert far.factors[1] > 8.0 and np.all(far.factors[[0, 2, 3]] < 1.5) and far.wrong
    assert np.allclose(np.sqrt(np.diag(np.linalg.inv(far.information))), far.spreads.ravel())
    two = CameraExtrinsics(ring(2), None, (0.003, 0.002))
    assert not with_errors(two, right[:12], 0.05).wrong


def test_cameras_that_were_moved_are_drawn_to_their_calibration():
    rig, twist = ring(3), 0.01 * np.arange(6.0)
    moved = CameraExtrinsics(moved_rig(rig, {rig.names[1]: twist}), None, calibrated=rig)
    assert np.allclose(moved.mean.reshape(-1, 6), [np.zeros(6), -twist, np.zeros(6)], atol=1e-4)


