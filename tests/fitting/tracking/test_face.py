"""Jaw and gaze, tracked in keypoints of the pose and of a face mesh of the same cameras."""

import numpy as np
import pytest
from benchmarks.hands_simulated import near_rig, somebody
from benchmarks.head_turn import ERRORS, FACE, GAZE, JAW, POSE, head_moving, with_own_face

from kinefit import Recording, load_body, track
from kinefit.simulation import simulate_keypoints
from kinefit.simulation.evaluation import angle_errors

SEED = 1
TRUTH = with_own_face(somebody(head_moving(SEED, "humanoid_face", seconds=2.5), SEED, POSE), SEED)
RIG = near_rig(TRUTH, ("sellion", "suprasternale"))


def seen(truth, *sets):
    return [k for n, name in enumerate(sets) for k in simulate_keypoints(truth, RIG, name, seed=SEED + n, **ERRORS)]


def tracked(keypoints):
    return track(Recording.of_keypoints(RIG, keypoints, up="y"), load_body("humanoid_face"))


@pytest.fixture(scope="module")
def motion():
    return tracked(seen(TRUTH, POSE, FACE))


def test_jaw_and_gaze_are_found(motion):
    tree = TRUTH.body.tree
    error = np.abs(angle_errors(TRUTH, motion))
    assert np.ptp(TRUTH.angles[:, tree.coordinate(JAW)]) > np.radians(10)
    assert error[:, tree.coordinate(JAW)].mean() < 3.0
    assert error[:, [tree.coordinate(name) for name in GAZE]].mean() < 3.0
    assert error[:, [tree.coordinate(f"neck_{name}") for name in ("rotation", "bending")]].mean() < 2.0


def test_limits_are_kept(motion):
    tree = motion.body.tree
    face = [tree.coordinate(name) for name in (JAW, *GAZE)]
    assert np.all(motion.angles[:, face] >= tree.lower[face] - np.radians(0.5))
    assert np.all(motion.angles[:, face] <= tree.upper[face] + np.radians(0.5))
    assert not motion.lost[:, [tree.segment(name) for name in ("jaw", "eye_l", "eye_r")]].any()


def test_a_closed_jaw_stays_closed_and_a_face_that_nothing_shows_is_lost():
    short = next(TRUTH.parts(30))
    tree = short.body.tree
    angles = np.array(short.angles)
    angles[:, tree.coordinate(JAW)] = 0.0
    closed = tracked(seen(replace_angles(short, angles), POSE, FACE))
    assert np.degrees(closed.angles[:, tree.coordinate(JAW)]).max() < 2.0
    alone = tracked(seen(short, POSE))
    face = [tree.segment(name) for name in ("jaw", "eye_l", "eye_r")]
    assert alone.lost[:, face].all() and not closed.lost[:, face].any()
    assert not alone.lost[:, tree.segment("head")].any()


def replace_angles(motion, angles):
    from kinefit.simulation.retarget import known_motion

    return known_motion(motion.body, motion.rate, motion.Ts_world_root, angles, name="closed")
