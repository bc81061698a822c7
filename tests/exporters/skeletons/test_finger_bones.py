"""Tracked fingers on other characters: GLB is read and played by nothing but json, struct and numpy."""

import json

import numpy as np
import pytest
from tests.exporters.skeletons.character_file import fingers, write_character_glb
from tests.exporters.skeletons.test_characters import chunks, play, run, unit

from kinefit.bodies import load_body
from kinefit.bodies.toml.joint_names import DIGITS
from kinefit.exporters import write_bvh, write_character, write_motion
from kinefit.exporters.skeletons.retarget import in_words
from kinefit.geometry import se3
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.simulation import squat_and_wave
from kinefit.simulation.retarget import known_motion

WORDS = {"thumb": "Thumb", "index": "Index", "middle": "Middle", "ring": "Ring", "little": "Pinky"}
SIDES = {"l": "Left", "r": "Right"}
RESTS = {
    "straight": {}, "bent and spread": {"bend": 0.3, "spread": 0.25, "thumb": 1.2}, "A, thumb along": {"thumb": 0.1},
    "no tips": {"tips": False}, "fist": {"bend": 0.7, "thumb": -0.3},
}  # fmt: skip


def posed(frames=6, seed=0, **angles):
    """A motion of `humanoid_hands`: all of arms and hands at random within their limits, or of fingers as given."""
    body = load_body("humanoid_hands")
    tree, rng = body.tree, np.random.default_rng(seed)
    free = np.array([not name.startswith(("hip", "knee", "ankle", "lumbar")) for name in tree.coordinates])
    values = np.tile(tree.usual, (frames, 1))
    values[:, free] = rng.uniform(tree.lower, tree.upper, values.shape)[:, free]
    for end, value in angles.items():
        for side in "lr":
            if end.endswith(("_l", "_r")) and not end.endswith(side):
                continue
            ending = end if end.endswith(("_l", "_r")) else f"{end}_{side}"
            for d in [d for d, name in enumerate(tree.coordinates) if name.endswith(ending)]:
                values[:, d] = np.radians(value)
    roots = np.tile(se3.transform(np.eye(3), np.array([0.0, 0.95, 0.0])), (frames, 1, 1))
    return known_motion(body, 30.0, roots, values)


def degrees(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


@pytest.fixture(scope="module")
def motion():
    return posed()


@pytest.mark.parametrize("rest", RESTS)
def test_fingers_point_where_the_bodys_do_from_every_rest_pose(rest, motion, tmp_path):
    made = {**RESTS[rest], "arms": 0.7 if rest.startswith("A") else 0.0}
    write_character_glb(tmp_path / "c.glb", arms=made["arms"], more=fingers(**made))
    found = write_character(motion, tmp_path / "c.glb", tmp_path / "o.glb")
    assert found.lacking == ()
    poses, tree, tips = motion.turned("y").segment_poses(), motion.body.tree, made.get("tips", True)
    for frame in (0, 2, 5):
        nodes, _ = play(tmp_path / "o.glb", frame)
        for side, hand in SIDES.items():
            for digit, bones in DIGITS.items():
                for number, bone in enumerate(bones if tips else bones[:2], 1):
                    segment = tree.segment(f"{digit}_{bone}_{side}")
                    joints = (nodes[f"{hand}Hand{WORDS[digit]}{number + k}"][:3, 3] for k in (1, 0))
                    own = tree.offsets[segment + 1 if number < 3 else segment]  # straight at rest
                    own = poses[frame, segment, :3, :3] @ own
                    assert degrees(np.subtract(*joints), own) < 0.01, (digit, bone, side)


def test_bones_do_not_twist_about_themselves(motion, tmp_path):
    """At the tip of each finger, the axis that it bends about is the body's."""
    write_character_glb(tmp_path / "c.glb", more=fingers(bend=0.3))
    write_character(motion, tmp_path / "c.glb", tmp_path / "o.glb")
    poses, tree, (still, _) = motion.turned("y").segment_poses(), motion.body.tree, play(tmp_path / "c.glb")
    for frame in range(len(motion)):
        nodes, _ = play(tmp_path / "o.glb", frame)
        for side, hand in SIDES.items():
            for digit in list(WORDS)[1:]:
                name = f"{hand}Hand{WORDS[digit]}3"
                turn = nodes[name][:3, :3] @ np.linalg.inv(still[name][:3, :3])
                own = poses[frame, tree.segment(f"{digit}_distal_{side}"), :3, 2] * (1 if side == "r" else -1)
                assert degrees(turn @ [0.0, 0.0, 1.0], own) < 3  # its knuckles stand in a line of another slope


def test_a_fist_is_a_fist_and_sides_are_not_exchanged(tmp_path):
    fist = {"mcp_flex_l": 80, "pip_flex_l": 90, "dip_flex_l": 50, "mcp_flex_r": 0, "pip_flex_r": 0, "dip_flex_r": 0}
    write_character_glb(tmp_path / "c.glb", more=fingers(bend=0.2, spread=0.2))
    write_character(posed(mcp_dev=0, thumb_mcp_flex=20, **fist), tmp_path / "c.glb", tmp_path / "o.glb")
    for frame in range(6):
        nodes = {name: M[:3, 3] for name, M in play(tmp_path / "o.glb", frame)[0].items()}
        for hand, s in (("Left", 1.0), ("Right", -1.0)):
            wrist, first, last = (nodes[f"{hand}{name}"] for name in ("Hand", "HandIndex1", "HandPinky1"))
            middle = nodes[f"{hand}HandMiddle1"]
            palm = s * unit(np.cross(middle - wrist, first - last))
            for word in list(WORDS.values())[1:]:
                away = nodes[f"{hand}Hand{word}4"] - nodes[f"{hand}Hand{word}1"]
                reach = np.array([away @ unit(middle - wrist), away @ palm]) / 0.09
                if hand == "Left":  # back towards the wrist, before the palm
                    assert reach[0] < 0.0 and 0.05 < reach[1] < 0.5, (frame, word, reach)
                else:
                    assert reach[0] > 0.95 and abs(reach[1]) < 0.2, (frame, word, reach)


def test_a_character_gets_the_fingers_that_it_has(motion, tmp_path):
    write_motion(motion, tmp_path / "m.npz")
    few = fingers(bones=2, digits=("Thumb", "Index", "Ring"))
    for more, words in (
        (few, "both hands: thumb distal, index distal, middle, ring distal, little."),
        ({name: value for name, value in fingers().items() if "LeftHandRing" not in name}, "left hand: ring."),
        ({"LeftHandEnd": ("LeftHand", [0.79, 1.5, 0])}, "both hands: all fingers."),
    ):
        gone = {f"{side}HandMiddle1" for side in SIDES.values()} - set(more)
        write_character_glb(tmp_path / "c.glb", more=more, leave_out=gone)
        told = run(tmp_path, ["export", "m.npz", "--retarget", "c.glb"])
        assert told.exit_code == 0 and f"no bones for moving fingers of the motion. {words}\n" in told.stderr
        if more is few:
            nodes, poses = play(tmp_path / "m-c.glb", 3)[0], motion.turned("y").segment_poses()
            for bone, name in enumerate(("index_middle_l", "ring_middle_l", "thumb_proximal_r")):
                digit = ("LeftHandIndex", "LeftHandRing", "RightHandThumb")[bone]
                along = nodes[f"{digit}_End"][:3, 3] - nodes[f"{digit}2"][:3, 3]
                s = motion.body.tree.segment(name)
                assert degrees(along, poses[3, s, :3, :3] @ motion.body.tree.offsets[s + 1]) < 0.01, name
    assert in_words(()) == ""


def test_without_tracked_fingers_they_rest(tmp_path):
    write_character_glb(tmp_path / "c.glb", more=fingers(bend=0.3, spread=0.2))
    found = write_character(squat_and_wave(), tmp_path / "c.glb", tmp_path / "o.glb")
    moving = {name.removeprefix("mixamorig:") for name, moves in zip(found.character.names, found.moving) if moves}
    assert found.lacking == () and "LeftHand" in moving and not moving & set(fingers())
    (still, _), (moved, _) = play(tmp_path / "c.glb"), play(tmp_path / "o.glb", 20)
    for name in fingers():
        hand = name[: name.index("Hand") + 4]
        np.testing.assert_allclose(
            np.linalg.inv(moved[hand]) @ moved[name], np.linalg.inv(still[hand]) @ still[name], atol=1e-4
        )


def test_fingers_on_the_other_hand_are_not_taken(motion, tmp_path):
    """A bone that bears a finger's name, but does not hang on that hand, rests."""
    other = {name: name.replace("Left", "*").replace("Right", "Left").replace("*", "Right") for name in fingers()}
    more = {other[name]: (other.get(parent, parent), place) for name, (parent, place) in fingers().items()}
    write_character_glb(tmp_path / "c.glb", more=more)
    assert len(write_character(motion, tmp_path / "c.glb", tmp_path / "o.glb").lacking) == 30


@pytest.mark.parametrize("names", ["mixamo", "hanim", "kinefit"])
def test_the_bodys_own_skeleton_takes_its_fingers_back(names, motion, tmp_path):
    write_bvh(motion, tmp_path / "c.bvh", names=names, unit="m")
    assert write_character(motion, tmp_path / "c.bvh", tmp_path / "o.bvh").lacking == ()
    before, after = read_bvh(tmp_path / "c.bvh"), read_bvh(tmp_path / "o.bvh")
    for side in "lr":
        hand = motion.body.tree.segment(f"hand_{side}")
        below = np.arange(hand, hand + 16)  # the hand and its fifteen bones
        joints = [before.names.index(motion.body.alias(names, motion.body.tree.segments[s])) for s in below]
        moved = [one.positions[:, joints] - one.positions[:, joints[:1]] for one in (before, after)]
        np.testing.assert_allclose(*moved, atol=1e-5)


@pytest.mark.parametrize("version", ["VRMC_vrm", "VRM"])
def test_vrm_files_tell_their_fingers(version, motion, tmp_path):
    """The thumb's proximal bone is its first in VRM 0, its second in VRM 1."""
    write_character_glb(tmp_path / "c.glb", prefix="bone ", more=fingers())
    told, binary = chunks(tmp_path / "c.glb")
    number = {node["name"].removeprefix("bone "): n for n, node in enumerate(told["nodes"])}
    bones = {"hips": "Hips", "head": "Head", "spine": "Spine"}
    thumb = ("Metacarpal", "Proximal", "Distal") if version == "VRMC_vrm" else ("Proximal", "Intermediate", "Distal")
    for side, word in (("left", "Left"), ("right", "Right")):
        for bone, name in {"UpperLeg": "UpLeg", "LowerLeg": "Leg", "Foot": "Foot", "UpperArm": "Arm",
                           "LowerArm": "ForeArm", "Hand": "Hand"}.items():  # fmt: skip
            bones[side + bone] = word + name
        for k in range(3):
            bones[f"{side}Thumb{thumb[k]}"] = f"{word}HandThumb{k + 1}"
            bones[f"{side}Little{('Proximal', 'Intermediate', 'Distal')[k]}"] = f"{word}HandPinky{k + 1}"
    human = {b: {"node": number[n]} for b, n in bones.items()}
    if version == "VRM":
        human = [{"bone": name, **node} for name, node in human.items()]
    told["extensions"] = {version: {"humanoid": {"humanBones": human}}}
    told["buffers"][0]["uri"] = "c.bin"
    (tmp_path / "c.gltf").write_text(json.dumps(told))
    (tmp_path / "c.bin").write_bytes(binary)
    found = write_character(motion, tmp_path / "c.gltf", tmp_path / "o.vrm")
    segments = {name: found.segments.get(number[name]) for name in fingers()}
    assert [segments[f"LeftHandThumb{k}"] for k in (1, 2, 3)] == [f"thumb_{bone}_l" for bone in DIGITS["thumb"]]
    assert [segments[f"RightHandPinky{k}"] for k in (1, 2, 3)] == [f"little_{bone}_r" for bone in DIGITS["little"]]
    assert in_words(found.lacking) == "both hands: index, middle, ring"
