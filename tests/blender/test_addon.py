"""The Blender add-on: its names, its reader; with bpy (`KINEFIT_BPY_PYTHON`, or installed) all of it in Blender."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies.toml.joint_names import conventions, plain
from kinefit.exporters import write_glb, write_jsonl

FOLDER = Path(__file__).resolve().parents[2] / "blender"


def loaded(name):
    """A module of the add-on that needs no Blender."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / "kinefit_motion" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def lines():
    return loaded("lines")


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(12, up="y", turns=0.4)


def test_names_are_those_of_retarget():
    told = json.loads((FOLDER / "kinefit_motion" / "names.json").read_text())
    assert told == [{"name": f.name, "joints": dict(f.joints)} for f in conventions()]
    assert plain("mixamorig:LeftArm") == "leftarm"


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_motions_are_read_in_z_up(lines, motion, tmp_path, up):
    write_jsonl(motion, tmp_path / "a.jsonl", up=up)
    read = lines.read_lines(tmp_path / "a.jsonl")
    truth = motion.turned("z").segment_poses()
    # worlds of other axes differ by a turn about the vertical
    apart = np.linalg.norm(read.poses[:, 1:, :3, 3] - read.poses[:, :1, :3, 3], axis=-1)
    assert np.allclose(apart, np.linalg.norm(truth[:, 1:, :3, 3] - truth[:, :1, :3, 3], axis=-1), atol=1e-5)
    assert np.allclose(read.poses[..., 2, 3], truth[..., 2, 3], atol=1e-5)
    assert np.allclose(np.linalg.det(read.poses[..., :3, :3]), 1.0) and read.rate == motion.rate
    if up in "yz":
        assert np.allclose(read.poses, truth, atol=1e-5)


@pytest.mark.parametrize("text", ["", "{}", "no json", '{"type": "hello"}', '{"type": "pose"}'])
def test_other_files_are_refused(lines, tmp_path, text):
    (tmp_path / "a.jsonl").write_text(text)
    with pytest.raises(lines.LinesError, match=r"a\.jsonl"):
        lines.read_lines(tmp_path / "a.jsonl")


def test_all_of_it_in_blender(motion, tmp_path):
    python = os.environ.get("KINEFIT_BPY_PYTHON") or (sys.executable if importlib.util.find_spec("bpy") else None)
    if python is None:
        pytest.skip("no bpy: set KINEFIT_BPY_PYTHON to a Python that has it")
    write_jsonl(motion, tmp_path / "a.jsonl")
    write_glb(motion, tmp_path / "c.glb", names="mixamo")
    frames = [1, 5, len(motion)]
    words = [python, FOLDER.parent / "tests" / "blender" / "in_blender.py", FOLDER, tmp_path / "a.jsonl",
             tmp_path / "c.glb", json.dumps(frames)]  # fmt: skip
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=300, env=clean)
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("told "))[5:])
    truth = motion.turned("z").segment_poses()[..., :3, 3]
    segments = motion.body.tree.segments
    assert told["fps"] == pytest.approx(motion.rate) and told["last"] == len(motion)
    for frame, joints, std in zip(frames, told["joints"], told["std"]):
        for s, name in enumerate(segments):
            assert np.allclose(joints[name], truth[frame - 1, s], atol=1e-5), name
            wide = 1000.0 * motion.joint_std[frame - 1, s].max()
            assert std[name] == pytest.approx(wide if np.isfinite(wide) else -1.0, rel=1e-4, abs=1e-3)
    bones = {f.name: f.joints for f in conventions()}["mixamo"]
    for frame, joints in zip(frames, told["retargeted"]):  # the same body under other names: all joints are the same
        shift = np.array(joints[bones["pelvis"]]) - truth[frame - 1, 0]
        for s, name in enumerate(segments):
            if name in bones and bones[name] in joints:
                assert np.linalg.norm(joints[bones[name]] - shift - truth[frame - 1, s]) < 0.005, name
    assert "no motion of kinefit" in told["refused"]
