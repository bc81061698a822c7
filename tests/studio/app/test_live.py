"""Live sessions beside the queue, and the cameras of this computer."""

import asyncio
import threading
import time
import urllib.request

import cv2
import numpy as np
import pytest
from tests.studio.viewers.recordings import write_take

from kinefit.errors import FileError, ObservationError
from kinefit.readers.take.file import read_take
from kinefit.readers.videos.video import Video
from kinefit.studio.app import live as webcams
from kinefit.studio.app.jobs import DONE, PAUSED, JobQueue
from kinefit.studio.app.live import (
    Recorder,
    find_webcams,
    followable,
    found_cameras,
    is_up,
    page_of,
    recorded_take,
    start_live,
    write_live_take,
)

STUDIO = '[take]\nname = "studio"\nrate = 30.0\nup = "z"\n'


def camera(folder, name):
    (folder / name).mkdir(parents=True, exist_ok=True)
    return f'[[camera]]\nname = "{name}"\nstream = "{name}"\nsize = [64, 48]\n'


def test_takes_with_streams_come_first_and_uncalibrated_ones_not_at_all(tmp_path):
    (tmp_path / "a").mkdir()
    write_take(tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "take.toml").write_text(STUDIO + camera(tmp_path / "b", "one"))
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "take.toml").write_text(STUDIO + '[[camera]]\nname = "x"\n[[camera]]\nname = "y"\n')
    (tmp_path / "c" / "take-cameras.toml").touch()
    assert found_cameras(tmp_path) == [tmp_path / "c" / "take-cameras.toml"]
    assert list(followable(tmp_path).items()) == [
        (tmp_path / "b" / "take.toml", True), (tmp_path / "a" / "take.toml", False)
    ]  # fmt: skip


def test_a_session_shows_its_page_and_ends_when_it_is_told_to(copy_take, tmp_path):
    take = copy_take(tmp_path / "drawn")

    async def scenario():
        queue = JobQueue()
        job = start_live(queue, take)
        while job.is_open and not await asyncio.to_thread(is_up, job):
            await asyncio.sleep(0.1)
        answer = await asyncio.to_thread(urllib.request.urlopen, page_of(job), timeout=30)
        policy = answer.headers["Content-Security-Policy"]
        assert not any(job.environment["KINEFIT_TOKEN"] in word for word in job.command)
        await asyncio.sleep(0.5)
        job.pause()
        await queue.close()
        return queue, job, policy

    queue, job, policy = asyncio.run(asyncio.wait_for(scenario(), 300.0))
    assert job.state in (DONE, PAUSED) and job.error is None and queue.sessions == [job] and not queue.jobs
    assert "frame-ancestors http://localhost:*" in policy
    out = take.with_name(job.command[job.command.index("--out") + 1].rpartition("/")[2])
    assert not list(out.glob("*.unfinished")) and recorded_take(job) is None  # keypoints are recorded already


class Capture:
    """In place of cv2.VideoCapture: number 1 gives an image, 2 hangs, others are not there."""

    def __init__(self, number):
        self.number = number

    def isOpened(self):
        if self.number == 2:
            threading.Event().wait(20.0)
        return self.number == 1

    def read(self):
        return True, np.full((48, 64, 3), (10, 20, 30), np.uint8)

    def release(self):
        pass


def test_cameras_are_found_though_one_hangs(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    monkeypatch.setattr(webcams, "_OPEN_TIMEOUT_S", 0.8)
    begun = time.monotonic()
    (found,) = find_webcams()
    assert (found.number, found.name) == (1, "webcam1") and found.image[0, 0].tolist() == [30, 20, 10]
    assert time.monotonic() - begun < 10.0


def test_a_take_of_webcams_is_written_and_what_its_user_wrote_stays(tmp_path):
    file = write_live_take(tmp_path, {0: (640, 480), 2: (1280, 720)})
    read = read_take(file)
    assert [(c.name, c.stream, c.size) for c in read.cameras] == [
        ("webcam0", "0", (640, 480)), ("webcam2", "2", (1280, 720))
    ]  # fmt: skip
    assert read.rate == 30.0 and read.calibration is None
    file.write_text(file.read_text().replace("[take]\n", "[take]\nheight = 1.8\n"))
    (tmp_path / "walk-cameras.toml").write_text("")
    assert write_live_take(tmp_path, {0: (640, 480), 2: (1280, 720)}, tmp_path / "walk-cameras.toml") == file
    assert read_take(file).height == 1.8 and read_take(file).calibration.file == tmp_path / "walk-cameras.toml"


def test_streams_are_recorded_as_videos_with_their_clocks(tmp_path):
    (tmp_path / "take.toml").write_text(STUDIO + camera(tmp_path, "left") + camera(tmp_path, "right"))
    recorder = Recorder(tmp_path / "take.toml", tmp_path / "walk")
    for k in range(12):
        for name in ("left", "right") if k else ("left",):  # the right one begins later
            part = tmp_path / name / "part"
            cv2.imwrite(str(part) + ".png", np.full((48, 64, 3), 20 * k, np.uint8))
            (tmp_path / name / "part.png").rename(tmp_path / name / f"{k:03}.png")
        time.sleep(0.15)
    until = time.monotonic() + 30.0
    while recorder.count < 8 and time.monotonic() < until:
        time.sleep(0.05)
    assert recorder.stop() == tmp_path / "walk"
    read = read_take(tmp_path / "walk" / "take.toml")
    assert [entry.video.name for entry in read.cameras] == ["left.mp4", "right.mp4"]
    assert read.cameras[0].time_offset == 0.0 and 0.02 < read.cameras[1].time_offset < 5.0
    with Video(tmp_path / "walk" / "left.mp4") as video:
        assert len(video) >= 8 and video.times[-1] > 1.0 and video.read(len(video) - 1).mean() > 100


def test_a_recording_without_images_or_camera_is_an_error(tmp_path):
    (tmp_path / "take.toml").write_text(STUDIO + camera(tmp_path, "left"))
    recorder = Recorder(tmp_path / "take.toml", tmp_path / "walk")
    with pytest.raises(ObservationError, match="no image"):
        recorder.stop()
    (tmp_path / "take.toml").write_text(STUDIO + '[[camera]]\nname = "x"\nstream = "97"\nsize = [64, 48]\n')
    with pytest.raises(FileError, match="cannot be opened"):
        Recorder(tmp_path / "take.toml", tmp_path / "walk")
