"""Cameras as sources: webcams and network streams, and videos at their own speed."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.live.inbox import Arrived, Inbox
from kinefit.readers.video import Video

_AGAIN = 1.0  # [s] between attempts to open a camera that went away


class SessionClock:
    """The session's: 0 when its first source starts."""

    def __init__(self) -> None:
        self._start: float | None = None
        self._lock = threading.Lock()

    def now(self) -> float:
        """Time since then [s]."""
        with self._lock:
            if self._start is None:
                self._start = time.monotonic()
            return time.monotonic() - self._start


class ThreadSource:
    """A source of one sensor, in a thread of its own."""

    def __init__(self, name: str, clock: SessionClock) -> None:
        self.name, self.clock = name, clock
        self.sensors: tuple[str, ...] = (name,)
        self.patient = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, inbox: Inbox) -> None:
        """Bring what is seen from now on."""
        self._thread = threading.Thread(target=self._guarded, args=(inbox,), daemon=True, name=self.name)
        self._thread.start()

    def stop(self) -> None:
        """Bring nothing more."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def _guarded(self, inbox: Inbox) -> None:
        error = None
        try:
            self._run(inbox)
        except KinefitError as wrong:
            error = wrong
        finally:
            inbox.end(self.name, error)

    def _run(self, inbox: Inbox) -> None:
        raise NotImplementedError


class CameraSource(ThreadSource):
    """A source of one camera's images of a size (width, height) [px]."""

    def __init__(self, name: str, size: tuple[int, int], clock: SessionClock) -> None:
        super().__init__(name, clock)
        self.size = size

    def _bring(self, inbox: Inbox, image: NDArray[np.uint8], when: float, *, wait: bool = False) -> bool:
        if image.shape[1::-1] != self.size:
            raise ObservationError(
                f"images of {image.shape[1]}x{image.shape[0]} px, expected are {self.size[0]}x{self.size[1]}",
                place=f"camera {self.name}", remedy="Set the camera to that size, or state size and image in the take.",
            )  # fmt: skip
        return inbox.put(Arrived(self.name, when, time.monotonic(), image), wait=wait)


class CameraStream(CameraSource):
    """A webcam by its number, or a network stream by its address; one that goes away is opened again when it is back.

    Parameters
    ----------
    name : of the camera in the rig
    stream : "0", "1", ... or an address such as "rtsp://..."
    size : (width, height) [px] of its images
    clock : SessionClock of the session

    Raises
    ------
    FileError
        It cannot be opened to begin with.
    """

    def __init__(self, name: str, stream: str, size: tuple[int, int], clock: SessionClock) -> None:
        super().__init__(name, size, clock)
        self.stream = stream
        self._capture = self._opened()
        if self._capture is None:
            remedy = "Check that it is connected and that no other program uses it."
            raise FileError(f"the stream {stream} cannot be opened", place=f"camera {name}", remedy=remedy)

    def _opened(self) -> Any:
        capture = cv2.VideoCapture(int(self.stream) if self.stream.isdecimal() else self.stream)
        if not capture.isOpened():
            return None
        if self.stream.isdecimal():
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.size[1])
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        return capture

    def _run(self, inbox: Inbox) -> None:
        while not self._stop.is_set():
            there, image = self._capture.read() if self._capture is not None else (False, None)
            if there:
                if not self._bring(inbox, cv2.cvtColor(image, cv2.COLOR_BGR2RGB), self.clock.now()):
                    break
                continue
            if self._capture is not None:
                self._capture.release()
            if self._stop.wait(_AGAIN):
                break
            self._capture = self._opened()
        if self._capture is not None:
            self._capture.release()


class VideoReplay(CameraSource):
    """A recorded video at its own speed, or as fast as its images are taken.

    Parameters
    ----------
    name : of the camera
    video : path, and its `rate` where it is a folder of images
    offset : float [s] of its first frame on the take's clock
    speed : 1 for its own; 0 as fast as they are taken, and none is dropped
    frames : (start, stop) of the video that are shown; default: all
    """

    def __init__(
        self, name: str, video: Path, clock: SessionClock, *, rate: float | None = None, offset: float = 0.0,
        speed: float = 1.0, frames: tuple[int, int] | None = None,
    ) -> None:  # fmt: skip
        self._video = Video(video, rate=rate)
        super().__init__(name, self._video.size, clock)
        self.offset, self.speed, self.patient = offset, speed, not speed
        self.frames = frames or (0, len(self._video))

    @property
    def rate(self) -> float:
        """Frames a second [Hz]."""
        return self._video.rate

    def _run(self, inbox: Inbox) -> None:
        start, stop = self.frames
        with self._video as video:
            for k, image in enumerate(video.frames(start, stop)):
                time, first = float(video.times[start + k]), float(video.times[start])
                when = self.offset + time
                due = (time - first + max(self.offset, 0.0)) / self.speed if self.speed else 0.0
                if self._stop.wait(max(due - self.clock.now(), 0.0)):
                    return
                if not self._bring(inbox, image, when, wait=not self.speed):
                    return
