"""One map of joint names, for characters and for recorded skeletons."""

import pytest

from kinefit.bodies import load_body
from kinefit.bodies.toml.joint_names import FINGERS, LIMBS, SIDES, conventions, find, joint_map, recorded_joints
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


@pytest.mark.parametrize(
    ("thumb", "little"),
    [
        (["mixamorig:LeftHandThumb1", "mixamorig:LeftHandThumb2"], "mixamorig:RightHandPinky3"),
        (["leftThumbMetacarpal", "leftThumbProximal", "leftThumbDistal"], "rightLittleDistal"),
        (["leftThumbProximal", "leftThumbIntermediate", "leftThumbDistal"], "rightLittleDistal"),
        (["LeftThumbProximal", "LeftThumbIntermediate", "LeftThumbDistal"], "RightLittleDistal"),
        (["thumb_01_l", "thumb_02_l", "thumb_03_l"], "pinky_03_r"),
        (["thumb.01.L", "thumb.02.L", "thumb.03.L"], "f_pinky.03.R"),
        (["DEF-thumb.01.L", "DEF-thumb.02.L", "DEF-thumb.03.L"], "DEF-f_pinky.03.R"),
        (["CC_Base_L_Thumb1", "CC_Base_L_Thumb2", "CC_Base_L_Thumb3"], "CC_Base_R_Pinky3"),
        (["Bip01 L Finger0", "Bip01 L Finger01", "Bip01 L Finger02"], "Bip01 R Finger42"),
        (["left_thumb1", "left_thumb2", "left_thumb3"], "right_pinky3"),
        (["l_carpometacarpal_1", "l_metacarpophalangeal_1"], "r_carpal_distal_interphalangeal_5"),
        (["thumb_metacarpal_l", "thumb_proximal_l", "thumb_distal_l"], "little_distal_r"),
    ],
)
def test_fingers_are_known_whatever_names_the_limbs_bear(thumb, little):
    names = [*thumb, little, *BY_NAME["SMPL"].joints.values()]
    found = joint_map(names)
    of_thumb = [f"thumb_{bone}_l" for bone in ("metacarpal", "proximal", "distal")[: len(thumb)]]
    fingers = {segment: names[index] for segment, index in found.items() if segment in FINGERS}
    assert fingers == dict(zip((*of_thumb, "little_distal_r"), (*thumb, little)))
    told = joint_map([*names, "spare"], {"ring_middle_r": "spare"})
    assert told["ring_middle_r"] == len(names) and len(told) == len(found) + 1


def test_a_table_goes_before_the_names_and_is_checked():
    names = list(BY_NAME["Mixamo"].joints.values())
    assert joint_map([*names, "spare"], {"head": "spare"})["head"] == len(names)
    with pytest.raises(BodyError, match="no joint 'nose'"):
        joint_map(names, {"head": "nose"})
    with pytest.raises(BodyError, match="assigned to two segments"):
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
