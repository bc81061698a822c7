"""FBX, as ufbx reads it: joints, skin, unit, axes, rate; in Blender with bpy (`KINEFIT_BPY_PYTHON`, or installed)."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.exporters.synthetic import smooth_motion
from tests.exporters.test_options import METRES, same

from kinefit.bodies import load_body
from kinefit.bodies.rendering.looks import body_mesh
from kinefit.errors import ExportError
from kinefit.exporters import write_fbx
from kinefit.exporters.skeletons.common import NAMES, bone_names

HERE = Path(__file__).parent
CLOSE = 1e-4  # [m]


def run(python, script, *arguments):
    done = subprocess.run([python, str(HERE / script), *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def read(path, times=(0.0,)):
    """What ufbx reads, and of each node `world` (T, N, 4, 4), `rest` (N, 4, 4) in the file's unit."""
    pytest.importorskip("ufbx", reason="the package ufbx is not installed: pip install 'kinefit[test]'")
    told = run(sys.executable, "read_fbx.py", path, json.dumps(list(times)))
    local = np.array(told["local"])
    assert np.allclose(local[..., 7:], 1.0)  # no scales
    T = np.tile(np.eye(4), (*local.shape[:2], 1, 1))
    T[..., :3, 3] = local[..., :3]
    T[..., :3, :3] = Rotation.from_quat(local[..., 3:7].reshape(-1, 4)).as_matrix().reshape(T[..., :3, :3].shape)
    for node, parent in enumerate(told["parents"]):  # parents come first
        T[:, node] = T[:, parent] @ T[:, node] if parent >= 0 else T[:, node]
    return told | {"world": T, "rest": columns(told["rest"])}


def columns(matrices):
    """(..., 4, 4) of the columns that ufbx gives."""
    T = np.tile(np.eye(4), (len(matrices), 1, 1))
    T[:, :3] = np.array(matrices).transpose(0, 2, 1)
    return T


def times_of(motion):
    return (motion.times - motion.times[0]).tolist()


def surface(motion, up, frame):
    """(V, 3) [m] vertices of the figure's skin."""
    mesh, T = body_mesh(motion.body), motion.turned(up).segment_poses()[frame][:, :3]
    local = mesh.vertices[:, None] - motion.body.tree.rest[mesh.segments]
    moved = np.einsum("vkij,vkj->vki", T[mesh.segments][..., :3], local) + T[mesh.segments][..., 3]
    return np.sum(mesh.weights[..., None] * moved, axis=1)


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(20, up="z", turns=0.4)


@pytest.fixture(scope="module")
def file(motion, tmp_path_factory):
    """A motion in metres, z up, and what is read of it."""
    path = tmp_path_factory.mktemp("fbx") / "a.fbx"
    write_fbx(motion, path, unit="m", up="z")
    return read(path, times_of(motion))


@pytest.mark.parametrize(("unit", "up", "names"), [
    ("cm", "y", "unreal"), ("m", "y", "unity"), ("mm", "z", "vrm"), ("cm", "z", "mixamo"), ("m", "z", "bvh"),
])  # fmt: skip
def test_joints_are_where_the_motion_has_them(motion, tmp_path, unit, up, names):
    write_fbx(motion, tmp_path / "a.fbx", unit=unit, up=up, names=names)
    told = read(tmp_path / "a.fbx", times_of(motion))
    assert told["warnings"] == [] and told["version"] == 7500
    assert told["unit_m"] == pytest.approx(METRES[unit])
    # that of the figure, which faces z at rest with y up, and -y with z up
    axes = {"y": ("POSITIVE_Y", "POSITIVE_Z"), "z": ("POSITIVE_Z", "NEGATIVE_Y")}
    assert (told["up"], told["front"]) == axes[up] and told["right"] == "POSITIVE_X"
    found = dict(zip(told["nodes"], np.moveaxis(told["world"][..., :3, 3], 1, 0)))
    same(found, motion, up, names, unit)


@pytest.mark.parametrize("names", NAMES)
def test_bones_have_the_names_and_parents_of_the_body(motion, tmp_path, names):
    write_fbx(motion, tmp_path / "a.fbx", names=names)
    told, bones = read(tmp_path / "a.fbx"), bone_names(motion.body, names, "")
    number = {name: told["nodes"].index(name) for name in bones}
    above = [told["nodes"][told["parents"][number[bone]]] for bone in bones]
    assert above == [bones[p] if p >= 0 else "" for p in motion.body.tree.parents]
    assert sorted(told["nodes"]) == sorted(["", motion.body.name, *bones])


def test_names_that_repeat_or_are_not_english_stay_apart(motion, tmp_path):
    names = {"pelvis": "Hüfte", "head": "Hüfte", "hand_l": "a/b c"}
    odd = replace(motion, body=replace(motion.body, name="Hüfte", aliases={"mixamo": names}), name="Lauf 1: größer")
    write_fbx(odd, tmp_path / "a.fbx", names="mixamo")
    told = read(tmp_path / "a.fbx")
    assert {"Hüfte", "Hüfte_2", "Hüfte_3", "a_b_c"} <= set(told["nodes"])
    assert told["clips"][0][0] == "Lauf_1:_größer" and len(told["skin"]) == len(motion.body.tree.segments)


def test_the_skin_follows_the_bones_with_the_weights_of_the_mesh(motion, file):
    mesh = body_mesh(motion.body)
    ((count, faces, points),) = file["meshes"]
    assert (count, faces) == (len(mesh.vertices), len(mesh.triangles))
    points = np.pad(np.array(points), ((0, 0), (0, 1)), constant_values=1.0)
    weights = np.zeros((len(points), len(motion.body.tree.segments)))
    for frame in (0, 7, 19):
        skinned = np.zeros((len(points), 3))
        for bone, vertices, shares, geometry_to_bone in file["skin"]:
            moved = file["world"][frame, file["nodes"].index(bone)] @ columns([geometry_to_bone])[0]
            skinned[vertices] += np.array(shares)[:, None] * (points[vertices] @ moved.T)[:, :3]
            weights[vertices, motion.body.tree.segment(bone)] = shares
        assert np.abs(skinned - surface(motion, "z", frame)).max() < CLOSE
    expected = np.zeros_like(weights)
    np.add.at(expected, (np.arange(len(points))[:, None], mesh.segments), mesh.weights)
    assert np.abs(weights - expected).max() < 1e-9 and weights.sum(1) == pytest.approx(1.0)


@pytest.mark.parametrize("rest", ["body", "t"])
@pytest.mark.parametrize("up", ["y", "z"])
def test_the_figure_rests_upright_on_the_ground(motion, tmp_path, rest, up):
    write_fbx(motion, tmp_path / "a.fbx", rest=rest, up=up, unit="m")
    told, axis = read(tmp_path / "a.fbx"), "xyz".index(up)
    points = np.array(told["meshes"][0][2])
    assert points[:, axis].min() == pytest.approx(0.0, abs=1e-6) and np.ptp(points[:, axis]) > 1.5
    across = np.ptp(points, axis=0)
    assert (np.argmax(np.delete(across, axis)) == 0 and across[0] > 1.4) == (rest == "t")
    head = told["rest"][told["nodes"].index("head"), :3, 3]
    assert head[axis] > 1.2 and told["bind_poses"] == [True]
    for bone, _, _, geometry_to_bone in told["skin"]:  # the bind pose is the rest of the bones
        T = told["rest"][told["nodes"].index(bone)]
        assert np.abs(T @ columns([geometry_to_bone])[0] - np.eye(4)).max() < 1e-6


@pytest.mark.parametrize("rate", [24.0, 29.97, 60.0, 59.94, 100.0, 239.76])
def test_rate_and_times_are_those_of_the_motion(tmp_path, rate):
    motion = smooth_motion(13, rate=rate)
    write_fbx(motion, tmp_path / "a.fbx")
    told = read(tmp_path / "a.fbx", times_of(motion))
    assert told["rate"] == pytest.approx(rate, rel=1e-9)
    assert told["clips"] == [["made_up", 0.0, pytest.approx(12 / rate, abs=1e-9)]]
    uneven = replace(motion, times=motion.times + 0.3 / rate * np.sin(np.arange(13)))
    write_fbx(uneven, tmp_path / "b.fbx")
    told = read(tmp_path / "b.fbx", times_of(uneven))
    found = 0.01 * told["world"][:, told["nodes"].index("hand_l"), :3, 3]
    assert np.abs(found - motion.joint_centres[:, motion.body.tree.segment("hand_l")]).max() < CLOSE


def test_joints_that_slide_and_bodies_without_a_surface(tmp_path):
    motion = smooth_motion(40, body=load_body("rower"))
    assert motion.body.tree.prismatic.any()
    write_fbx(motion, tmp_path / "a.fbx")
    told = read(tmp_path / "a.fbx", times_of(motion))
    same(dict(zip(told["nodes"], np.moveaxis(told["world"][..., :3, 3], 1, 0))), motion, "y", "kinefit", "cm")
    bare = replace(motion, body=replace(motion.body, surfaces=(), skin=None))
    write_fbx(bare, tmp_path / "b.fbx")
    told = read(tmp_path / "b.fbx", times_of(bare))
    assert told["meshes"] == told["skin"] == []
    same(dict(zip(told["nodes"], np.moveaxis(told["world"][..., :3, 3], 1, 0))), bare, "y", "kinefit", "cm")


def test_no_bone_spins_between_frames(tmp_path):
    """Angles go on without jumps, over the pieces too in which a long motion is computed."""
    motion = smooth_motion(2500, turns=20.0)
    write_fbx(motion, tmp_path / "a.fbx")
    frames = np.append(np.arange(0, 2499, 17), 1999)  # the last one of the first piece
    between = read(tmp_path / "a.fbx", ((frames + 0.5) / motion.rate).tolist())
    for s, name in enumerate(motion.body.tree.segments):
        found = 0.01 * between["world"][:, between["nodes"].index(name), :3, 3]
        truth = motion.joint_centres[:, s]
        assert np.abs(found - 0.5 * (truth[frames] + truth[frames + 1])).max() < 0.01


def test_fingers_a_face_and_cylinders(tmp_path):
    for name in ("humanoid_hands", "humanoid_face"):
        motion = smooth_motion(3, body=load_body(name))
        write_fbx(motion, tmp_path / f"{name}.fbx", names="vrm")
        told = read(tmp_path / f"{name}.fbx", times_of(motion))
        same(dict(zip(told["nodes"], np.moveaxis(told["world"][..., :3, 3], 1, 0))), motion, "y", "vrm", "cm")
    write_fbx(motion, tmp_path / "tubes.fbx", cylinders=True)
    tubes = body_mesh(motion.body, cylinders=True)
    assert read(tmp_path / "tubes.fbx")["meshes"][0][0] == len(tubes.vertices) != told["meshes"][0][0]


@pytest.mark.parametrize(("options", "problem"), [
    ({"unit": "inch"}, "unit of length 'inch'; there are: m, cm, mm"), ({"up": "-z"}, "'-z'; there are: y, z"),
    ({"names": "maya"}, "names 'maya'; there are: kinefit"), ({"rest": "a"}, "'a'; there are: body, t"),
])  # fmt: skip
def test_unknown_options_are_refused_and_nothing_is_written(motion, tmp_path, options, problem):
    with pytest.raises(ExportError, match=re.escape(problem)):
        write_fbx(motion, tmp_path / "a.fbx", **options)
    with pytest.raises(ExportError, match="without frames"):
        write_fbx(smooth_motion(0), tmp_path / "a.fbx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("importer", ["import_scene.fbx", "wm.fbx_import"])
@pytest.mark.parametrize(("unit", "up"), [("cm", "y"), ("m", "z")])
def test_blender_opens_it_upright_at_true_size_and_rate(motion, tmp_path, importer, unit, up):
    python = os.environ.get("KINEFIT_BPY_PYTHON") or (sys.executable if importlib.util.find_spec("bpy") else None)
    if python is None:
        pytest.skip("no bpy: set KINEFIT_BPY_PYTHON to a Python that has it")
    write_fbx(motion, tmp_path / "a.fbx", unit=unit, up=up, names="unreal", rest="body")
    told = run(python, "fbx_in_blender.py", tmp_path / "a.fbx", importer, json.dumps([0, 7, 19]))
    assert told["fps"] == pytest.approx(motion.rate) and told["frames"][1] - told["frames"][0] == len(motion) - 1
    truth = motion.turned("z").joint_centres
    for frame, heads, points in zip((0, 7, 19), told["heads"], told["points"]):
        for s, bone in enumerate(bone_names(motion.body, "unreal", "")):
            assert np.linalg.norm(heads[bone] - truth[frame, s]) < 1e-3
        assert np.linalg.norm(np.array(points) - surface(motion, "z", frame), axis=1).max() < 1e-3
    mesh, bones = body_mesh(motion.body), bone_names(motion.body, "unreal", "")
    assert {bones[s] for s in np.unique(mesh.segments[mesh.weights > 0])} <= set(told["groups"]) <= set(bones)
    colours = (mesh.colours[mesh.triangles[:, 0]] / 255.0) ** 2.2
    assert np.abs(np.array(told["colours"]) - colours).max() < 0.01
    assert np.ptp(colours, axis=0).max() > 0.3  # left, middle and right
