"""What the built-in detector is asked to look through, and the times that its file keeps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from kinefit.observations import Detections
from kinefit.readers.landmarks.detections import read_detections
from kinefit.takes.preparing import detecting

KEPT = [0, 1, 2, 4, 6, 8, 9, 10]  # steps of 50 Hz


def look(images, models, *, camera, rate, people, masks, adders, looks):
    """Nobody, in every image."""
    count = len(list(images))
    nothing = np.zeros(0, np.uint32), np.zeros(count + 1, int)
    return Detections(camera, rate, (64, 48), np.full((count, 1, 33, 2), np.nan), np.zeros((count, 1, 33)), *nothing)


@pytest.fixture
def found(write_frames, tmp_path, monkeypatch):
    monkeypatch.setattr("kinefit.images.detectors.box_detector.Models", lambda *given, **more: None)
    monkeypatch.setattr("kinefit.takes.preparing.detecting.detect_people", look)

    def run(steps, seconds=None):
        video = write_frames(tmp_path / "a.mp4", steps, size=(64, 48))
        job = detecting.DetectionJob("a", video, tmp_path / "a.npz", seconds=seconds)
        files = detecting.Networks(tmp_path, tmp_path, "best")
        detecting._look_through(job, files, detecting.DetectionSettings(1), "key", lambda *said: None, 1)
        return read_detections(job.file)

    return run


@pytest.mark.parametrize("seconds", [None, (0.05, 0.13)])
def test_the_file_keeps_the_times_of_a_video_that_dropped_frames(found, seconds):
    uneven = found(KEPT, seconds)
    assert uneven.rate == pytest.approx(50)
    np.testing.assert_allclose(uneven.times, np.array(KEPT) / 50, atol=1e-6)
    assert found(range(8)).times is None


def test_seconds_are_looked_up_in_the_times_of_the_frames():
    video = SimpleNamespace(times=np.array(KEPT) / 50, __len__=lambda: len(KEPT))
    job = SimpleNamespace(seconds=(0.06, 0.16))
    assert detecting.seconds_of(job, video) == (3, 5)  # at 0.08 and 0.12 s
    assert detecting.seconds_of(SimpleNamespace(seconds=(-1.0, 9.0)), video) == (0, 8)


@pytest.fixture
def jobs(write_frames, tmp_path):
    """Two cameras of 60 Hz, the second 0.25 s late."""
    videos = [write_frames(tmp_path / f"{name}.mp4", range(24), rate=60, size=(64, 48)) for name in "ab"]
    offsets = 0.0, 0.25
    return [detecting.DetectionJob(v.stem, v, tmp_path / v.stem, time_offset=t) for v, t in zip(videos, offsets)]


def test_cameras_are_looked_at_at_the_same_times(jobs):
    looks = detecting._looks(jobs)
    first, second = (looks[job] for job in jobs)
    assert first.step == second.step == 4 and first.start == 0
    assert (second.start + 15) % 4 == 0, "15 images of the first before the second begins"
    part = replace(jobs[0], seconds=(0.1, 0.3))
    assert (detecting._looks([part])[part].start + 6) % 4 == 0


@pytest.mark.parametrize("offset", [None, 0.255])
def test_all_images_are_looked_at_where_cameras_do_not_take_them_together(jobs, offset):
    assert detecting._looks([jobs[0], replace(jobs[1], time_offset=offset)]) == {}


def test_videos_of_few_images_a_second_are_looked_at_throughout(write_frames, tmp_path):
    video = write_frames(tmp_path / "a.mp4", range(8), rate=20, size=(64, 48))
    assert detecting._looks([detecting.DetectionJob("a", video, tmp_path / "a.npz")]) == {}
