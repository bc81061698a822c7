"""Copies of the videos with faces hidden take their place in a take; its keypoints are of the videos themselves."""


import numpy as np
import pytest

from kinefit.errors import TakeError
from kinefit.exporters.motion_file import write_detections
from kinefit.observations import Detections
from kinefit.readers.take.file import read_take
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing import detecting, faces
from kinefit.takes.preparing.faces import FOLDER, hide_in_copies


class SeesMiddle:
    """A detector that sees a head in the middle of every image."""

    def __init__(self, folder, threads=1):
        pass

    def __call__(self, image, *, small=False):
        return np.array([[image.shape[1] / 2, image.shape[0] / 2, 30.0, 0.0]])


def look(job, networks, settings, key, tell, threads):
    """One person whose face is near the upper left corner."""
    with Video(job.video) as video:
        frames, size = len(video), video.size
    points = np.tile(np.linspace([60.0, 60.0], [80.0, 70.0], 33), (frames, 1, 1, 1))
    nothing = np.zeros(0, np.uint32), np.zeros(frames + 1, int)
    write_detections(Detections(job.camera, 30.0, size, points, np.ones(points.shape[:3]), *nothing), job.file, key=key)


@pytest.fixture
def take(copy_take, tmp_path, monkeypatch):
    networks = detecting.Networks(tmp_path, tmp_path, "best")
    monkeypatch.setattr("kinefit.takes.preparing.faces.FaceDetector", SeesMiddle)
    monkeypatch.setattr("kinefit.images.detectors.box_detector.Models", lambda *given, **more: None)
    monkeypatch.setattr(detecting, "networks", lambda *given: networks)
    monkeypatch.setattr(faces, "networks", lambda *given: networks)
    monkeypatch.setattr(detecting, "_look_through", look)
    path = copy_take(tmp_path / "take")
    text = path.read_text()
    path.write_text(text[: text.index("[[keypoints]]")])
    return path


def test_copies_take_the_place_of_the_videos_and_nothing_is_detected_in_them(take, monkeypatch):
    before = read_take(take)
    copies = hide_in_copies(take, None, print)
    after = read_take(take)
    assert [camera.video for camera in after.cameras] == copies and all(FOLDER in path.parts for path in copies)
    with Video(before.cameras[0].video) as own, Video(copies[0]) as copy:
        assert len(own) == len(copy) and own.size == copy.size and own.rate == copy.rate
        width, height = own.size
        one, other = (video.read(3).astype(int) for video in (own, copy))
    off = np.abs(one - other).max(axis=2)
    assert np.median(off) < 6 and off[height // 2 - 20 : height // 2 + 20, width // 2 - 20 : width // 2 + 20].max() > 20
    monkeypatch.setattr(detecting, "_look_through", lambda *given: pytest.fail("detected in the copies"))
    jobs = detecting.jobs_of_take(after)
    assert detecting.detect(jobs, tell=print) == []


def test_images_in_folders_are_refused(take):
    folder = take.with_name("images")
    folder.mkdir()
    text = take.read_text()
    first = text.index('video = "')
    end = text.index("\n", first)
    take.write_text(text[:first] + 'video = "images"' + text[end:])
    with pytest.raises(TakeError, match="copies only video files"):
        hide_in_copies(take, None, print)
