"""`kinefit simulate`."""

import numpy as np
import pytest
from click.testing import CliRunner

import kinefit
from kinefit.cli import main
from kinefit.cli.motions.simulate import _SENSORS
from kinefit.exporters import write_motion
from kinefit.simulation import SENSORS, cut, squat_and_wave


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder, motion = tmp_path_factory.mktemp("motions"), cut(squat_and_wave(), 20, 26)
    write_motion(motion, folder / "squat.npz")
    return folder


def run(*args):
    return CliRunner().invoke(main, ["simulate", *map(str, args)])


def test_a_take_and_its_truth(folder, tmp_path):
    told = run(folder / "squat.npz", "-o", tmp_path / "seen", "--sensor", "tof", "--frames", "1:3", "--azimuth", 20)
    assert told.exit_code == 0, told.output
    truth = kinefit.read_motion(tmp_path / "seen" / "truth" / "motion.npz")
    np.testing.assert_allclose(truth.angles, cut(squat_and_wave(), 21, 23).angles)
    assert (tmp_path / "seen" / "truth" / "joints.csv").is_file()
    observations = kinefit.load_observations(kinefit.read_take(tmp_path / "seen" / "take.toml"))
    assert len(observations.depth[0]) == len(truth) == 2
    assert "kinefit track" in told.stdout


def test_rate_body_and_one_frame(folder, tmp_path):
    out = tmp_path / "seen"
    told = run(folder / "squat.npz", "-o", out, "--rate", 60, "--frames", 3, "--body", "humanoid10", "--no-room")
    assert told.exit_code == 0, told.output
    truth = kinefit.read_motion(out / "truth" / "motion.npz")
    assert (len(truth), truth.rate, truth.body.name) == (1, 60.0, "humanoid10")


def test_a_recorded_skeleton(data_dir, tmp_path):
    jacks = data_dir("motion_animateddrawings_bvh") / "jumping_jacks.bvh"
    told = run(jacks, "-o", tmp_path / "seen", "--sensor", "tof", "--rate", 5, "--frames", ":2")
    assert told.exit_code == 0, told.output
    assert "2 frames" in told.stdout


@pytest.mark.parametrize(
    ("args", "word"),
    [
        (("walk.avi",), "is not a .npz"), (("walk.amc",), "--asf"), (("walk.npz", "--asf", "a.asf"), "--asf"),
        (("none.npz",), "no such motion"), (("squat.npz", "--sensor", "radar"), "radar"),
        (("squat.npz", "--frames", "a:b"), "FIRST:LAST"), (("squat.npz", "--frames", "90:"), "no frames"),
        (("squat.npz", "--body", "dragon"), "dragon"), (("squat.npz", "--rate", "0"), "rate"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told_and_nothing_is_written(folder, tmp_path, args, word):
    told = run(folder / args[0], *args[1:], "-o", tmp_path / "seen")
    assert told.exit_code == 2
    assert word in told.output
    assert "Traceback" not in told.output
    assert not (tmp_path / "seen").exists()


def test_help_lists_the_sensors_that_exist():
    assert _SENSORS == SENSORS


def test_a_body_file_is_named_in_the_take(folder, tmp_path):
    from importlib.resources import files

    own = tmp_path / "mine.toml"
    ten = (files("kinefit.bodies.toml") / "catalogue" / "humanoid10.toml").read_text()
    own.write_text(ten.replace("humanoid10", "mine"))
    out = tmp_path / "seen"
    told = run(folder / "squat.npz", "-o", out, "--sensor", "tof", "--frames", 0, "--body", own)
    assert told.exit_code == 0, told.output
    assert kinefit.load_body(kinefit.read_take(out / "take.toml").body).name == "mine"
