"""The humanoid with fingers."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.limbs import finger_groups, knuckles, limbs
from kinefit.exporters.report.moments import spoken_segments

BODY = load_body("humanoid_hands")
TREE = BODY.tree
FINGERS = ("thumb", "index", "middle", "ring", "little")


def points(names, **degrees):
    """Points of the right hand in the hand's frame, at angles of its fingers."""
    angles = np.zeros(len(TREE.coordinates))
    for name, value in degrees.items():
        angles[TREE.coordinate(f"{name}_r")] = np.radians(value)
    state = BodyState(np.eye(4), angles)
    at = BODY.tree.segment_poses(np.eye(4)[None], angles[None])[0, TREE.segment("hand_r")]
    return (BODY.positions(state, BODY.landmarks.select(names)) - at[:3, 3]) @ at[:3, :3]


def test_a_hand_has_21_angles_beyond_the_wrist():
    for side in "lr":
        own = [c for c in TREE.coordinates if c.startswith(FINGERS) and c.endswith(side)]
        assert len(own) == 21
    assert len(TREE.coordinates) == len(load_body("humanoid").tree.coordinates) + 42


def test_fingers_flex_to_the_palm_and_deviate_to_the_little_finger():
    tips = ("r_carpal_distal_phalanx_2_tip", "r_dactylion", "r_carpal_distal_phalanx_5_tip")
    fist = {f"{f}_{j}_flex": 85 for f in FINGERS[1:] for j in ("mcp", "pip", "dip")}
    straight, bent = points(tips), points(tips, **fist)
    assert np.all(straight[:, 1] < -0.12) and np.all(np.abs(straight[:, 0]) < 0.02)
    assert np.all(bent[:, 1] > -0.10) and np.all(bent[:, 0] > 0.0)  # back at the palm, in front of it
    assert np.all(points(tips, index_mcp_dev=15)[0, 2] < straight[0, 2] - 0.01)  # away from the thumb


def test_the_thumb_closes_over_the_palm():
    tip = ("r_carpal_distal_phalanx_1_tip",)
    open_, closed = points(tip)[0], points(tip, thumb_cmc_flex=40, thumb_mcp_flex=50, thumb_ip_flex=70)[0]
    assert open_[2] > 0.05 and closed[2] < 0.03 and closed[0] > 0.01


def test_lengths_are_those_of_a_hand():
    assert -0.20 < points(("r_dactylion",))[0, 1] < -0.18
    longest = [abs(points((tip,))[0, 1]) for tip in (
        "r_carpal_distal_phalanx_2_tip", "r_dactylion", "r_carpal_distal_phalanx_4_tip", "r_carpal_distal_phalanx_5_tip"
    )]  # fmt: skip
    assert np.argmax(longest) == 1 and np.argmin(longest) == 3


@pytest.mark.parametrize("side", "lr")
def test_a_tip_bends_with_the_joint_before_it(side):
    """The prior mean of a DIP angle follows a known PIP angle by two thirds: a Gaussian's conditional."""
    pip, dip = (TREE.coordinate(f"ring_{j}_flex_{side}") for j in ("pip", "dip"))
    precision = TREE.posture_precision
    slope = -precision[dip, pip] / precision[dip, dip]
    assert 0.6 < slope < 0.667 and np.degrees(precision[dip, dip] ** -0.5) == pytest.approx(9.8, abs=0.2)


def test_fingers_belong_to_the_limb_of_their_arm():
    found = {tuple(TREE.segments[s] for s in limb) for limb in limbs(BODY)}
    plain = load_body("humanoid")
    expected = {tuple(plain.tree.segments[s] for s in limb) for limb in limbs(plain)}
    assert {tuple(s for s in limb if not s.startswith(FINGERS)) for limb in found} == expected
    assert sorted(map(len, found)) == [1, 4, 4, 19, 19]


def test_a_trunk_on_which_much_hangs_is_no_hand():
    plain = load_body("humanoid")
    tree, thorax = plain.tree, plain.tree.segment("thorax")
    places = np.array([thorax] * 6 + [tree.segment("head")] * 6 + [thorax])
    names = tuple(f"plate {k}" for k in range(len(places)))
    worn = replace(
        tree, segments=(*tree.segments, *names), parents=np.concatenate([tree.parents, places]),
        offsets=np.concatenate([tree.offsets, np.full((len(places), 3), 0.05)]),
    )  # fmt: skip
    scale = np.concatenate([plain.segment_scale, plain.segment_scale[places]])
    body = replace(plain, tree=worn, joints=(*plain.joints, *names), segment_scale=scale)
    found = [tuple(worn.segments[s] for s in limb) for limb in limbs(body)]
    arm = ("clavicle_r", "upperarm_r", "forearm_r", "hand_r")
    assert arm in found and list(finger_groups(body)) == ["head"]
    assert sorted(s for limb in found for s in limb) == sorted({*worn.segments} - {"pelvis", "abdomen", "thorax"})


def test_a_hand_with_fingers_ends_in_no_folded_ones():
    assert not knuckles(BODY)


def test_points_on_fingers_stand_nearer_to_their_places():
    share = dict(zip(TREE.segments, BODY.offset_shares))
    assert share["index_proximal_r"] > share["index_middle_r"] > share["index_distal_r"] > 0.3
    assert np.all(load_body("humanoid").offset_shares == 1.0)


def test_fingers_of_a_hand_are_one_group():
    groups = finger_groups(BODY)
    assert set(groups) == {"hand_l", "hand_r"} and finger_groups(load_body("humanoid")) == {}
    assert all(len(own) == 15 and all(s.startswith(FINGERS) for s in own) for own in groups.values())
    words = spoken_segments(BODY, ["ring_distal_l", "hand_l", "little_distal_l", "index_distal_r"])
    assert words == "fingers of the left hand, left hand and right index finger (distal)"
