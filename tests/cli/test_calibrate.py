"""`kinefit calibrate`: from pictures to a calibration that reads back; what it says when it cannot."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli.calibrate import calibrate
from kinefit.errors import CalibrationError, ExportError, FileError
from kinefit.readers.calibration.read import read_calibration


def call(*words):
    return CliRunner().invoke(calibrate, [str(word) for word in words])


def test_help_names_both_ways_and_examples():
    told = call("--help").output
    assert "board" in told and "people" in told
    told = call("board", "--help").output
    assert "charuco:5x7:0.04:0.03" in told and "--floor" in told and "--interiors" in told


@pytest.mark.slow
def test_a_stereo_pair_from_pictures(data_dir, tmp_path):
    out = tmp_path / "stereo.toml"
    words = (
        "board", data_dir("stereo_opencv_chessboard"), "--board", "checkerboard:9x6:0.025", "-o", out, "--floor", "5",
    )  # fmt: skip
    told = call(*words)
    assert told.exit_code == 0, told.output
    rig = read_calibration(out)
    assert rig.names == ("left", "right") and all(camera.centre_world[2] > 0.2 for camera in rig)
    assert "left to right: 0.083 m, 13 frames agree" in told.output and 'up = "z"' in told.output
    assert str(out) in told.output
    text = out.read_text()
    again = call(*words)
    assert isinstance(again.exception, ExportError) and out.read_text() == text
    lenses = call(
        "board", data_dir("stereo_opencv_chessboard"), "--board", "checkerboard:9x6:0.025", "-o", tmp_path / "b.toml",
        "--interiors", out,
    )  # fmt: skip
    assert lenses.exit_code == 0 and "given" in lenses.output
    for a, b in zip(read_calibration(tmp_path / "b.toml"), rig):
        assert a.matrix.tolist() == b.matrix.tolist()


@pytest.mark.parametrize(
    ("words", "error", "said"),
    [
        (("nowhere", "--board", "checkerboard:9x6:0.025"), FileError, "nowhere"),
        ((".", "--board", "nonsense"), CalibrationError, "nonsense"),
        ((".", "--board", "checkerboard:9x6:25"), CalibrationError, "squares of 25 m"),
    ],
)
def test_what_it_refuses(words, error, said, tmp_path):
    told = call("board", *words, "-o", tmp_path / "out.toml")
    assert isinstance(told.exception, error) and said in str(told.exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [("board",), ("board", "x"), ("nothing",)])
def test_usage(words):
    assert call(*words).exit_code == 2


@pytest.mark.parametrize(("floor", "said"), [("soon", "is no frame"), ("2.5s", "pictures have no times")])
def test_floor_is_a_frame_or_a_time(tmp_path, floor, said):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.png").write_bytes(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes())
    told = call("board", tmp_path / "a", "--board", "checkerboard:9x6:0.025", "--floor", floor)
    assert told.exit_code == 2 and said in " ".join(told.output.split())
