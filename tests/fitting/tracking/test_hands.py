"""Hands with fingers, tracked in keypoints of hands."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.hands_simulated import fingers, hands_moving, near_rig, seen_by, somebody

from kinefit import Recording, load_body, track
from kinefit.simulation import simulate_keypoints
from kinefit.simulation.evaluation import angle_errors, joint_errors

TRUTH = somebody(hands_moving(0, seconds=1.5), 0)
RIG = near_rig(TRUTH)
SEEN = seen_by(TRUTH, RIG, 0)
HIDDEN = slice(-20, None)  # frames in which no camera sees the left hand


@pytest.fixture(scope="module")
def motion():
    return track(Recording.of_keypoints(RIG, SEEN, up="y"), load_body("humanoid_hands"))


def test_fingers_are_found(motion):
    segments, coordinates = fingers(TRUTH.body)
    right = np.array([c.endswith("_r") for c in TRUTH.body.tree.coordinates])
    assert 1000 * joint_errors(TRUTH, motion)[: HIDDEN.start][:, segments].mean() < 4.0
    assert np.abs(angle_errors(TRUTH, motion))[:, coordinates & right].mean() < 6.0


def test_a_wrong_finger_is_called_lost_or_uncertain(motion):
    segments, _ = fingers(TRUTH.body)
    left = np.array([s.endswith("_l") for s in TRUTH.body.tree.segments])
    shown = np.array([s.startswith(("thumb_m", "thumb_p")) for s in TRUTH.body.tree.segments])  # by the pose network
    error = joint_errors(TRUTH, motion)
    said = motion.lost | (error <= 3.0 * np.linalg.norm(motion.joint_std, axis=-1))
    assert np.all(said[:, segments] | (error[:, segments] < 0.02))
    assert motion.lost[-1, segments & left & ~shown].all() and not motion.lost[:, segments & ~left].any()


@pytest.mark.parametrize("smooth", [False, True])
def test_a_hand_that_half_of_the_views_show_elsewhere_is_lost(smooth):
    """As where cameras' clocks are off and the hand is fast; frame by frame the error bars widen, too."""
    apart, short = slice(6, 12), next(TRUTH.parts(15))
    seen = simulate_keypoints(short, RIG, "MEDIAPIPE_75", noise_px=2.0, outliers=0.0, missing=0.0, seed=0)
    for c, shift in ((0, -60.0), (2, 60.0)):
        points = np.array(seen[c].points)
        points[apart, :, 33:54] += (0.0, shift)
        seen[c] = replace(seen[c], points=points)
    found = track(Recording.of_keypoints(RIG, seen, up="y"), TRUTH.body, smooth=smooth)
    segments, _ = fingers(TRUTH.body)
    left = segments & np.array([s.endswith("_l") for s in TRUTH.body.tree.segments])
    assert found.lost[apart][:, left].all() and not found.lost[: apart.start, segments].any()
    assert not found.lost[:, segments & ~left].any()
    std = np.median(np.linalg.norm(found.joint_std[:, left], axis=-1), axis=1)
    assert smooth or np.all(std[apart] > 1.5 * std[: apart.start].max())


def test_a_body_without_fingers_takes_the_same_keypoints():
    short = [record.rows(slice(0, 12), 0.0) for record in SEEN]
    plain = track(Recording.of_keypoints(RIG, short, up="y"), load_body("humanoid"))
    names = plain.body.tree.segments
    wrist = [TRUTH.body.tree.segments.index(s) for s in ("hand_l", "hand_r")]
    error = plain.joint_centres[:, [names.index("hand_l"), names.index("hand_r")]] - TRUTH.joint_centres[:12, wrist]
    assert np.linalg.norm(error, axis=-1).mean() < 0.03
