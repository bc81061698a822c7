"""A simulated recording is a take that reads back as what was simulated."""

import cv2
import numpy as np
import pytest

from kinefit.errors import ExportError, ObservationError
from kinefit.exporters.pictures.drawing import depth_colours
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.videos.video import Video
from kinefit.simulation import SENSORS, TOF, cut, simulate_depth, squat_and_wave, write_recording


@pytest.fixture(scope="module")
def motion():
    return cut(squat_and_wave(), 20, 23)


@pytest.fixture(scope="module")
def recording(motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    told = []
    take = write_recording(
        motion, folder / "seen", ("tof", "stereo", "keypoints", "tof"), seed=5, room=False,
        step=lambda what, done, total: told.append((what, done, total)),
        beside=lambda path: (path / "truth.txt").write_text("so it was"),
    )  # fmt: skip
    return take, told


def test_depth_reads_back_to_the_millimetre(motion, recording):
    take = read_take(recording[0])
    observations = load_observations(take)
    (video,) = observations.depth
    assert len(video) == len(motion)
    assert video.rate == motion.rate
    again = simulate_depth(motion, observations.rig["tof"], TOF, room=False, seed=5)
    for frame in range(3):
        there, here = video.frame(frame).depth, again.frame(frame).depth
        np.testing.assert_array_equal(there > 0, here > 0)
        assert np.abs(there - here).max() <= 0.0005 + 1e-6
    assert 0.01 < take.depth[0].sigma < 0.1
    np.testing.assert_allclose(video.times, motion.times - motion.times[0], atol=1e-9)


def test_everything_that_was_asked_for_is_there(motion, recording):
    take, told = recording
    parsed = read_take(take)
    assert {camera.name for camera in parsed.cameras} == {"stereo_left", "stereo_right", "colour"}
    assert [(pair.left, pair.right) for pair in parsed.stereo] == [("stereo_left", "stereo_right")]
    assert parsed.up == motion.up
    assert (take.parent / "truth.txt").read_text() == "so it was"
    assert {what for what, _, _ in told} == {"tof", "stereo_left", "stereo_right"}
    assert told[-1][1:] == (3, 3)
    observations = load_observations(parsed)
    uv = observations.keypoints[0].points[:, 0]
    assert np.isfinite(uv[..., 0]).mean() > 0.4
    video = Video(take.parent / "stereo_left.mkv")
    assert (video.size, len(video)) == ((320, 240), 3)
    assert cv2.imread(str(take.parent / "preview.png")).shape == (240, 310 + 3 * 320, 3)
    assert not list(take.parent.glob(".writing*"))


def test_a_shorter_recording_leaves_no_frame_of_the_longer_one(motion, tmp_path):
    write_recording(motion, tmp_path, ("tof",), room=False)
    (tmp_path / "tof" / "notes.txt").write_text("mine")
    write_recording(cut(motion, 0, 2), tmp_path, ("tof",), room=False)
    assert sorted(path.name for path in (tmp_path / "tof").iterdir()) == ["000000.png", "000001.png", "notes.txt"]


def test_what_fails_leaves_nothing(motion, tmp_path):
    def full(folder):
        raise OSError(28, "No space left on device")

    with pytest.raises(ExportError, match="No space"):
        write_recording(motion, tmp_path / "new", ("tof",), room=False, beside=full)
    assert list((tmp_path / "new").iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError):
        write_recording(motion, tmp_path / "file", ("tof",), room=False)


@pytest.mark.parametrize("sensors", [("radar",), ()])
def test_a_sensor_that_does_not_exist_is_refused(motion, tmp_path, sensors):
    with pytest.raises(ObservationError, match="sensor"):
        write_recording(motion, tmp_path / "new", sensors)
    assert not (tmp_path / "new").exists()


def test_depths_as_colours():
    shown = depth_colours(np.array([[0.0, 1.0, 5.0]]), 1.0, 5.0)
    assert shown.shape == (1, 3, 3)
    assert not shown[0, 0].any() and not depth_colours(np.array([[np.nan]]), 1.0, 5.0).any()
    assert shown[0, 1, 0] > shown[0, 1, 2]  # near is red
    assert shown[0, 2, 2] > shown[0, 2, 0]


def test_all_sensors_are_named():
    assert SENSORS == ("tof", "kinect", "stereo", "colour", "keypoints")
