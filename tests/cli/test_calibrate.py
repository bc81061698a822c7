"""`kinefit calibrate`: from pictures to a calibration that reads back; what it says when it cannot."""

import csv

import cv2
import numpy as np
import pytest
from benchmarks.scenes.bar_scene import CORNERS, bar_rig, draw_bar, pose_differences, see_bar, wave_bar, write_corners
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


@pytest.mark.parametrize(("floor", "said"), [("soon", "is not a frame"), ("2.5s", "images in folders have no times")])
def test_floor_is_a_frame_or_a_time(tmp_path, floor, said):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.png").write_bytes(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes())
    told = call("board", tmp_path / "a", "--board", "checkerboard:9x6:0.025", "--floor", floor)
    assert told.exit_code == 2 and said in " ".join(told.output.split())


@pytest.fixture(scope="module")
def waved(tmp_path_factory):
    """A drawn recording of a bar before three cameras with lamps in view, and the cameras."""
    folder, rig = tmp_path_factory.mktemp("waved"), bar_rig(3, (640, 480))
    ends = wave_bar(0.9, 40, low=(-0.6, -0.6, 0.5), high=(0.6, 0.6, 1.6), seed=8)
    ends[0], ends[1] = [[0.0, 0, 0.2], [0.9, 0, 0.2]], [[0.1, 0.3, 0.2], [0.1, -0.6, 0.2]]
    for f, places in enumerate(ends):
        for c, camera in enumerate(rig):
            image = draw_bar(camera, places, radius=0.03, lamps=[[0.9, 0.2, 2.0]], seed=3 * f + c)
            cv2.imwrite(str(folder / f"{camera.name}_{f:03d}.png"), image)
    return folder, rig


def test_a_drawn_bar_becomes_a_calibration(waved, tmp_path):
    folder, rig = waved
    out = tmp_path / "room.toml"
    true = np.linalg.norm(rig["cam0"].centre_world - rig["cam1"].centre_world)
    words = ("bar", folder, "--length", 0.9, "--floor", "0,1", "-o", out)
    told = call(*words, "--distance", f"cam0:cam1:{true}")
    assert told.exit_code == 0, told.output
    found = read_calibration(out)
    for camera, expected in zip(found, rig, strict=True):
        assert camera.matrix[0, 0] == pytest.approx(expected.matrix[0, 0], rel=0.01)
        assert camera.centre_world[2] == pytest.approx(expected.centre_world[2] - 0.2, abs=0.03)
    assert "Target detection: sigma 0.0" in told.output and "was not checked" not in told.output
    with (tmp_path / "room.csv").open() as file:
        rows = {(row["camera"], row["parameter"]): row for row in csv.DictReader(file)}
    assert len(rows) == 3 * 15 and rows["cam1", "fx"]["from"] == "recording" and float(rows["cam1", "fx"]["std"]) > 0
    assert float(rows["cam2", "z"]["value"]) == pytest.approx(found["cam2"].centre_world[2], abs=1e-6)
    picture = cv2.imread(str(tmp_path / "room.png"))
    assert picture.shape[1] > 1200 and (picture.max(axis=2) > 200).sum() > 1000  # targets over the images
    again = call(*words)
    assert isinstance(again.exception, ExportError)


@pytest.mark.parametrize(
    ("pairs", "length", "late"),
    [(CORNERS, 0.162, 0), (tuple((k, k + 6) for k in range(6)), 0.108, 0), (CORNERS, 0.162, 3)],
)
def test_corners_of_a_real_board_are_a_bar(pairs, length, late, data_dir, tmp_path):
    """Images up to 10 ms apart of a board at 0.1 m/s; the recording's own calibration is from all of its corners."""
    recording, table, out = data_dir("mv4_landmarks_caliscope"), tmp_path / "corners.csv", tmp_path / "room.toml"
    write_corners(recording, table, pairs=pairs, late=late)
    lenses = recording / "config.toml"
    told = call("bar", table, "--length", length, "--size", "1280x720", "--interiors", lenses, "-o", out)
    if late:
        assert isinstance(told.exception, CalibrationError) and "cam_3" in str(told.exception)
        return
    assert told.exit_code == 0, told.output
    lengths, angles = pose_differences(read_calibration(out), read_calibration(lenses))
    assert lengths < (0.02 if pairs is CORNERS else 0.006) and angles < (1.0 if pairs is CORNERS else 0.4)


def test_a_table_of_centroids_becomes_a_calibration(waved, tmp_path):
    rig = waved[1]
    seen = see_bar(rig, wave_bar(0.9, 60, low=(-0.6, -0.6, 0.5), high=(0.6, 0.6, 1.6), seed=9))
    rows = [f"{n},{f},{u},{v}" for n, s in seen.items() for f, uv in s.ends.items() for u, v in uv]
    table, out = tmp_path / "spots.csv", tmp_path / "t.toml"
    table.write_text("camera,frame,u,v\n" + "\n".join(rows))
    told = call("bar", table, "--length", 0.9, "--size", "640x480", "-o", out)
    assert told.exit_code == 0 and "was not checked" in told.output, told.output
    assert read_calibration(out).names == rig.names
    for words in (("--size", "big"), (), ("--distance", "a:b", "--size", "640x480"), ("--floor", "x")):
        assert call("bar", table, "--length", 0.9, *words, "-o", tmp_path / "u.toml").exit_code == 2
