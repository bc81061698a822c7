"""Every format under every unit, vertical axis and convention of names, read back by programs that are not ours."""

import csv
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from pygltflib import GLTF2
from scipy.spatial.transform import Rotation
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import load_body
from kinefit.bodies.toml.joint_names import CHARACTER_BONES, segment_names
from kinefit.errors import ExportError
from kinefit.exporters import tables, write_bvh, write_c3d, write_csv, write_glb, write_trc, write_usd
from kinefit.exporters.skeletons.common import NAMES, bone_names

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
UPS = ("x", "y", "z", "-x", "-y", "-z")
CLOSE = 1e-5  # [m]


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(12, up="z", turns=0.4)


def centres(motion, up):
    """{segment: (F, 3)} [m] joint centres in a world with that vertical axis."""
    positions = motion.turned(up).segment_poses()[..., :3, 3]
    return dict(zip(motion.body.tree.segments, np.moveaxis(positions, 1, 0)))


def bvh_positions(path):
    """{joint: (F, 3)} of a BVH: offsets and channels as its definition has them."""
    text = path.read_text()
    hierarchy, _, table = text.partition("MOTION")
    rows = np.array([line.split() for line in table.strip().splitlines()[2:]], float)
    out, stack, at, pending = {}, [], 0, None
    for line in hierarchy.splitlines():
        words = line.split()
        if words[:1] in (["ROOT"], ["JOINT"], ["End"]):
            pending = " ".join(words[1:])
        elif words[:1] == ["{"]:
            stack.append([pending, None, None])
        elif words[:1] == ["OFFSET"]:
            offset = np.tile(np.array(words[1:], float), (len(rows), 1))
            above = stack[-2] if len(stack) > 1 else [None, np.zeros((len(rows), 3)), Rotation.identity(len(rows))]
            stack[-1][1:] = [above[1] + above[2].apply(offset), above[2]]
        elif words[:1] == ["CHANNELS"]:
            names, values = words[2:], rows[:, at : at + int(words[1])]
            at += int(words[1])
            name, place, turn = stack[-1]
            if names[0] == "Xposition":
                place, names, values = values[:, :3], names[3:], values[:, 3:]
            axes = "".join(n[0] for n in names)  # capitals: about the axes carried along
            stack[-1][1:] = [place, turn * Rotation.from_euler(axes, values, degrees=True)]
            out[name] = place
        elif words[:1] == ["}"]:
            stack.pop()
    assert at == rows.shape[1]
    return out


def same(found, motion, up, names, unit):
    """Whether joints read from a file stand where the motion has them."""
    for bone, (segment, truth) in zip(bone_names(motion.body, names, ""), centres(motion, up).items(), strict=True):
        assert np.abs(METRES[unit] * found[bone] - truth).max() < CLOSE, (segment, bone, up, unit)


@pytest.mark.parametrize("unit", METRES)
@pytest.mark.parametrize("up", UPS)
def test_bvh(motion, tmp_path, unit, up):
    write_bvh(motion, tmp_path / "a.bvh", unit=unit, up=up, names="mixamo")
    same(bvh_positions(tmp_path / "a.bvh"), motion, up, "mixamo", unit)


def test_bvh_by_a_second_program(motion, tmp_path):
    bvhio = pytest.importorskip("bvhio")
    write_bvh(motion, tmp_path / "a.bvh", unit="m")
    root = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    joints = [joint for joint, _, _ in root.layout()]
    truth = dict(zip(bone_names(motion.body, "bvh", ""), np.moveaxis(motion.turned("y").joint_centres, 1, 0)))
    first, last = root.getKeyframeRange()
    assert {joint.Name for joint in joints} == set(truth) and last - first + 1 == len(motion)
    for frame in range(first, last + 1):
        root.loadPose(frame)
        for joint in joints:
            assert np.linalg.norm(np.array(list(joint.PositionWorld)) - truth[joint.Name][frame - first]) < 1e-5


@pytest.mark.parametrize("names", NAMES)
def test_bvh_and_glb_under_all_names(motion, tmp_path, names):
    write_bvh(motion, tmp_path / "a.bvh", names=names)
    same(bvh_positions(tmp_path / "a.bvh"), motion, "y", names, "cm")
    write_glb(motion, tmp_path / "a.glb", names=names)
    same(glb_positions(tmp_path / "a.glb"), motion, "y", names, "m")


def glb_positions(path):
    """{node: (F, 3)} of an animated GLB: in metres and y up, whatever the options."""
    gltf = GLTF2().load(str(path))
    blob = gltf.binary_blob()

    def array(number):
        accessor, width = gltf.accessors[number], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[gltf.accessors[number].type]
        start = gltf.bufferViews[accessor.bufferView].byteOffset
        return np.frombuffer(blob, "<f4", accessor.count * width, start).reshape(-1, width)

    animation = gltf.animations[0]
    moves = {(c.target.node, c.target.path): array(animation.samplers[c.sampler].output) for c in animation.channels}
    count = len(array(animation.samplers[0].input))
    out = {}

    def walk(node, place, turn):
        fixed = np.tile(gltf.nodes[node].translation or [0.0, 0, 0], (count, 1))
        place = place + turn.apply(moves.get((node, "translation"), fixed))
        if (node, "rotation") in moves:
            turn = turn * Rotation.from_quat(moves[node, "rotation"])
        out[gltf.nodes[node].name] = place
        for child in gltf.nodes[node].children or ():
            walk(child, place, turn)

    for root in gltf.scenes[0].nodes:
        walk(root, np.zeros((count, 3)), Rotation.identity(count))
    return out


@pytest.mark.parametrize("unit", METRES)
@pytest.mark.parametrize("up", UPS)
def test_c3d(motion, tmp_path, unit, up):
    ezc3d = pytest.importorskip("ezc3d")
    write_c3d(motion, tmp_path / "a.c3d", unit=unit, up=up, names="opensim")
    read = ezc3d.c3d(str(tmp_path / "a.c3d"))
    point = {name: read["parameters"]["POINT"][name]["value"] for name in ("LABELS", "UNITS", "Y_SCREEN", "RATE")}
    found = dict(zip(point["LABELS"], np.moveaxis(read["data"]["points"][:3], (0, 2), (2, 1))))
    same(found, motion, up, "opensim", unit)
    assert (point["UNITS"], point["RATE"][0]) == ([unit], motion.rate)
    assert point["Y_SCREEN"][0].lower().lstrip("+") == up
    landmarks = np.moveaxis(motion.turned(up).positions(), 1, 0)
    for name, truth in zip(motion.body.landmarks.names, landmarks):  # no name of OpenSim's is a landmark's
        assert np.abs(METRES[unit] * found[name] - truth).max() < CLOSE, name


def test_c3d_by_a_second_program(motion, tmp_path):
    c3d = pytest.importorskip("c3d")
    write_c3d(motion, tmp_path / "a.c3d")
    with open(tmp_path / "a.c3d", "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "no analog data"
        reader = c3d.Reader(file)
        frames = np.array([points for _, points, _ in reader.read_frames()])
    count = len(motion.body.joints)
    assert [label.strip() for label in reader.point_labels[:count]] == list(motion.body.joints)
    assert np.abs(frames[:, :count, :3] / 1000 - motion.segment_poses()[..., :3, 3]).max() < CLOSE
    assert (reader.first_frame, reader.last_frame) == (121, 132)  # the motion begins at 2 s
    assert np.all(frames[..., 3] == 0)  # computed


@pytest.mark.parametrize("unit", METRES)
@pytest.mark.parametrize("up", ["y", "z"])
def test_usd(motion, tmp_path, unit, up):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdSkel

    write_usd(motion, tmp_path / f"{up}{unit}.usda", unit=unit, up=up, names="mixamo")
    stage = Usd.Stage.Open(str(tmp_path / f"{up}{unit}.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == up.upper()
    assert UsdGeom.GetStageMetersPerUnit(stage) == pytest.approx(METRES[unit])
    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Figure/Skeleton")))
    frames = [query.ComputeJointSkelTransforms(f) for f in range(len(motion))]
    at = np.array([[list(T.ExtractTranslation()) for T in poses] for poses in frames])
    joints = [path.rpartition("/")[2].replace("mixamorig_", "mixamorig:") for path in query.GetJointOrder()]
    same(dict(zip(joints, np.moveaxis(at, 1, 0))), motion, up, "mixamo", unit)


@pytest.mark.parametrize("unit", METRES)
@pytest.mark.parametrize("up", UPS)
def test_trc(motion, tmp_path, unit, up):
    write_trc(motion, tmp_path / "a.trc", unit=unit, up=up)
    lines = (tmp_path / "a.trc").read_text().splitlines()
    assert lines[2].split("\t")[4] == unit
    names = lines[3].split("\t")[2::3]
    rows = np.array([line.split("\t")[2:] for line in lines[6:]], float).reshape(len(motion), -1, 3)
    assert names == list(motion.body.landmarks.names)
    assert np.abs(METRES[unit] * rows - motion.turned(up).positions()).max() < CLOSE


@pytest.mark.parametrize("unit", METRES)
@pytest.mark.parametrize("names", NAMES)
def test_csv(motion, tmp_path, unit, names):
    write_csv(motion, tmp_path, unit=unit, up="-y", names=names)
    with open(tmp_path / "joints.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    bones = bone_names(motion.body, names, "")
    found = {b: np.array([[float(row[f"{b} {axis} [{unit}]"]) for axis in "xyz"] for row in rows]) for b in bones}
    same(found, motion, "-y", names, unit)
    assert set(bones) <= set((tmp_path / "quality.csv").read_text().splitlines()[0].split(","))


def test_tables_scale_every_length_and_nothing_else(motion):
    metres, millimetres = tables(motion), tables(motion, unit="mm")
    for name, table in metres.items():
        for (column, values), (other, scaled) in zip(table.items(), millimetres[name].items(), strict=True):
            if values.dtype.kind != "f":
                continue
            if name == "residuals":
                lengths = (table["unit"] == "m") & (column.startswith(("measured", "residual")))
                factor = np.where(lengths, 1000.0, 1.0)
            else:
                factor = 1000.0 if column.endswith("[m]") else 1.0
                assert other == column.replace("[m]", "[mm]")
            np.testing.assert_allclose(scaled, factor * values, rtol=1e-12)


@pytest.mark.parametrize("name", ["humanoid", "humanoid10", "arm"])
@pytest.mark.parametrize("names", NAMES)
def test_every_segment_of_the_catalogue_has_a_name_of_its_own(name, names):
    body = load_body(name)
    found = bone_names(body, names, "")
    assert len(set(found)) == len(body.tree.segments)
    assert names == "kinefit" or set(segment_names(body, names)) == set(body.tree.segments)


def test_sides_are_kept_in_every_convention():
    body = load_body("humanoid")
    for names in NAMES:
        bones = dict(zip(body.tree.segments, bone_names(body, names, "")))
        for segment, bone in bones.items():
            if segment.endswith("_r"):
                left = bones[segment[:-2] + "_l"]
                sides = (("Right", "Left"), ("^right", "left"), ("_r$", "_l"), ("^r", "l"))
                assert left in {re.sub(right, other, bone) for right, other in sides}


def test_names_that_programs_look_for():
    body = load_body("humanoid")
    bones = {names: bone_names(body, names, "") for names in NAMES}
    assert {"mixamorig:Hips", "mixamorig:LeftForeArm", "mixamorig:RightToeBase"} <= set(bones["mixamo"])
    assert {"root", "lowerback", "lfemur", "rhumerus", "lclavicle"} <= set(bones["cmu"])
    assert {"pelvis", "torso", "femur_l", "calcn_r"} <= set(bones["opensim"])
    assert {"humanoid_root", "l_hip", "r_talocrural", "vl5"} <= set(bones["hanim"])
    assert {"hips", "spine", "chest", "head", "leftUpperLeg", "rightToes", "leftLowerArm"} <= set(bones["vrm"])
    assert {"Hips", "Spine", "Chest", "Head", "LeftUpperLeg", "RightToes", "LeftLowerArm"} <= set(bones["unity"])
    assert {"pelvis", "spine_01", "spine_03", "thigh_l", "calf_r", "ball_l", "lowerarm_r"} <= set(bones["unreal"])


def test_fingers_and_the_face_have_the_bones_of_characters():
    """The thumb's metacarpal is "proximal" in Unity, whose HumanBodyBones has no such bone."""
    body = load_body("humanoid_hands")
    thumbs = {
        names: [segment_names(body, names)[f"thumb_{bone}_l"] for bone in ("metacarpal", "proximal", "distal")]
        for names in CHARACTER_BONES
    }
    assert thumbs == {
        "vrm": ["leftThumbMetacarpal", "leftThumbProximal", "leftThumbDistal"],
        "unity": ["LeftThumbProximal", "LeftThumbIntermediate", "LeftThumbDistal"],
        "unreal": ["thumb_01_l", "thumb_02_l", "thumb_03_l"],
    }
    face = load_body("humanoid_face")
    assert segment_names(face, "vrm")["jaw"] == "jaw" and segment_names(face, "unity")["eye_r"] == "RightEye"


def test_bones_of_characters_follow_from_the_names_for_bvh_and_a_body_may_state_its_own(motion):
    """A motion file of an older version, or a body of one's own, has no names of game engines."""
    renamed = replace(motion.body, aliases={"bvh": {"shank_l": "LeftLeg", "foot_l": "own"}, "unreal": {"foot_l": "f"}})
    assert segment_names(renamed, "unreal")["shank_l"] == "calf_l" and segment_names(renamed, "unreal")["foot_l"] == "f"
    assert segment_names(load_body("humanoid10"), "unreal")["torso"] == "pelvis"


@pytest.mark.parametrize(
    ("write", "options", "problem"),
    [
        (write_bvh, {"unit": "inch"}, "unit of length 'inch'; there are: m, cm, mm"),
        (write_bvh, {"up": "w"}, "'w'; there are: x, y, z, -x, -y, -z"),
        (write_glb, {"names": "maya"}, "names 'maya'; there are: kinefit, bvh, mixamo, cmu, opensim, hanim"),
        (write_c3d, {"up": "up"}, "'up'; there are: x"),
        (write_usd, {"up": "x"}, "'x'; there are: y, z"),
        (write_usd, {"unit": "km"}, "'km'; there are: m, cm, mm"),
        (write_trc, {"up": "q"}, "'q'; there are: x"),
        (write_csv, {"names": "biped"}, "'biped'; there are"),
    ],
)
def test_options_that_do_not_exist_are_refused_and_nothing_is_written(motion, tmp_path, write, options, problem):
    with pytest.raises(ExportError, match=re.escape(problem)):
        write(motion, tmp_path / "there.usda", **options)
    assert not list(tmp_path.iterdir())


def test_a_body_without_names_of_a_convention_is_told(motion, tmp_path):
    plain = replace(motion, body=replace(motion.body, aliases={"bvh": {}}))
    with pytest.raises(ExportError, match="no names of mixamo"):
        write_bvh(plain, tmp_path / "a.bvh", names="mixamo")
    write_bvh(plain, tmp_path / "a.bvh")
    assert "ROOT pelvis" in (tmp_path / "a.bvh").read_text()
