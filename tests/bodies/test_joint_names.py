"""One map of joint names, for characters and for recorded skeletons."""

import pytest

from kinefit.bodies import load_body
from kinefit.bodies.joint_names import LIMBS, SIDES, conventions, find, joint_map, recorded_joints
from kinefit.errors import BodyError, ObservationError

BY_NAME = {family.name: family for family in conventions()}


@pytest.mark.parametrize("name", list(BY_NAME))
def test_a_character_of_every_family_is_understood(name):
    joints = BY_NAME[name].joints
    found = joint_map([*joints.values(), "tail"])
    assert {segment: index for segment, index in found.items() if segment in joints} == {
        segment: k for k, segment in enumerate(joints)
    }


@pytest.mark.parametrize("prefix", ["mixamorig:", "mixamorig7:", "Armature|", "mixamorig_", "x:"])
def test_prefixes_capitals_and_separators_do_not_matter(prefix):
    assert find(["Hips", f"{prefix}LeftArm"], "left_arm") == 1
    assert find(["Bip01 L Thigh"], "L Thigh") == 0 and find(["LeftForeArm"], "LeftArm") is None


@pytest.mark.parametrize("family", conventions(), ids=lambda family: family.name)
def test_a_recorded_skeleton_of_every_family_is_recognised(family):
    names = list(dict.fromkeys(family.recorded.values()))
    found = recorded_joints(names)
    assert {role: names[index] for role, index in found.joints.items()} == {
        role: names[find(names, name)] for role, name in BY_NAME[found.family].recorded.items()
    }
    assert found.family == family.name


def test_a_table_goes_before_the_names_and_is_checked():
    names = list(BY_NAME["Mixamo"].joints.values())
    assert joint_map([*names, "spare"], {"head": "spare"})["head"] == len(names)
    with pytest.raises(BodyError, match="no joint 'nose'"):
        joint_map(names, {"head": "nose"})
    with pytest.raises(BodyError, match="named for two segments"):
        joint_map(names, {"head": "Hips"})
    with pytest.raises(BodyError, match=r"no joint for foot_r \('RightFoot' in Mixamo\)"):
        joint_map([name for name in names if name != "RightFoot"])


def test_a_table_alone_tells_a_recorded_skeleton():
    table = {f"{limb}_{side}": f"q{limb}{side}" for limb in LIMBS for side in SIDES}
    table |= {"pelvis": "a", "abdomen": "b", "thorax": "c", "neck": "d", "head": "e", "head_top": "f"}
    names = [*table.values(), "more"]
    found = recorded_joints(names, table)
    assert names[found.joints["sacrum"]] == "b" and names[found.joints["spine"]] == "c"
    assert names[found.joints["head_top"]] == "f" and names[found.joints["hand_l"]] == "qhandl"
    with pytest.raises(ObservationError, match=r"it lacks: no name \(neck\), zz \(toes_r\)"):
        recorded_joints(names, {key: value for key, value in table.items() if key != "neck"} | {"toes_r": "zz"})


def test_names_under_which_motions_are_exported_are_among_them():
    assert set(load_body("humanoid").aliases) | {"kinefit"} <= set(BY_NAME)
