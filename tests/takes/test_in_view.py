"""Two people before one depth camera: each is followed, also where one walks past before the other."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.depth_oracle import BODY, camera, facing

from kinefit import Recording, track
from kinefit.bodies.rendering import render_body
from kinefit.errors import TrackingError
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame
from kinefit.sensors.settings import TrackSettings
from kinefit.takes.in_view import people_in_depth

RATE, COUNT = 15.0, 12


def at(state, x, z):
    T = np.array(state.T_world_root)
    T[:3, 3] = x, T[1, 3], z
    return replace(state, T_world_root=T)


def truth(k):
    """Two people: one walks to the right, a metre before the other, who sways."""
    x = -0.25 + 0.07 * k
    return at(facing(yaw=0.2), x, 0.3), at(facing(yaw=-0.1), 0.45 - 0.1 * np.sin(0.5 * k), -0.7)


def seen(k):
    rng, cam = np.random.default_rng(k), camera()
    depth = np.minimum.reduce([render_body(BODY, state, cam).depth for state in truth(k)])
    shown = np.isfinite(depth)
    return np.where(shown, depth + 0.004 * rng.normal(size=depth.shape), 0.0).astype(np.float32)


@pytest.mark.slow
def test_two_people_before_a_depth_camera():
    rig = Rig((camera(),))
    steps = [[DepthFrame("depth", k / RATE, seen(k))] for k in range(COUNT)]
    recording = replace(Recording.of_frames(steps, rig, rate=RATE, up="y"), depth={0: steps[0][0]})
    view, owners = people_in_depth(None, recording, BODY), []
    assert len(view.people) == 2
    for k in range(2):
        alone = view.recording(recording, BODY, k + 1, TrackSettings())
        assert alone.followed.number == k + 1 and len(alone.others) == 1
        motion = track(alone, BODY, size=False, smooth=False)
        roots = np.array([[s.T_world_root[:3, 3] for s in truth(step)] for step in range(COUNT)])
        gaps = np.linalg.norm(motion.Ts_world_root[:, None, :3, 3] - roots, axis=-1)
        own = int(np.argmin(gaps[0]))
        assert (gaps[:, own] < 0.15).all() and np.median(gaps[:, own]) < 0.05
        owners.append(own)
        assert motion.provenance["people"]["followed"] == k + 1
    assert sorted(owners) == [0, 1]
    with pytest.raises(TrackingError, match="2 people are in view"):
        view.recording(recording, BODY, 3, TrackSettings())


def test_one_person_before_a_depth_camera_is_nobody_else():
    cam = camera()
    depth = render_body(BODY, truth(0)[0], cam).depth
    frame = DepthFrame("depth", 0.0, np.where(np.isfinite(depth), depth, 0.0))
    recording = Recording.of_frames([[frame]], Rig((cam,)), rate=RATE, up="y")
    view = people_in_depth(None, recording, BODY)
    assert view.people == () and view.recording(recording, BODY, None, TrackSettings()) is recording


def test_furniture_is_nobody():
    rig = Rig((camera(),))
    steps = [[DepthFrame("depth", k / RATE, with_a_box(k))] for k in (0, COUNT - 1)]
    recording = Recording.of_frames(steps, rig, rate=RATE, up="y")
    assert people_in_depth(None, replace(recording, depth={0: steps[0][0], 1: steps[1][0]}), BODY).people == ()


def with_a_box(k):
    """One person, and a thing of a person's size and distance that stands still."""
    cam = camera()
    depth = render_body(BODY, at(facing(yaw=0.2), -0.4 + 0.02 * k, 0.3), cam).depth
    depth = np.where(np.isfinite(depth), depth, 0.0)
    height, width = depth.shape
    box = (slice(height // 3, int(0.9 * height)), slice(int(0.75 * width), int(0.95 * width)))
    depth[box] = np.where(depth[box] > 0, depth[box], np.median(depth[depth > 0]))
    return depth.astype(np.float32)
