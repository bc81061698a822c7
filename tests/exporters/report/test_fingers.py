"""What the report says of fingers: in words, by digit, a hand's together."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.motion import Residuals
from kinefit.exporters.report.angles import by_joint, ranges_of
from kinefit.exporters.report.moments import doubtful_moments, plain, throughout_sentence
from kinefit.exporters.tables import curves, spoken
from kinefit.geometry import se3
from kinefit.simulation import known_motion

F = 60
DIGITS = ["Thumb", "Index finger", "Middle finger", "Ring finger", "Little finger"]


@pytest.fixture(scope="module")
def motion():
    """Of a person at rest whom one camera sees, with error bars of 5 mm."""
    body = load_body("humanoid_hands")
    roots = np.tile(se3.transform(np.eye(3), np.array([0.0, 0.95, 0.0])), (F, 1, 1))
    known = known_motion(body, 30.0, roots, np.tile(body.tree.usual, (F, 1)))
    points = body.keypoints("MEDIAPIPE_75")
    values = np.zeros((F, len(points), 2))
    seen = Residuals(points.names, points.segments, values, np.ones(values.shape[:2]), "px", values, np.zeros(F, bool))
    return replace(
        known, residuals={"cam": seen}, joint_std=np.full_like(known.joint_std, 0.005),
        dof_std=np.full_like(known.dof_std, 0.01),
    )  # fmt: skip


def unsure(motion, **frames):
    """The motion with segments whose error bars are 10 cm from a frame on."""
    std = np.array(motion.joint_std)
    for name, first in frames.items():
        std[first:, motion.body.tree.segment(name)] = 0.1
    return replace(motion, joint_std=std)


def test_angles_stand_by_digit_in_the_bodys_order(motion):
    joints = by_joint(curves(motion))
    assert list(joints)[-6:] == ["Wrist", *DIGITS]
    flexions = ["index_mcp_flex", "index_mcp_dev", "index_pip_flex", "index_dip_flex"]
    assert list(joints["Index finger"]) == flexions and len(joints["Thumb"]) == 5
    assert [name for name in ranges_of(motion) if name.startswith("index")] == flexions
    assert spoken("index_mcp_dev_l") == "left index MCP ulnar deviation"
    assert spoken("hip_flexion_r") == "right hip flexion"


def test_a_hand_that_is_lost_finger_by_finger_is_one_moment(motion):
    lost = {"index_middle_l": 40, "middle_middle_l": 50, "ring_distal_l": 57}
    (moment,) = doubtful_moments(unsure(motion, **lost))
    assert (moment.start, moment.stop) == (40, F) and set(lost) <= set(moment.segments)
    assert moment.what == ("The position of fingers of the left hand is uncertain: up to ±35 cm (2 σ).",)
    assert len(doubtful_moments(unsure(motion, index_distal_l=40, index_distal_r=57))) == 2


def test_fingers_that_are_uncertain_throughout_are_told_together(motion):
    told = throughout_sentence(unsure(motion, index_distal_l=5, ring_distal_l=5, thumb_distal_r=5))
    assert told == "fingers of the right hand (±35\u00a0cm) and fingers of the left hand (±35\u00a0cm)"
    assert plain("middle_proximal_r") == "right middle finger (proximal)" and plain("hand_l") == "left hand"
