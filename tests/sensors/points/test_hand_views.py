"""Fingers of a hand are tracked together, or lost together."""

import numpy as np
import pytest
from benchmarks.hands_simulated import fingers, hands_moving, near_rig
from hypothesis import given
from hypothesis import strategies as st

from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import geman_mcclure
from kinefit.observations import KeypointFrame
from kinefit.sensors.points.keypoints import KeypointSensor
from kinefit.sensors.scene import Scene
from kinefit.simulation import simulate_keypoints

TRUTH = hands_moving(0, seconds=0.1)
BODY, SET = TRUTH.body, "MEDIAPIPE_75"
RIG = near_rig(TRUTH)
SEEN = simulate_keypoints(TRUTH, RIG, SET, noise_px=0.0, outliers=0.0, missing=0.0, seed=0)
FINGERS = fingers(BODY)[0]
LEFT = FINGERS & np.array([s.endswith("_l") for s in BODY.tree.segments])
OF_LEFT = np.array([name.startswith("left_") for name in SEEN[0].names]) & (np.arange(75) >= 33)


def told(cameras, shifted=(), metres=0.0, *, hidden=(), confidence=1.0):
    """Evidence at the true state, where some cameras see the left hand beside its place, and some points are unseen."""
    rig = Rig(tuple(RIG)[:cameras])
    scene, frames = Scene(BODY, TRUTH.state(0), rig), []
    wrist = BODY.positions(TRUTH.state(0), BODY.landmarks.select(("l_wrist",)))[0]
    for c, record in enumerate(SEEN[:cameras]):
        uv, T = np.array(record.points[0, 0]), rig[record.camera].T_camera_world
        px_per_metre = rig[record.camera].matrix[0, 0] / (T[2, :3] @ wrist + T[2, 3])
        uv[OF_LEFT] += (metres * px_per_metre if c in shifted else 0.0, 0.0)
        seen = np.full(75, confidence)
        seen[list(hidden)] = 0.0
        frames.append(KeypointFrame(record.camera, 0.0, record.names, uv, seen, SET))
    sensor = KeypointSensor(rig, {}, 8.0, geman_mcclure(), 0.03)
    return sensor.prepare(frames, scene).match(scene, 0.03).evidence(scene)


@pytest.mark.parametrize(("cameras", "shifted", "lost"), [
    (2, (1,), True), (3, (1,), False), (4, (0, 3), True), (4, (0,), False), (4, (0, 1, 2), True), (1, (), False),
])  # fmt: skip
def test_a_hand_is_lost_where_no_more_views_agree_than_contradict(cameras, shifted, lost):
    found = told(cameras, shifted, 0.04)
    assert found.lost[LEFT].all() if lost else not found.lost[LEFT].any()
    assert not found.lost[~LEFT & FINGERS].any()


@given(st.floats(0.03, 0.3), st.floats(0.05, 1.0))
def test_however_far_off_and_however_unsure_a_view_is(metres, confidence):
    """By its points alone a view that is 3 cm off agrees: it is within three standard deviations of 8 px."""
    found = told(2, (1,), metres, confidence=confidence)
    assert found.lost[LEFT].all() and not found.lost[~LEFT & FINGERS].any()


@given(st.floats(0.0, 0.015))
def test_views_that_are_less_than_a_finger_apart_agree(metres):
    assert not told(2, (1,), metres).lost[FINGERS].any()


def test_fingers_that_no_view_shows_are_unseen_with_the_thumb_that_the_pose_network_has():
    hidden = np.flatnonzero(OF_LEFT)
    found = told(4, hidden=hidden)
    assert found.hidden[LEFT].all() and not found.hidden[~LEFT & FINGERS].any()
    few = told(4, hidden=hidden[8:])  # wrist and a finger and a half of five
    assert few.hidden[LEFT].all()


def test_fingers_of_a_lost_palm_are_lost():
    """The palm's own points and the forearm's are elsewhere in most views, the fingers' are not."""
    rig = Rig(tuple(RIG)[:2])
    scene = Scene(BODY, TRUTH.state(0), rig)
    palm = [k for k, name in enumerate(SEEN[0].names) if name in ("left_hand_wrist", "left_wrist", "left_index",
                                                                  "left_pinky") or name.endswith("_mcp")]  # fmt: skip
    frames = []
    for record in SEEN[:2]:
        uv = np.array(record.points[0, 0])
        uv[[k for k in palm if record.names[k].startswith("left")]] += 80.0
        frames.append(KeypointFrame(record.camera, 0.0, record.names, uv, np.ones(75), SET))
    sensor = KeypointSensor(rig, {}, 8.0, geman_mcclure(), 0.03)
    found = sensor.prepare(frames, scene).match(scene, 0.03).evidence(scene)
    assert found.lost[BODY.tree.segment("hand_l")] and found.lost[LEFT].all()
    assert not found.lost[~LEFT & FINGERS].any()
