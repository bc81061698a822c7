"""BVH read back has its joints where the motion has them."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body, parse_body
from kinefit.errors import ExportError
from kinefit.exporters import write_bvh
from kinefit.readers.skeletons.bvh import read_bvh


@pytest.mark.parametrize(("unit", "metres"), [("cm", 0.01), ("m", 1.0), ("mm", 0.001)])
@pytest.mark.parametrize("up", ["y", "z"])
def test_joint_centres_come_back(tmp_path, unit, metres, up):
    motion = smooth_motion(40, up="z")
    write_bvh(motion, tmp_path / "a.bvh", unit=unit, up=up)
    back = read_bvh(tmp_path / "a.bvh", unit=metres, up=up)
    body = motion.body
    columns = [back.names.index(body.alias("bvh", s)) for s in body.tree.segments]
    assert {"Hips", "RightUpLeg", "LeftForeArm"} <= set(back.names)
    assert np.abs(back.positions[:, columns] - motion.turned(up).segment_poses()[..., :3, 3]).max() < 1e-6
    assert back.rate == pytest.approx(motion.rate, rel=1e-6)


def test_fingers_come_back(tmp_path):
    motion = smooth_motion(10, body=load_body("humanoid_hands"))
    write_bvh(motion, tmp_path / "a.bvh", unit="m")
    back = read_bvh(tmp_path / "a.bvh", unit=1.0)
    body = motion.body
    columns = [back.names.index(body.alias("bvh", s)) for s in body.tree.segments]
    fingers = ("Thumb", "Index", "Middle", "Ring", "Pinky")
    assert {f"RightHand{finger}{k}" for finger in fingers for k in (1, 2, 3)} <= set(back.names)
    assert np.abs(back.positions[:, columns] - motion.segment_poses()[..., :3, 3]).max() < 1e-6


def test_jaw_and_eyes_come_back(tmp_path):
    motion = smooth_motion(10, body=load_body("humanoid_face"))
    write_bvh(motion, tmp_path / "a.bvh", unit="m")
    back = read_bvh(tmp_path / "a.bvh", unit=1.0)
    for name, segment in (("Jaw", "jaw"), ("LeftEye", "eye_l"), ("RightEye", "eye_r")):
        of_file = back.Ts_world_joint[:, back.names.index(name)]
        assert np.abs(of_file - motion.segment_poses()[:, motion.body.tree.segment(segment)]).max() < 1e-6


def test_limbs_end_where_their_surfaces_end(tmp_path):
    motion = smooth_motion(3)
    write_bvh(motion, tmp_path / "a.bvh")
    back = read_bvh(tmp_path / "a.bvh", unit=0.01)
    hand = next(c for c in motion.body.surfaces if motion.body.tree.segments[c.segment] == "hand_r")
    assert back.offsets[back.names.index("RightHand_end")] == pytest.approx(np.array(hand.end), abs=1e-9)


def test_angles_do_not_jump_and_every_joint_has_its_channels(tmp_path):
    motion = smooth_motion(200, turns=3.0)
    write_bvh(motion, tmp_path / "a.bvh")
    lines = (tmp_path / "a.bvh").read_text().splitlines()
    channels = [line.split()[1:] for line in lines if "CHANNELS" in line]
    assert channels[0] == "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation".split()
    assert all(c == "3 Zrotation Xrotation Yrotation".split() for c in channels[1:])
    table = np.array([line.split() for line in lines[lines.index("MOTION") + 3 :]], float)
    assert table.shape == (200, 3 + 3 * len(motion.body.tree.segments))
    assert np.abs(np.diff(table[:, 3:6], axis=0)).max() < 30  # the root turns three times round without a jump of 360
    assert np.abs(table[-1, 3:6] - table[0, 3:6]).max() > 700


def test_a_joint_that_slides_has_its_position_in_channels(tmp_path):
    text = """
        body.name = "lift"
        [[segment]]
        name = "base"
        joint = { name = "ground", type = "free" }
        [[segment]]
        name = "car"
        parent = "base"
        joint = { name = "rail", type = "prismatic", at = [0, 1, 0], axes = ["y"], range = [[0, 2]] }
        [[segment]]
        name = "door"
        parent = "car"
        joint = { name = "hinge", type = "revolute", at = [0.5, 0, 0], axes = ["z"], range = [[0, 90]] }
    """
    motion = smooth_motion(30, body=with_sets(parse_body(text)))
    write_bvh(motion, tmp_path / "a.bvh", unit="m")
    back = read_bvh(tmp_path / "a.bvh", unit=1.0, up="y")
    columns = [back.names.index(s) for s in motion.body.tree.segments]
    assert np.abs(back.positions[:, columns] - motion.segment_poses()[..., :3, 3]).max() < 1e-6


def with_sets(body):
    """The body with the (empty) point sets that made-up residuals need."""
    none = load_body("humanoid").landmarks.select(())
    return replace(body, keypoint_sets={"BODY_25B": none}, marker_sets={"HANIM_45": none})


def test_an_unknown_unit_is_refused(tmp_path):
    with pytest.raises(ExportError, match="there are: m, cm, mm"):
        write_bvh(smooth_motion(2), tmp_path / "a.bvh", unit="inch")
    assert not list(tmp_path.iterdir())
