"""Live sources of files: folders that another program fills, one file a frame, and recordings played again."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kinefit._pictures import read_picture
from kinefit.errors import FileError, ObservationError
from kinefit.fitting.tracking.recording import Recording
from kinefit.geometry.camera import ImageFrame
from kinefit.observations import DepthFrame, Keypoints
from kinefit.readers.depth.images import PICTURES, counts_of, depth_picture, natural
from kinefit.readers.landmarks.keypoints import read_openpose
from kinefit.studio.live.cameras import Arrived, Inbox, SessionClock, ThreadSource

_POLL_INTERVAL_S = 0.005
_MIN_FILE_AGE_S = 0.05  # since a change was last seen, of a complete file
_FOLDER_TIME_RESOLUTION_S = 2.0  # within which a folder may change twice under one time: FAT's, the coarsest
_DEFAULT_COUNT = 0.001  # [m] of a 16-bit count


class FolderSource(ThreadSource):
    """Source of a folder to which another program adds one file a frame, read in the order of their numbers.

    Files that exist at the start are ignored. Of several new files only the last is read; the others, and unreadable
    ones, count as dropped.

    Parameters
    ----------
    name : of the sensor
    folder : Path
    endings : of the files, such as ".png"
    clock : SessionClock of the session

    Raises
    ------
    FileError
        No such folder.
    """

    def __init__(self, name: str, folder: Path, endings: tuple[str, ...], clock: SessionClock) -> None:
        super().__init__(name, clock)
        self.folder, self.endings = folder, endings
        if not folder.is_dir():
            raise FileError("no such folder", file=folder, place=name, remedy="Create it, or correct stream.")
        self._known = {entry.name for entry in os.scandir(folder)}
        self._changed: tuple[float, float] = -1.0, 0.0  # time of the folder's last change, and our clock's then
        self._waiting: dict[str, tuple[tuple[int, int], float]] = {}  # size and time of a file, and our clock's then

    def read(self, path: Path, when: float) -> Any:
        """The content of a file, for the tracker; None if it cannot be read. Subclasses implement it.

        Raises
        ------
        NotImplementedError
            In this base class.
        """
        raise NotImplementedError

    def _run(self, inbox: Inbox) -> None:
        while not self._stop.wait(_POLL_INTERVAL_S):
            fresh = self._new()
            for _ in fresh[:-1]:
                inbox.lose(self.name)
            for path in fresh[-1:]:
                when = self.clock.now()
                seen = self.read(path, when)
                if seen is None:
                    inbox.lose(self.name)
                elif not inbox.put(Arrived(self.name, when, time.monotonic(), seen)):
                    return

    def _new(self) -> list[Path]:
        """New complete files; lists the folder only if it has changed lately, or has incomplete files.

        Times of files are compared with each other alone: they may be of another computer's clock.
        """
        now, fresh, present = time.monotonic(), list[str](), set[str]()
        try:
            if (changed := os.stat(self.folder).st_mtime) != self._changed[0]:
                self._changed = changed, now
            elif not self._waiting and now - self._changed[1] > _FOLDER_TIME_RESOLUTION_S:
                return []
            entries = list(os.scandir(self.folder))
        except OSError as error:
            problem, remedy = f"the folder can no longer be read ({error.strerror})", "Create it again."
            raise FileError(problem, file=self.folder, place=self.name, remedy=remedy) from error
        waiting, self._waiting = self._waiting, {}
        for entry in entries:
            present.add(entry.name)
            if entry.name in self._known or not entry.name.lower().endswith(self.endings):
                continue
            try:
                if not entry.is_file():
                    continue
                found = os.stat(entry.path)  # Windows' list has the size of when the file was opened
            except FileNotFoundError:  # deleted meanwhile
                continue
            state = found.st_size, found.st_mtime_ns
            former, since = waiting.get(entry.name, (state, now))
            since = since if state == former else now
            if now - since >= _MIN_FILE_AGE_S:
                fresh.append(entry.name)
            else:
                self._waiting[entry.name] = state, since
        self._known = (self._known & present) | set(fresh)
        return [self.folder / name for name in sorted(fresh, key=natural)]


class ImageFolderStream(FolderSource):
    """Source of images (PNG, JPEG) of a camera of a size (width, height) [px], for the detector."""

    def __init__(self, name: str, folder: Path, size: tuple[int, int], clock: SessionClock) -> None:
        super().__init__(name, folder, (".png", ".jpg", ".jpeg"), clock)
        self.size = size

    def read(self, path: Path, when: float) -> Any:
        """(H, W, 3) uint8 RGB image.

        Raises
        ------
        ObservationError
            An image of another size.
        """
        try:
            image = read_picture(path)
        except FileError:
            return None
        check_size(image.shape[1::-1], self.size, path, f"camera {self.name}")
        return image


class DepthFolderStream(FolderSource):
    """Source of depth images of one sensor: PNG or TIFF of 16 bits, or float TIFF in metres.

    Parameters
    ----------
    unit : float [m] of a count; default: 0.001 for 16 bits, 1 for float
    size : (width, height) [px]
    near, far : [m] range of depths; measurements outside are discarded
    """

    def __init__(
        self, name: str, folder: Path, size: tuple[int, int], clock: SessionClock, *, unit: float | None = None,
        near: float = 0.0, far: float = np.inf,
    ) -> None:  # fmt: skip
        super().__init__(name, folder, PICTURES, clock)
        self.size, self.unit, self.near, self.far = size, unit, near, far

    def read(self, path: Path, when: float) -> Any:
        """A list of one `DepthFrame`, image (H, W) [m]; `when` [s].

        Raises
        ------
        ObservationError
            An image of another size, or no depth image.
        """
        try:
            image = depth_picture(path)
        except FileError:
            return None
        check_size(image.shape[::-1], self.size, path, f"depth {self.name}")
        counts = _DEFAULT_COUNT if image.dtype == np.uint16 else 1.0
        depth = counts_of(image) * np.float32(self.unit or counts)
        depth[~((depth >= self.near) & (depth <= self.far))] = 0.0
        return [DepthFrame(self.name, when, depth)]


class KeypointFolderStream(FolderSource):
    """Source of OpenPose's JSON files of one camera.

    Parameters
    ----------
    keypoint_set : of `readers.keypoint_sets.KEYPOINT_SETS`
    rate : float [Hz], about
    image : ImageFrame of their coordinates, if it is not the calibration's
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        clock: SessionClock,
        *,
        keypoint_set: str,
        rate: float,
        image: ImageFrame | None = None,
    ) -> None:
        super().__init__(name, folder, (".json",), clock)
        self.keypoint_set, self.rate, self.image = keypoint_set, rate, image

    def read(self, path: Path, when: float) -> Any:
        """A list of one record of keypoints, of all people in view; `when` [s].

        Raises
        ------
        ObservationError
            Another number of keypoints than the set has.
        """
        try:
            return [read_openpose(
                path, camera=self.name, rate=self.rate, keypoint_set=self.keypoint_set, time_offset=when,
                image_frame=self.image,
            )]  # fmt: skip
        except FileNotFoundError:
            return None
        except ObservationError as error:
            if isinstance(error.__cause__, msgspec.DecodeError | UnicodeDecodeError):
                return None
            raise


def check_size(size: tuple[int, ...], wanted: tuple[int, int], path: Path, place: str) -> None:
    """Check the size (width, height) [px] of an image.

    Raises
    ------
    ObservationError
        Another size.
    """
    if tuple(size) != tuple(wanted):
        problem = f"images have {size[0]}x{size[1]} px instead of {wanted[0]}x{wanted[1]}"
        remedy = "Set the camera to this size, or calibrate it at its present size."
        raise ObservationError(problem, file=path, place=place, remedy=remedy)


REPLAY = "replay"
"""Name of the sensor that stands for all sensors of a replayed take."""


class Replay(ThreadSource):
    """Source of the steps of a recording, each with the frames of all sensors.

    Parameters
    ----------
    recording : Recording of all sensors but the keypoints' detectors
    keypoints : records of all people in view, of as many frames as the recording has steps
    speed : float, 1 for the recording's own; 0: as fast as the session takes the steps, without drops
    """

    def __init__(self, recording: Recording, keypoints: Sequence[Keypoints], *, speed: float = 1.0) -> None:
        super().__init__(REPLAY, SessionClock())
        self.recording, self.keypoints, self.speed = recording, tuple(keypoints), speed
        self.patient = not speed

    def seen(self, step: int) -> list[Any]:
        """The frames of all sensors at a step."""
        own = [k.rows(slice(step, step + 1), float(k.times[step])) for k in self.keypoints]
        return [*self.recording.steps(step), *own]

    def _run(self, inbox: Inbox) -> None:
        times, start = self.recording.times, time.monotonic()
        for step in range(len(times)):
            due = start + float(times[step] - times[0]) / self.speed if self.speed else start
            if self._stop.wait(max(due - time.monotonic(), 0.0)):
                return
            arrived = Arrived(REPLAY, float(times[step]), time.monotonic(), self.seen(step))
            if not inbox.put(arrived, wait=not self.speed):
                return
