"""Live sessions of `kinefit live` in processes of their own, each with its page at an address that is known.

The cameras of this computer: find them, write their take file, and record videos to calibrate them.
"""

from __future__ import annotations

import queue
import secrets
import socket
import threading
import time
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular, write_text
from kinefit.errors import KinefitError, ObservationError
from kinefit.exporters.pictures.overlay import write_pictures
from kinefit.exporters.take_text import quoted, with_keys
from kinefit.readers.guess.folder import guess_take
from kinefit.readers.take.cameras import is_uncalibrated, read_rig
from kinefit.readers.take.checks import streams_of
from kinefit.readers.take.file import read_take
from kinefit.studio.app.folders import takes_below
from kinefit.studio.app.jobs import Job, JobQueue
from kinefit.studio.live.cameras import Arrived, Inbox, SessionClock
from kinefit.studio.live.take import camera_source, stream_size
from kinefit.studio.serving import TOKEN_VARIABLE
from kinefit.studio.serving.access import Access
from kinefit.takes.missing import cameras_file, last_found
from kinefit.takes.preparing.detecting import hushed

_HOST, _CONNECT_TIMEOUT_S = "127.0.0.1", 0.2


def followable(root: Path) -> dict[Path, bool]:
    """{take file: whether its sensors have streams} of the takes below a folder whose cameras' places are known.

    Those without streams are replayed.
    """
    found = {}
    for take in takes_below(root):
        try:
            read = read_take(take.file)
            if not is_uncalibrated(last_found(read)):
                found[take.file] = bool(streams_of(read))
        except KinefitError:
            continue
    return dict(sorted(found.items(), key=lambda item: not item[1]))


def found_cameras(root: Path) -> list[Path]:
    """Files of cameras that were found from the people in the takes below a folder."""
    return [file for take in takes_below(root) if (file := cameras_file(take.file)).is_file()]


def start_live(jobs: JobQueue, take: Path) -> Job:
    """Follow a take live in a folder of its own, at the same time as the queue."""
    out = take.with_name(f"{take.stem}-live-{time.strftime('%Y%m%d-%H%M%S')}")
    with socket.create_server((_HOST, 0)) as server:
        port = server.getsockname()[1]
    command = ("live", str(take), "--out", str(out), "--port", str(port))
    return jobs.start_session(take, command, {TOKEN_VARIABLE: secrets.token_urlsafe(18)})


def page_of(job: Job) -> str:
    """Address of the page of a live session, with its token."""
    return Access(token=job.environment[TOKEN_VARIABLE]).url(int(_option(job, "--port")))


def is_up(job: Job) -> bool:
    """Whether the page of a live session answers."""
    try:
        socket.create_connection((_HOST, int(_option(job, "--port"))), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError:
        return False
    return True


def recorded_take(job: Job) -> Path | None:
    """The take file that a live session left; None if there is none."""
    file = Path(_option(job, "--out")) / "take.toml"
    return file if file.is_file() else None


def _option(job: Job, name: str) -> str:
    return job.command[job.command.index(name) + 1]


NUMBERS = range(4)
"""Numbers of cameras that are tried."""

_OPEN_TIMEOUT_S = 8.0  # for all cameras together; a driver that hangs is left alone
_RATE = 30.0  # [Hz] of webcams, about: each image has its own time
_MAX_WAITING_IMAGES = 60  # of a camera that are not written yet; further ones are dropped


@dataclass(frozen=True, eq=False)
class Webcam:
    """A camera of this computer that gives images.

    Parameters
    ----------
    number : int, its `stream` in a take
    image : (H, W, 3) uint8 RGB, what it sees
    """

    number: int
    image: NDArray[np.uint8]

    @property
    def name(self) -> str:
        """Name in take files, and of its videos."""
        return f"webcam{self.number}"


def find_webcams(numbers: Iterable[int] = NUMBERS) -> list[Webcam]:
    """Cameras that can be opened now, in the order of their numbers."""
    found: dict[int, Webcam] = {}

    def look(number: int) -> None:
        capture = cv2.VideoCapture(number)
        received, image = capture.read() if capture.isOpened() else (False, None)
        capture.release()
        if received:
            found[number] = Webcam(number, np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8))

    threads = [threading.Thread(target=look, args=(number,), daemon=True) for number in numbers]
    with hushed():  # OpenCV warns of each number without a camera
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(_OPEN_TIMEOUT_S / len(threads))
    return [found[number] for number in sorted(found)]


def write_live_take(root: Path, sizes: Mapping[int, tuple[int, int]], calibration: Path | None = None) -> Path:
    """Write the take file of cameras of this computer, in a folder of their own; what is there already stays.

    Parameters
    ----------
    root : folder of the session
    sizes : {number: (width, height) [px]}
    calibration : of several cameras, with their names; one alone needs none

    Raises
    ------
    ExportError, FileError, TakeError
        The file cannot be written, or it is not valid.
    """
    folder = root / "-".join(("webcams", *map(str, sizes)))
    file = folder / "take.toml"
    text = regular(file).read_text("utf-8") if file.exists() else "[take]\n"
    text = text if file.exists() else with_keys(text, "take", None, {"name": '"live"', "rate": f"{_RATE}", "up": '"z"'})
    if calibration is not None:
        text = with_keys(text, "calibration", None, {"file": quoted(calibration.as_posix())})
    for k, (number, size) in enumerate(sizes.items()):
        keys = {"name": quoted(f"webcam{number}"), "stream": quoted(str(number)), "size": str(list(size))}
        text = with_keys(text, "camera", k, keys)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(file, text)
    read_take(file)
    return file


class Recorder(Inbox):
    """Records the cameras of a take that have streams: a video of each, and the take file of these.

    Parameters
    ----------
    take_file : Path, whose cameras are recorded
    folder : Path of the videos

    Raises
    ------
    KinefitError
        The take cannot be read, or a stream cannot be opened.
    """

    def __init__(self, take_file: Path, folder: Path) -> None:
        take, clock = read_take(take_file), SessionClock()
        self.folder = folder
        rig, cameras = read_rig(take), [entry for entry in take.cameras if entry.stream is not None]
        super().__init__([entry.name for entry in cameras], patience=0.0)
        self._images: dict[str, queue.Queue] = {e.name: queue.Queue(_MAX_WAITING_IMAGES) for e in cameras}
        self._times: dict[str, list[float]] = {entry.name: [] for entry in cameras}
        self._problem: Exception | None = None
        folder.mkdir(parents=True, exist_ok=True)
        sizes = {entry.name: stream_size(entry, rig, take) for entry in cameras}
        self._sources = [camera_source(entry, sizes[entry.name], take, clock) for entry in cameras]
        self._writing = [threading.Thread(target=self._write, args=item, daemon=True) for item in sizes.items()]
        for thread in self._writing:
            thread.start()
        for source in self._sources:
            source.start(self)

    def put(self, frame: Arrived, *, wait: bool = False) -> bool:
        """Queue an image of a camera; it is dropped while too many wait to be written."""
        if self._images[frame.sensor].full():
            self.lose(frame.sensor)
        else:
            self._times[frame.sensor].append(frame.time)
            self._images[frame.sensor].put(frame.seen)
        return frame.sensor in self._open

    @property
    def count(self) -> int:
        """Number of images so far, of the camera with fewest."""
        return min(map(len, self._times.values()), default=0)

    def stop(self) -> Path:
        """End the recording; returns the folder, whose take file is written. Call it in a thread.

        Raises
        ------
        KinefitError
            A camera failed, or a video cannot be written.
        """
        for source in self._sources:
            source.stop()
        for images in self._images.values():
            images.put(None)
        for thread in self._writing:
            thread.join()
        if self._error is not None:
            raise self._error
        if not self.count:
            problem, remedy = "a camera sent no image", "Check that no other program uses it."
            raise ObservationError(problem, file=self.folder, remedy=remedy)
        if self._problem is not None:
            raise self._problem
        write_text(self.folder / "take.toml", self._text())
        return self.folder

    def _text(self) -> str:
        """The guessed take file, with the time of each video's first image."""
        text = guess_take(self.folder).text
        for k, camera in enumerate(tomllib.loads(text)["camera"]):
            text = with_keys(text, "camera", k, {"time_offset": f"{self._offset(camera['name']):.4f}"})
        return text

    def _offset(self, name: str) -> float:
        return self._times[name][0] - min(times[0] for times in self._times.values() if times)

    def _write(self, name: str, size: tuple[int, int]) -> None:
        width, height = (side - side % 2 for side in size)  # the encoder wants even sides

        def images() -> Iterator[NDArray[np.uint8]]:
            while (image := self._images[name].get()) is not None:
                yield image[:height, :width]

        try:
            write_pictures(images(), self.folder / f"{name}.mp4", _RATE, (width, height), times=self._times[name])
        except (KinefitError, OSError) as error:
            self._problem = error
