"""`kinefit export` and `kinefit retarget`."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pygltflib as gl
import pytest
from click.testing import CliRunner
from tests.readers.skeletons.bvh_variants import any_frames, write_variant

import kinefit
from kinefit.bodies import load_body
from kinefit.bodies.rendering.looks import person_skin
from kinefit.cli import main
from kinefit.exporters import write_bvh, write_motion
from kinefit.readers.skeletons.bvh import read_bvh
from kinefit.simulation import cut, squat_and_wave


@pytest.fixture(scope="module")
def motion():
    return cut(squat_and_wave(), 0, 5)


@pytest.fixture
def file(motion, tmp_path):
    write_motion(motion, tmp_path / "squat.npz")
    return tmp_path / "squat.npz"


def run(*args):
    return CliRunner().invoke(main, [str(arg) for arg in args])


@pytest.mark.parametrize("format", ["bvh", "glb", "fbx", "trc", "mot", "osim", "c3d"])
def test_a_file_beside_the_motion(format, file):
    told = run("export", file, "--to", format)
    assert told.exit_code == 0, told.output
    assert file.with_suffix(f".{format}").stat().st_size > 1000
    assert str(file.with_suffix(f".{format}")) in told.stdout


def test_cylinders_are_written_in_place_of_a_skin(file):
    skin, tubes = file.parent / "skin.glb", file.parent / "tubes.glb"
    assert run("export", file, "--to", "glb", "--out", skin).exit_code == 0
    told = run("export", file, "--to", "glb", "--cylinders", "--out", tubes)
    assert told.exit_code == 0 and "cylinders" in told.stdout
    counts = []
    for path in (skin, tubes):
        gltf = gl.GLTF2().load(str(path))
        counts.append(gltf.accessors[gltf.meshes[0].primitives[0].attributes.POSITION].count)
    assert counts[0] == len(person_skin(load_body("humanoid")).vertices) != counts[1]


def test_usd_is_binary_unless_named_otherwise(file):
    pytest.importorskip("pxr")
    assert run("export", file, "--to", "usd").exit_code == 0
    assert (file.parent / "squat.usdc").read_bytes().startswith(b"PXR-USDC")
    assert run("export", file, "--to", "usd", "--out", file.parent / "x.usda", "--names", "mixamo").exit_code == 0
    assert "mixamorig_Hips/mixamorig_LeftUpLeg" in (file.parent / "x.usda").read_text()


EXTRAS = {"nwb": "ndx_pose", "mcap": "mcap_ros2", "rrd": "rerun"}


def test_every_choice_that_help_lists_is_one_of_the_exporter(file):
    from kinefit.takes.batch.results import FORMATS, OPTIONS

    for format in FORMATS.built_in:
        for key in OPTIONS:
            for value in getattr(FORMATS.get(format), key):
                absent = format in EXTRAS and find_spec(EXTRAS[format]) is None
                if format not in ("parquet", "csv", "usd") and not absent:
                    told = run("export", file, "--to", format, f"--{key}", value, "--out", file.parent / f"x.{format}")
                    assert told.exit_code == 0, told.output
                    assert f"{key} {value}" in told.stdout


def test_tables_are_a_folder(file):
    assert run("export", file, "--to", "csv").exit_code == 0
    lines = (file.parent / "squat-tables" / "angles.csv").read_text().splitlines()
    assert len(lines) == 6


def test_unit_and_vertical_axis_are_those_asked_for(file, motion, tmp_path):
    told = run("export", file, "--to", "bvh", "--unit", "mm", "--up", "z", "--out", tmp_path / "there" / "x.bvh")
    assert told.exit_code == 0, told.output
    read = kinefit.readers.read_bvh(tmp_path / "there" / "x.bvh", unit=0.001, up="z")
    root = read.Ts_world_joint[:, 0, :3, 3]
    assert np.allclose(root, motion.Ts_world_root[:, :3, 3], atol=1e-6)  # the motion is z up, in metres


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--to", "glb", "--unit", "m"], "and y up by its specification. --unit does not apply to glb, only to csv"),
        (["--to", "glb", "--up", "z"], "GLB is in metres and y up by its specification. --up does not apply to glb"),
        (["--to", "mot", "--names", "cmu"], "OpenSim files are in metres"),
        (["--to", "trc", "--names", "mixamo"], "TRC has landmarks"),
        (["--to", "trc", "--unit", "inch"], "--unit inch is not possible for trc. Give one of: m, cm, mm."),
        (["--to", "usd", "--up", "x"], "only y and z up. --up x is not possible for usd. Give one of: y, z."),
        (["--to", "fbx", "--names", "maya"], "Error: --names maya is not possible for fbx. Give one of: kinefit,"),
        (["--to", "glb", "--names", "maya"], "Error: --names maya is not possible for glb. Give one of: kinefit,"),
        (["--to", "bvh", "--names", "maya"], "--names maya is not possible for bvh. Give one of: bvh, kinefit, mixamo"),
        (["--to", "c3d", "--rest", "t"], "--rest does not apply to c3d, only to bvh, glb, fbx, usd, x3d"),
        (["--to", "bvh", "--cylinders"], "only fbx, glb and usd contain a mesh"),
        (["--to", "dae"], "there are: csv, parquet, bvh, glb, fbx"),
        (["--to", "fbx", "--up", "x"], "FBX with y or z up. --up x is not possible for fbx. Give one of: y, z."),
        ([], "--to"),
    ],
)
def test_options_that_do_not_fit_are_refused(options, problem, file):
    told = run("export", file, *options)
    assert told.exit_code == 2
    assert problem in told.stderr
    assert [path.name for path in file.parent.iterdir()] == ["squat.npz"]


def test_a_file_that_is_no_motion_is_told(tmp_path):
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 not really")
    told = run("export", tmp_path / "x.npz", "--to", "bvh")
    assert told.exit_code == 2
    assert "x.npz" in told.stderr
    assert run("export", tmp_path / "none.npz", "--to", "bvh").exit_code == 2
    assert not (tmp_path / "x.bvh").exists()


def test_a_recorded_skeleton_becomes_a_motion_of_the_humanoid(motion, tmp_path, data_dir):
    folder = data_dir("motion_cmu_amc")
    options = ("--asf", folder / "02.asf", "--rate", "12", "--out", tmp_path / "w.npz")
    told = run("retarget", folder / "02_01.amc", *options)
    assert told.exit_code == 0, told.output
    walk = kinefit.read_motion(tmp_path / "w.npz")
    assert (walk.rate, walk.body.name) == (12.0, "humanoid")
    assert f"{len(walk)} frames at 12 Hz" in told.stdout


def test_a_recorded_skeleton_of_another_unit_and_a_doubtful_zero(tmp_path, data_dir):
    wave = read_bvh(data_dir("motion_animateddrawings_bvh") / "wave_hello.bvh")
    wave = replace(wave, Ts_world_joint=wave.Ts_world_joint[[0, 388]])
    path = write_variant(wave, tmp_path / "w.bvh", any_frames(wave), unit=0.3048)
    told = run("retarget", path)
    assert told.exit_code == 2 and "kinefit retarget --unit" in told.stderr
    told = run("retarget", path, "--unit", "ft", "--up", "z")
    assert told.exit_code == 0 and "zero as in frame 2" in told.stdout
    assert np.ptp(kinefit.read_motion(tmp_path / "w.npz").positions()[0, :, 1]) == pytest.approx(1.7, abs=0.15)


def test_a_skeleton_of_no_known_family_is_told(motion, tmp_path):
    write_bvh(motion, tmp_path / "x.bvh")
    (tmp_path / "x.bvh").write_text((tmp_path / "x.bvh").read_text().replace("UpLeg", "Flipper"))
    told = run("retarget", tmp_path / "x.bvh")
    assert told.exit_code == 2
    assert "error: " in told.stderr
    assert not (tmp_path / "x.npz").exists()


@pytest.mark.parametrize("args", [["x.mp4"], ["x.amc"], ["x.bvh", "--asf", "y.asf"]])
def test_what_cannot_be_retargeted_is_a_wrong_command_line(args):
    told = run("retarget", *args)
    assert told.exit_code == 2
    assert "Usage:" in told.stderr
