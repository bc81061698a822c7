"""Cameras that go away and come back, videos at their own speed."""

import time

import cv2
import numpy as np
import pytest
from tests.studio.live.taking import image, taken

from kinefit.errors import FileError
from kinefit.studio.live import cameras
from kinefit.studio.live.cameras import CameraStream, Inbox, SessionClock, VideoReplay


class Webcam:
    """Stands for `cv2.VideoCapture`: three images, then it is unplugged; opened for the third time it is back."""

    opened = 0

    def __init__(self, stream):
        type(self).opened += 1
        self.stream, self.left = stream, 3 if type(self).opened != 2 else 0
        self.there = type(self).opened != 2

    def isOpened(self):
        return self.there

    def set(self, *_):
        return True

    def read(self):
        time.sleep(0.02)
        self.left -= 1
        return (True, image(100 + self.opened)) if self.left >= 0 else (False, None)

    def release(self):
        self.there = False


def test_a_webcam_that_goes_away_is_opened_again(monkeypatch):
    monkeypatch.setattr(Webcam, "opened", 0)
    monkeypatch.setattr(cameras.cv2, "VideoCapture", Webcam)
    monkeypatch.setattr(cameras, "_RECONNECT_INTERVAL_S", 0.01)
    inbox = Inbox(["cam"], patience=0.0)
    stream = CameraStream("cam", "0", (64, 48), SessionClock())
    stream.start(inbox)
    values, until = set(), time.monotonic() + 20.0
    while not {101, 103} <= values and time.monotonic() < until:
        values |= {int(one.seen[0, 0, 0]) for one in inbox.take(0.1)}
    stream.stop()
    assert {101, 103} <= values and Webcam.opened >= 3


def test_a_stream_that_is_not_there_is_told(tmp_path):
    with pytest.raises(FileError, match="cannot be opened"):
        CameraStream("cam", str(tmp_path / "nothing.sdp"), (64, 48), SessionClock())


@pytest.fixture
def video(tmp_path):
    for k in range(6):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image(10 * k))
    return tmp_path


def test_a_patient_replay_brings_all_images_with_their_times(video):
    inbox = Inbox(["cam"], patience=0.0)
    replay = VideoReplay("cam", video, SessionClock(), rate=20.0, offset=0.5, speed=0.0)
    replay.start(inbox)
    seen = taken(inbox, 6)
    assert [int(one.seen[0, 0, 0]) for one in seen] == [0, 10, 20, 30, 40, 50]
    assert np.allclose([one.time for one in seen], 0.5 + np.arange(6) / 20.0)
    replay.stop()


def test_a_replay_keeps_its_own_speed(video):
    inbox, begin = Inbox(["cam"], patience=0.0), time.monotonic()
    replay = VideoReplay("cam", video, SessionClock(), rate=20.0)
    replay.start(inbox)
    while not inbox.over:
        inbox.take(0.1)
    assert time.monotonic() - begin >= 0.25  # the sixth image is due after five twentieths of a second
    assert inbox.came == {"cam": 6}
