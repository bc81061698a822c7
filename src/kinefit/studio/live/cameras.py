"""Cameras as live sources: webcams, network streams, and videos at their own speed; people in their images."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.geometry.camera import ImageFrame
from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.following import Follower, PersonDetection
from kinefit.observations import MEDIAPIPE_33, Keypoints
from kinefit.observations.detections import in_calibration
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing.detecting import Networks

SILENT_AFTER_S = 1.0
"""Time without a frame after which a sensor is reported as silent, and the session no longer waits for it."""


@dataclass(frozen=True, eq=False)
class Arrived:
    """A frame of one sensor.

    Parameters
    ----------
    sensor : str
    time : float [s] of the measurement, on the session's clock
    at : float [s] of the arrival, on the clock `time.monotonic`
    seen : frames for the tracker, records of keypoints of one frame, or an image (H, W, 3) uint8 RGB
    """

    sensor: str
    time: float
    at: float
    seen: Any


class Inbox:
    """One slot for each sensor: a new frame replaces one that was not taken, which is counted as dropped.

    Parameters
    ----------
    sensors : names of all sensors
    patience : float [s] to wait for the other sensors after the first frame: half a frame interval

    Attributes
    ----------
    dropped : {sensor: int}, frames replaced before they were taken
    came : {sensor: int}, arrived frames
    """

    def __init__(self, sensors: Sequence[str], *, patience: float) -> None:
        self.patience = patience
        self.dropped, self.came = dict.fromkeys(sensors, 0), dict.fromkeys(sensors, 0)
        self._slots: dict[str, Arrived] = {}
        self._last: dict[str, float] = dict.fromkeys(sensors, -float("inf"))
        self._open = set(sensors)  # sensors that have not ended
        self._error: KinefitError | None = None
        self._changed = threading.Condition()

    def put(self, frame: Arrived, *, wait: bool = False) -> bool:
        """Put a frame into its slot; `wait` for a free slot instead of replacing. False if the inbox is closed."""
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: frame.sensor not in self._slots or frame.sensor not in self._open)
            if frame.sensor not in self._open:
                return False
            if frame.sensor in self._slots:
                self.dropped[frame.sensor] += 1
            if not any(self.came.values()):  # at the start, wait for all sensors
                self._last = dict.fromkeys(self._last, frame.at)
            self._slots[frame.sensor], self._last[frame.sensor] = frame, frame.at
            self.came[frame.sensor] += 1
            self._changed.notify_all()
            return True

    def lose(self, sensor: str) -> None:
        """Count a frame that arrived and was discarded by its source."""
        with self._changed:
            self.came[sensor] += 1
            self.dropped[sensor] += 1

    def end(self, sensor: str, error: KinefitError | None = None) -> None:
        """End a sensor; an error ends the session."""
        with self._changed:
            self._open.discard(sensor)
            self._error = self._error or error
            self._changed.notify_all()

    def close(self) -> None:
        """Close the inbox, and release the sources that wait for a free slot."""
        with self._changed:
            self._open.clear()
            self._slots.clear()
            self._changed.notify_all()

    @property
    def over(self) -> bool:
        """Whether the inbox is empty and all sensors have ended."""
        with self._changed:
            return not (self._open or self._slots or self._error)

    def silent(self) -> list[str]:
        """Sensors that have not ended, without a frame for `SILENT_AFTER_S`."""
        now = time.monotonic()
        with self._changed:
            return [name for name in self._last if name in self._open and now - self._last[name] > SILENT_AFTER_S]

    def take(self, timeout: float) -> list[Arrived]:
        """Take all frames, once each active sensor has one, or after `patience`; `timeout` [s] for the first.

        Raises
        ------
        KinefitError
            The error with which a sensor ended.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._slots or not self._open or self._error, max(timeout, 0.0))
            if self._error is not None:
                raise self._error
            if self._slots:
                first = min(frame.at for frame in self._slots.values())
                until = max(first + self.patience, time.monotonic())
                while self._awaited() and (left := until - time.monotonic()) > 0.0:
                    self._changed.wait(left)
            out = list(self._slots.values())
            self._slots.clear()
            self._changed.notify_all()
            return out

    def _awaited(self) -> bool:
        now = time.monotonic()
        longest = max(SILENT_AFTER_S, self.patience)
        active = (name for name in self._open if now - self._last[name] <= longest)
        return any(name not in self._slots for name in active)


_RECONNECT_INTERVAL_S = 1.0


class SessionClock:
    """Clock of a session: 0 when its first source starts."""

    def __init__(self) -> None:
        self._start: float | None = None
        self._lock = threading.Lock()

    def now(self) -> float:
        """Time [s] since the first call of any source."""
        with self._lock:
            if self._start is None:
                self._start = time.monotonic()
            return time.monotonic() - self._start


class ThreadSource:
    """A source of one sensor, in its own thread."""

    def __init__(self, name: str, clock: SessionClock) -> None:
        self.name, self.clock = name, clock
        self.sensors: tuple[str, ...] = (name,)
        self.patient = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, inbox: Inbox) -> None:
        """Start putting frames into the inbox."""
        self._thread = threading.Thread(target=self._guarded, args=(inbox,), daemon=True, name=self.name)
        self._thread.start()

    def stop(self) -> None:
        """Stop putting frames into the inbox."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)

    def _guarded(self, inbox: Inbox) -> None:
        error = None
        try:
            self._run(inbox)
        except KinefitError as raised:
            error = raised
        finally:
            inbox.end(self.name, error)

    def _run(self, inbox: Inbox) -> None:
        raise NotImplementedError


class CameraSource(ThreadSource):
    """A source of one camera's images of a size (width, height) [px]."""

    def __init__(self, name: str, size: tuple[int, int], clock: SessionClock) -> None:
        super().__init__(name, clock)
        self.size = size

    def _put(self, inbox: Inbox, image: NDArray[np.uint8], when: float, *, wait: bool = False) -> bool:
        if image.shape[1::-1] != self.size:
            raise ObservationError(
                f"images have {image.shape[1]}x{image.shape[0]} px instead of {self.size[0]}x{self.size[1]}",
                place=f"camera {self.name}", remedy="Set the camera to this size, or set size and image in [[camera]].",
            )  # fmt: skip
        return inbox.put(Arrived(self.name, when, time.monotonic(), image), wait=wait)


class CameraStream(CameraSource):
    """A webcam by its number, or a network stream by its address; reconnects after an interruption.

    Parameters
    ----------
    name : of the camera in the rig
    stream : "0", "1", ... or an address such as "rtsp://..."
    size : (width, height) [px] of its images
    clock : SessionClock of the session

    Raises
    ------
    FileError
        It cannot be opened at the start.
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
            received, image = self._capture.read() if self._capture is not None else (False, None)
            if received:
                if not self._put(inbox, cv2.cvtColor(image, cv2.COLOR_BGR2RGB), self.clock.now()):
                    break
                continue
            if self._capture is not None:
                self._capture.release()
            if self._stop.wait(_RECONNECT_INTERVAL_S):
                break
            self._capture = self._opened()
        if self._capture is not None:
            self._capture.release()


class VideoReplay(CameraSource):
    """A recorded video at its own speed, or as fast as the session takes its images.

    Parameters
    ----------
    name : of the camera
    video, rate : path; rate [Hz] of a folder of images
    offset : float [s] time of its first frame on the take's clock
    speed : float, 1 for its own; 0: as fast as the session takes the images, without drops
    frames : (start, stop) of the video; default: all
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
        """Frame rate [Hz]."""
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
                if not self._put(inbox, image, when, wait=not self.speed):
                    return


SET = "MEDIAPIPE_33"


class LiveDetector:
    """Detector of the keypoints of all people in the newest images of some cameras.

    Parameters
    ----------
    networks : files of the networks
    images : {camera: ImageFrame} from the calibration's image to the camera's
    rate : float [Hz] of images, about
    people : largest number of tracked people in each camera
    threads : int, in parallel
    """

    def __init__(
        self, networks: Networks, images: Mapping[str, ImageFrame], *, rate: float, people: int = 1, threads: int = 2
    ) -> None:
        self.images, self.rate = dict(images), rate
        share = max(threads // max(len(self.images), 1), 1)
        self._followers = {
            name: Follower(Models(networks.folder, share, networks.landmarks), rate, people, masks=False)
            for name in self.images
        }
        self._pool = ThreadPoolExecutor(min(threads, max(len(self.images), 1)))
        cv2.setNumThreads(1)

    def __call__(self, arrived: Sequence[Arrived]) -> list[Keypoints]:
        """Records of one frame each, in the order of the images."""
        return list(self._pool.map(self._one, arrived))

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _one(self, image: Arrived) -> Keypoints:
        return as_keypoints(
            self._followers[image.sensor].update(image.seen), image.sensor, image.time, self.rate,
            self.images[image.sensor],
        )


def as_keypoints(
    seen: Sequence[PersonDetection], camera: str, time: float, rate: float, image: ImageFrame
) -> Keypoints:
    """Keypoints of all people in one image, in the calibration's image frame; time [s], rate [Hz]."""
    count = len(seen), len(MEDIAPIPE_33)
    uv = np.array([s.points for s in seen]).reshape(*count, 2)
    confidence = np.array([s.confidence for s in seen]).reshape(count)
    points, lifted = in_calibration(uv, np.array([s.lifted for s in seen]).reshape(*count, 3), image)
    return Keypoints(
        camera, SET, MEDIAPIPE_33, rate, points[None], confidence[None], time_offset=time,
        lifted=None if lifted is None else lifted[None],
    )  # fmt: skip
