"""A motion on other characters; GLB is read and played by nothing but json, struct and numpy."""

import json
import struct

import numpy as np
import pytest
from click.testing import CliRunner
from tests.exporters.skeletons.character_file import PARENTS, SOLE, rest, write_character_bvh, write_character_glb

from kinefit.bodies import load_body
from kinefit.cli import main
from kinefit.errors import BodyError, ExportError, FileError
from kinefit.exporters import write_character, write_motion
from kinefit.geometry import se3
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.readers.skeletons.characters import read_character
from kinefit.simulation import cut, retarget, squat_and_wave
from kinefit.simulation.retarget import known_motion

BONES = {"thigh": "shank", "shank": "foot", "upperarm": "forearm", "forearm": "hand"}
WORDS = {"thigh": "UpLeg", "shank": "Leg", "foot": "Foot", "upperarm": "Arm", "forearm": "ForeArm", "hand": "Hand"}
SIDES = {"l": "Left", "r": "Right"}


def chunks(path):
    data = path.read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def array(told, binary, number):
    accessor = told["accessors"][number]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
    kind = {5126: "<f4", 5123: "<u2", 5121: "u1"}[accessor["componentType"]]
    start = told["bufferViews"][accessor["bufferView"]]["byteOffset"]
    return np.frombuffer(binary, kind, accessor["count"] * width, start).reshape(-1, width).astype(float)


def play(path, frame=None):
    """World matrices by name, and skinned vertices, of a frame of the first animation; without one at rest."""
    told, binary = chunks(path)
    nodes = json.loads(json.dumps(told["nodes"]))
    if frame is not None:
        animation = told["animations"][0]
        for channel in animation["channels"]:
            values = array(told, binary, animation["samplers"][channel["sampler"]]["output"])
            target = nodes[channel["target"]["node"]]
            assert "matrix" not in target
            target[channel["target"]["path"]] = values[frame]
    out = {}

    def walk(number, above):
        node = nodes[number]
        x, y, z, w = node.get("rotation", (0, 0, 0, 1))
        R = se3.rotation_from_quaternion(np.array([w, x, y, z])) * np.array(node.get("scale", (1, 1, 1)))
        M = se3.transform(R, np.array(node.get("translation", (0, 0, 0))))
        out[number] = above @ (np.reshape(node["matrix"], (4, 4)).T if "matrix" in node else M)
        for child in node.get("children", []):
            walk(child, out[number])

    walk(0, np.eye(4))
    skin, has = told["skins"][0], told["meshes"][0]["primitives"][0]["attributes"]
    bind = array(told, binary, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    moves = np.array([out[j] for j in skin["joints"]]) @ bind
    x, which = array(told, binary, has["POSITION"]), array(told, binary, has["JOINTS_0"])[:, 0].astype(int)
    skinned = se3.apply(moves[which], x)
    return {node["name"].split(":")[-1]: out[n] for n, node in enumerate(nodes)}, skinned


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def motion():
    return cut(squat_and_wave(), 0, 40)


@pytest.fixture(scope="module", params=[0.0, 0.8], ids=["T", "A"])
def written(request, motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("glb")
    write_character_glb(folder / "c.glb", arms=request.param, longer=1.2)
    write_character(motion, folder / "c.glb", folder / "o.glb")
    return folder, request.param


def test_bones_point_where_the_bodys_do_and_thumbs_too(written, motion):
    folder, _ = written
    poses, tree = motion.turned("y").segment_poses(), motion.body.tree
    still, _ = play(folder / "c.glb")
    for frame in (0, 17, 39):
        nodes, _ = play(folder / "o.glb", frame)
        for bone, far in BONES.items():
            for side, word in SIDES.items():
                mine = nodes[f"{word}{WORDS[far]}"][:3, 3] - nodes[f"{word}{WORDS[bone]}"][:3, 3]
                own = poses[frame, tree.segment(f"{far}_{side}"), :3, 3]
                own = own - poses[frame, tree.segment(f"{bone}_{side}"), :3, 3]
                assert np.linalg.norm(unit(mine) - unit(own)) < 1e-5, (bone, side)
        for side, word in SIDES.items():  # at rest the thumbs are in front, as they are in T and A
            turn = nodes[f"{word}Hand"][:3, :3] @ np.linalg.inv(still[f"{word}Hand"][:3, :3])
            thumb = poses[frame, tree.segment(f"hand_{side}"), :3, 2] * (1 if side == "r" else -1)
            assert np.linalg.norm(turn @ [0, 0, 1] - thumb) < 1e-5
        trunk = nodes["Spine2"][:3, :3] @ np.linalg.inv(still["Spine2"][:3, :3])
        assert np.linalg.norm(trunk @ [0, 1, 0] - poses[frame, tree.segment("thorax"), :3, 1]) < 1e-5
        assert np.linalg.norm(trunk @ [0, 0, 1] - poses[frame, tree.segment("thorax"), :3, 0]) < 1e-5


def test_lengths_are_the_characters_and_feet_stay_on_the_ground(written, motion):
    folder, arms = written
    places, lowest, feet = rest(arms, 1.2), [], []
    for frame in range(0, 40, 3):
        nodes, skinned = play(folder / "o.glb", frame)
        for name, parent in PARENTS.items():
            if parent:
                length = np.linalg.norm(nodes[name][:3, 3] - nodes[parent][:3, 3])
                assert length == pytest.approx(np.linalg.norm(places[name] - places[parent]), abs=1e-5)
        lowest.append(skinned[:, 1].min())
        feet.append(nodes["LeftFoot"][:3, 3])
    points = motion.body.landmarks
    parts = [motion.body.tree.segment(f"{name}_{side}") for name in ("foot", "toes") for side in "lr"]
    soles = points.select(tuple(n for n, s in zip(points.names, points.segments) if s in parts))
    height = motion.turned("y").positions(soles)[::3, :, 1].min(axis=1)
    np.testing.assert_allclose(lowest, height, atol=2e-4)  # who squats stays on the ground
    own = motion.turned("y").segment_poses()[::3, motion.body.tree.segment("foot_l"), :3, 3]
    slid = np.linalg.norm((np.array(feet) - feet[0]) - (own - own[0]), axis=1)  # beyond the body's own
    assert slid.max() < 0.01


def test_all_that_the_character_has_stays(written):
    folder, _ = written
    (before, old), (after, new) = chunks(folder / "c.glb"), chunks(folder / "o.glb")
    assert new.startswith(old) and len(new) == after["buffers"][0]["byteLength"]
    for key in ("meshes", "skins", "scenes", "scene", "asset", "extras"):
        assert before[key] == after[key]
    for name in ("accessors", "bufferViews"):
        assert after[name][: len(before[name])] == before[name]
    same = [a == b for a, b in zip(before["nodes"], after["nodes"])]
    assert [n["name"] for n, s in zip(after["nodes"], same) if not s] == ["mixamorig:Spine"]  # told as a matrix
    assert np.abs(play(folder / "c.glb")[1] - play(folder / "o.glb")[1]).max() < 1e-6
    for channel in after["animations"][0]["samplers"]:
        clock = after["accessors"][channel["input"]]
        assert clock["min"] == [0.0] and clock["count"] == after["accessors"][channel["output"]]["count"] == 40
    spine = [play(folder / "o.glb", 20)[0][name][:3, :3] for name in ("Spine", "Spine1", "Spine2")]
    still = [play(folder / "c.glb")[0][name][:3, :3] for name in ("Spine", "Spine1", "Spine2")]
    low, middle, high = (a @ np.linalg.inv(b) for a, b in zip(spine, still))
    np.testing.assert_allclose(middle @ np.linalg.inv(low), high @ np.linalg.inv(middle), atol=1e-6)  # shared evenly


@pytest.mark.parametrize("order", ["ZXY", "XYZ", "YZX"])
def test_bvh_takes_the_motion_and_gives_it_back(order, motion, tmp_path):
    write_character_bvh(tmp_path / "c.bvh", arms=0.5, order=order, prefix="mixamorig:")
    write_character(motion, tmp_path / "c.bvh", tmp_path / "o.bvh")
    before, after = ((tmp_path / name).read_text().partition("MOTION")[0] for name in ("c.bvh", "o.bvh"))
    assert before == after
    skeleton = rename_ends(read_bvh(tmp_path / "o.bvh"))
    poses, tree = motion.turned("y").segment_poses(), motion.body.tree
    for bone, far in BONES.items():
        for side, word in SIDES.items():
            ends = [skeleton.positions[:, skeleton.names.index(f"{word}{WORDS[b]}")] for b in (bone, far)]
            own = [poses[:, tree.segment(f"{b}_{side}"), :3, 3] for b in (bone, far)]
            assert np.abs(unit(ends[1] - ends[0]) - unit(own[1] - own[0])).max() < 1e-5
    if order == "ZXY":
        found = retarget(skeleton)
        assert len(found) == 40 and found.rate == pytest.approx(motion.rate)
        for name in ("knee_angle_r", "hip_flexion_l", "elbow_flex_r"):
            d = tree.coordinate(name)
            assert np.degrees(np.abs(found.angles[:, d] - motion.angles[:, d])).max() < 3, name


def rename_ends(skeleton):
    """End sites under Mixamo's names for them."""
    from dataclasses import replace

    ends = {"Head_end": "HeadTop_End", "LeftToeBase_end": "LeftToe_End", "RightToeBase_end": "RightToe_End",
            "LeftHand_end": "LeftHandMiddle1", "RightHand_end": "RightHandMiddle1"}  # fmt: skip
    plain = [name.split(":")[-1] for name in skeleton.names]
    return replace(skeleton, names=tuple(ends.get(name, name) for name in plain))


def test_lacking_joints_are_named_and_a_table_helps(motion, tmp_path):
    file, table = tmp_path / "c.glb", tmp_path / "names.toml"
    write_character_glb(file, leave_out=("LeftHandMiddle1", "LeftHand", "RightToe_End"))
    with pytest.raises(BodyError, match=r"no joint for hand_l \('LeftHand' in Mixamo\)"):
        write_character(motion, file, tmp_path / "o.glb")
    write_character_glb(file, prefix="joint of ")
    with pytest.raises(BodyError, match="no joint for pelvis"):
        write_character(motion, file, tmp_path / "o.glb")
    lines = {f"{bone}_{side}": f"{word}{name}" for bone, name in WORDS.items() for side, word in SIDES.items()}
    lines |= {"pelvis": "Hips", "head": "Head"}
    table.write_text("\n".join(f'{segment} = "joint of {name}"' for segment, name in lines.items()))
    write_motion(motion, tmp_path / "m.npz")
    options = ["export", "m.npz", "--retarget", "c.glb", "--names-table", "names.toml"]
    told = run(tmp_path, options)
    assert told.exit_code == 0, told.output
    assert "40 frames on 15 joints of c.glb" in told.stdout  # and the thorax, which carries arms and head
    assert play(tmp_path / "m-c.glb", 5)[1].shape == (8 * len(PARENTS), 3)
    other = str.maketrans({"l": "r", "r": "l"})
    lines["toes_l"] = "LeftToeBase"
    lines = {s[:-1] + s[-1].translate(other) if s[-2] == "_" else s: n for s, n in lines.items()}
    table.write_text("\n".join(f'{segment} = "joint of {name}"' for segment, name in lines.items()))
    assert "left and right are swapped" in run(tmp_path, options).stderr
    table.write_text('fin = "x"')
    assert "no segment 'fin'" in run(tmp_path, options).stderr


def run(folder, words):
    words = [str(folder / word) if word.partition(".")[2] in ("npz", "glb", "toml", "bvh") else word for word in words]
    return CliRunner().invoke(main, words)


def test_vrm_files_tell_their_joints(motion, tmp_path):
    write_character_glb(tmp_path / "c.glb", prefix="bone ")
    told, binary = chunks(tmp_path / "c.glb")
    number = {node["name"].removeprefix("bone "): n for n, node in enumerate(told["nodes"])}
    bones = {"hips": "Hips", "head": "Head", "spine": "Spine"}
    for side, word in (("left", "Left"), ("right", "Right")):
        for bone, name in {"UpperLeg": "UpLeg", "LowerLeg": "Leg", "Foot": "Foot", "UpperArm": "Arm",
                           "LowerArm": "ForeArm", "Hand": "Hand"}.items():  # fmt: skip
            bones[side + bone] = word + name
    told["extensions"] = {"VRMC_vrm": {"humanoid": {"humanBones": {b: {"node": number[n]} for b, n in bones.items()}}}}
    told["buffers"][0]["uri"] = "c.bin"  # and as glTF of two files
    (tmp_path / "c.gltf").write_text(json.dumps(told))
    (tmp_path / "c.bin").write_bytes(binary)
    found = write_character(motion, tmp_path / "c.gltf", tmp_path / "o.vrm")
    assert {found.segments[number[name]] for name in ("LeftArm", "Spine2")} == {"upperarm_l", "thorax"}
    assert chunks(tmp_path / "o.vrm")[1].startswith(binary)
    for wrong in (len(number), -1):
        told["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]["head"]["node"] = wrong
        (tmp_path / "c.gltf").write_text(json.dumps(told))
        with pytest.raises(FileError, match="names a node for head that the file does not have"):
            read_character(tmp_path / "c.gltf")


def test_soles_are_those_of_the_mesh(tmp_path):
    write_character_glb(tmp_path / "c.glb")
    character = read_character(tmp_path / "c.glb")
    assert character.points[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    assert character.positions[:, 1][character.joints].min() == pytest.approx(SOLE, abs=1e-6)


def test_what_cannot_be_is_refused(motion, tmp_path):
    write_character_glb(tmp_path / "c.glb")
    whole = (tmp_path / "c.glb").read_bytes()
    for name, content in (("half.glb", whole[: len(whole) // 2]), ("no.glb", b"glTF"), ("text.gltf", b"{}")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileError, match="no whole glTF file"):
            read_character(tmp_path / name)
    with pytest.raises(FileError, match="FBX becomes GLB"):
        read_character(tmp_path / "c.fbx")
    with pytest.raises(ExportError, match="written as GLB"):
        write_character(motion, tmp_path / "c.glb", tmp_path / "o.bvh")
    body = load_body("arm")
    arm = known_motion(body, 30.0, np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, len(body.tree.coordinates))))
    with pytest.raises(BodyError, match="has no pelvis, thigh_l"):
        write_character(arm, tmp_path / "c.glb", tmp_path / "o.glb")
    write_motion(motion, tmp_path / "m.npz")
    for words, problem in (
        (["--to", "glb", "--retarget", "c.glb"], "--to does not apply with --retarget"),
        (["--retarget", "c.glb", "--rest", "t"], "--rest does not apply with --retarget"),
        (["--to", "glb", "--names-table", "n.toml"], "needs --retarget CHARACTER"), ([], "Missing option '--to'"),
    ):  # fmt: skip
        told = run(tmp_path, ["export", "m.npz", *words])
        assert told.exit_code == 2 and problem in told.stderr
