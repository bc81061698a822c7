"""`kinefit view`."""

import os
import re
import signal
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from click.testing import CliRunner
from tests.cli.stopping import STOPPABLE
from tests.studio.viewers.recordings import write_take

from kinefit.cli.view import view
from kinefit.errors import ExportError, FileError, ObservationError
from kinefit.exporters import write_motion
from kinefit.simulation import cut, squat_and_wave
from kinefit.studio.viewers.viewed import gather


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    write_take(folder)
    return folder


@pytest.fixture(scope="module")
def motion():
    return cut(squat_and_wave(), 0, 6)


def run(*args):
    return CliRunner().invoke(view, [str(arg) for arg in args])


def test_a_folder_of_results_finds_its_take(folder):
    said = []
    recording = gather((folder / "take-kinefit",), tell=said.append)
    assert len(recording.motions) == 1 and len(recording.rig) == 2
    assert "Cameras are from the take" in said[0]


def test_a_take_of_another_name_is_not_taken(folder, tmp_path, motion):
    (tmp_path / "x.toml").write_text((folder / "take.toml").read_text().replace(motion.name, "another"))
    for file in folder.iterdir():
        if file.is_file() and file.name != "take.toml":
            (tmp_path / file.name).write_bytes(file.read_bytes())
    write_motion(motion, tmp_path / "x-kinefit" / "motion.npz")
    said = []
    assert gather((tmp_path / "x-kinefit",), tell=said.append).rig is None
    assert "'another'" in said[0]


def test_a_damaged_take_beside_results_is_told_and_left_out(tmp_path, motion):
    (tmp_path / "x.toml").write_text("[take\n")
    write_motion(motion, tmp_path / "x-kinefit" / "motion.npz")
    said = []
    assert gather((tmp_path / "x-kinefit",), tell=said.append).rig is None
    assert "not TOML" in said[0]


def test_a_take_alone_shows_its_keypoints_in_space(folder, motion):
    recording = gather((folder / "take.toml",), None)
    assert recording.motions == () and len(recording.times) == len(motion)
    points = motion.body.keypoints("MEDIAPIPE_33")
    known = np.isfinite(recording.points).all(-1)
    assert known.mean() > 0.6  # some are hidden from one of the two cameras
    error = np.linalg.norm(recording.points - motion.positions(points), axis=-1)[known]
    assert np.median(error) < 0.02  # 0.1 px in pictures 96 px wide


def test_two_motions_and_a_take(folder, tmp_path, motion):
    write_motion(motion.turned("y"), tmp_path / "y.npz")
    recording = gather((folder / "take-kinefit", tmp_path / "y.npz"), folder / "take.toml")
    assert [m.up for m in recording.motions] == [motion.up] * 2
    assert np.allclose(recording.motions[1].Ts_world_root, motion.Ts_world_root, atol=1e-9)


def test_one_page_without_a_server(folder, tmp_path):
    told = run(folder / "take-kinefit", "--html", tmp_path / "there" / "scene.html")
    assert told.exit_code == 0, told.output
    assert "6 frames" in told.output
    assert 0.5e6 < (tmp_path / "there" / "scene.html").stat().st_size < 10e6


def test_a_page_that_cannot_be_written_is_told(folder, tmp_path):
    (tmp_path / "file").write_text("")
    told = run(folder / "take-kinefit" / "motion.npz", "--html", tmp_path / "file" / "scene.html")
    assert isinstance(told.exception, ExportError)


@pytest.mark.parametrize("name", ["absent.npz", "empty", "junk.npz", "absent.toml"])
def test_what_cannot_be_shown_is_told(name, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "junk.npz").write_bytes(b"no motion")
    told = run(tmp_path / name, "--html", tmp_path / "x.html")
    assert isinstance(told.exception, FileError) and name in str(told.exception)
    assert not (tmp_path / "x.html").exists()


def test_two_takes_are_too_many(folder):
    with pytest.raises(ObservationError, match="two take files"):
        gather((folder / "take.toml", folder / "take.toml"), None)


def test_it_serves_until_it_is_stopped(folder):
    command = STOPPABLE + "import sys; from kinefit.cli.view import view; view(sys.argv[1:])"
    args = [sys.executable, "-c", command, str(folder / "take-kinefit"), "--no-browser", "--port", "0"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "KINEFIT_TOKEN": "of-this-environment"}
    with subprocess.Popen(args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            address = re.search(r"http://localhost:\d+/of-this-environment/", process.stdout.readline())[0]
            with urllib.request.urlopen(address, timeout=20) as answer:
                assert answer.status == 200
        finally:
            process.send_signal(signal.SIGINT)
            rest, errors = process.communicate(timeout=30)
    assert process.returncode == 0 and "Closed." in errors and "viser" not in rest + errors
