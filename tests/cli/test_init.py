"""`kinefit init`: from a folder to a take that tracks."""

import numpy as np
import pytest
from click.testing import CliRunner

import kinefit.cli
from kinefit.cli import main
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import squat_and_wave


@pytest.fixture(autouse=True)
def wired(monkeypatch):
    """The command is there, whatever else is."""
    commands = dict.fromkeys([*kinefit.cli.COMMANDS, "init"])
    monkeypatch.setattr(kinefit.cli, "COMMANDS", tuple(commands))


def run(*args):
    return CliRunner().invoke(main, [str(arg) for arg in args])


@pytest.fixture
def folder(take):
    """A folder as a stranger brings it: videos, keypoints, a calibration, no take file."""
    take.unlink()
    return take.parent


def test_the_take_that_it_writes_is_as_good_as_the_one_that_was_there(take, tmp_path):
    given = read_take(take)
    take.rename(tmp_path / "given.toml")
    told = run("init", take.parent)
    assert told.exit_code == 0, told.output
    guessed = read_take(take)
    assert (guessed.rate, guessed.up, guessed.body, guessed.calibration) == (
        given.rate, given.up, given.body, given.calibration,
    )  # fmt: skip
    assert guessed.cameras == given.cameras
    assert [(k.camera, k.file, k.format) for k in guessed.keypoints] == [
        (k.camera, k.file, k.format) for k in given.keypoints
    ]
    assert load_observations(guessed).frames == load_observations(given).frames
    assert f"{take}: written" in told.stdout and "kinefit check" in told.stdout
    assert "sure    camera cam01" in told.stdout


def test_a_take_file_is_replaced_only_by_force(folder):
    assert run("init", folder).exit_code == 0
    (folder / "take.toml").write_text("mine")
    told = run("init", folder)
    assert told.exit_code == 2 and "there is a take file already" in told.stderr and "--force" in told.stderr
    assert (folder / "take.toml").read_text() == "mine"
    assert run("init", folder, "--force").exit_code == 0
    assert read_take(folder / "take.toml").cameras


def test_paths_start_at_the_take_file(folder, tmp_path):
    assert run("init", folder, "--out", tmp_path / "takes" / "monday.toml").exit_code == 0
    text = (tmp_path / "takes" / "monday.toml").read_text()
    assert 'file = "../take/calibration.toml"' in text
    assert load_observations(read_take(tmp_path / "takes" / "monday.toml")).rig is not None
    assert not (folder / "take.toml").exists()


def test_a_folder_of_nothing_is_told_and_nothing_written(tmp_path):
    (tmp_path / "empty").mkdir()
    for args in ([tmp_path / "empty"], [tmp_path / "none"]):
        told = run("init", *args)
        assert told.exit_code == 2 and "error: " in told.stderr and "try" in told.stderr
    assert not list((tmp_path / "empty").iterdir())


def test_videos_alone_are_told_how_to_calibrate(folder):
    (folder / "calibration.toml").unlink()
    told = run("init", folder)
    assert told.exit_code == 2
    assert "kinefit calibrate board" in told.stderr and "kinefit calibrate people" in told.stderr
    assert not (folder / "take.toml").exists()


def test_a_damaged_video_is_told(folder):
    (folder / "cam02.mp4").write_bytes((folder / "cam02.mp4").read_bytes()[:5000])
    told = run("init", folder)
    assert told.exit_code == 2 and "cam02.mp4" in told.stderr
    assert not (folder / "take.toml").exists()


@pytest.mark.slow
def test_what_it_writes_can_be_tracked(folder, tmp_path):
    assert run("init", folder).exit_code == 0
    told = run("track", folder / "take.toml", "--no-overlays", "--formats", "motion", "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    motion = kinefit.read_motion(tmp_path / "out" / "motion.npz")
    truth = squat_and_wave()
    knees = [motion.body.tree.segment(f"shank_{side}") for side in "rl"]
    off = motion.segment_poses()[:, knees, :3, 3] - truth.segment_poses()[:, knees, :3, 3]
    assert np.median(np.linalg.norm(off, axis=-1)) < 0.03
