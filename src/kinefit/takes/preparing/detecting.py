"""The built-in detector over the videos of several cameras at once: side by side, kept, not done twice."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from glob import escape
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular, writing
from kinefit._threads import cores
from kinefit.errors import AssetError, FileError, TakeError
from kinefit.images.detectors import box_detector
from kinefit.images.detectors.detection import LOOK_RATE, Adder, detect_people
from kinefit.images.detectors.faces import FaceFinder, FaceModels, HandFollower, HandModels
from kinefit.images.detectors.networks import TopDownModels
from kinefit.observations.detections import WITH_HANDS
from kinefit.readers.assets import MODELS_CREDIT, MODELS_PACKAGE, detector_models, landmark_models
from kinefit.readers.landmarks.detections import detections_file, detections_key
from kinefit.readers.landmarks.networks import description_file, is_blazepose, open_people, open_points
from kinefit.readers.take.cameras import is_uncalibrated
from kinefit.readers.take.entries import CameraEntry
from kinefit.readers.take.file import Take
from kinefit.readers.videos.video import Video

Step = Callable[[str, int, int], None]
"""Called with what is done, how much of it is done, and how much there is (0: unknown)."""

Tell = Callable[[str], None]
"""Called with what is worth saying."""

_ENDS = 2**20  # [bytes] of a video's begin and end by which it is recognised
J = TypeVar("J")


def each_video(jobs: Sequence[J], work: Callable[[J, Step], None], progress: Step | None, *, of: int) -> None:
    """Do the work on each video, as many at a time as there are cores.

    Parameters
    ----------
    work : called with a job and what tells its progress, which raises where another job failed or Ctrl-C came
    of : how many videos there are, with those that are done already

    Raises
    ------
    KeyboardInterrupt
        With how many are done, which are kept.
    """
    stop, lock = threading.Event(), threading.Lock()

    def step(camera: str, done: int, total: int) -> None:
        if stop.is_set():
            raise _Stopped
        if progress:
            with lock:
                progress(camera, done, total)

    with _one_thread_each(), ThreadPoolExecutor(min(len(jobs), cores())) as pool:
        futures = [pool.submit(work, job, step) for job in jobs]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        except KeyboardInterrupt as stopped:
            kept = of - len(jobs) + sum(future.done() for future in futures)
            message = f"{kept} of {of} videos are done. Run the same command to continue with the others."
            raise KeyboardInterrupt(message) from stopped
        finally:  # after an error, or Ctrl-C: those that run end at their next picture
            stop.set()
            for future in futures:
                future.cancel()
    for future in done:
        future.result()


class _Stopped(Exception):
    """Another camera failed, or Ctrl-C came."""


def video_key(path: Path, rate: float | None, method: str) -> str:
    """Text that another video, or another method, does not have; `rate` [Hz] is that of images in a folder.

    Raises
    ------
    FileError
        The video cannot be read.
    """
    from kinefit.readers.videos.video import images_in

    digest, size = hashlib.sha256(), 0
    images = images_in(path) if path.is_dir() or "*" in path.name else []
    try:
        for part in images or [path]:
            with part.open("rb") as file:
                length = file.seek(0, os.SEEK_END)
                for start in (0, max(0, length - _ENDS // max(1, len(images)))):
                    file.seek(start)
                    digest.update(file.read(_ENDS // max(1, len(images))))
            size += length
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror})", file=path, remedy="Check the path.") from error
    if images:
        digest.update(f"{len(images)} {rate}".encode())
    return f"{digest.hexdigest()[:32]} {size} {method}"


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """OpenCV without threads of its own: the cameras run side by side."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


PEOPLE = 3
"""How many people are followed at most in one camera, by default."""

_LARGE_NETWORK = "pose_landmark_heavy.tflite"
QUALITIES = {"balanced": "pose_landmark_full.tflite", "auto": _LARGE_NETWORK, "best": _LARGE_NETWORK}
"""Landmark networks: the larger, the nearer to the joints, and the slower. "auto" does not look at every image."""

QUALITY = "best"
"""Of new detections, where none is asked for."""

_MAX_STEP_ERROR = 0.02  # [frames] between images that two cameras take together
_METHOD = "3"  # raise it when the detector gives other numbers for the same video


@dataclass(frozen=True)
class DetectionJob:
    """One video to look through.

    Parameters
    ----------
    camera : str
    video : Path
    file : Path
        Of the detections.
    rate : float [Hz], optional
        Of a video that is a folder of images.
    seconds : (start, stop) [s] of the video that are looked through; default: all of it
    time_offset : float [s], when its first image is taken on the clock of all cameras; None where that is unknown
    looks : images, from the first one looked through, that are looked at for certain; default: by the quality
    """

    camera: str
    video: Path
    file: Path
    rate: float | None = None
    seconds: tuple[float, float] | None = None
    time_offset: float | None = 0.0
    looks: range | None = None


@dataclass(frozen=True)
class DetectionSettings:
    """What is detected; None: as in a file of detections that is there, else the default.

    Parameters
    ----------
    people : int
        Largest number at a time; default: `PEOPLE`.
    masks, hands, face : bool
        Whether these are detected too; default: no.
    quality : str or Path
        One of `QUALITIES`, or the file of a landmark network of one's own; default: `QUALITY`.
    detector : Path
        File of a detector of people of one's own; default: the built-in one.
    """

    people: int | None = None
    masks: bool | None = None
    hands: bool | None = None
    face: bool | None = None
    quality: str | Path | None = None
    detector: Path | None = None


DEFAULT_SETTINGS = DetectionSettings()


@dataclass(frozen=True)
class Networks:
    """Files of the detector's networks.

    Parameters
    ----------
    folder : Path
        Of the built-in networks, where any is used.
    landmarks : Path
        The network that sees their landmarks.
    name : str
        Of its quality, or what tells a file of one's own from others.
    mirrored : bool
        Whether each crop is looked at a second time, mirrored.
    detector : Path, optional
        A network of one's own that finds people.
    """

    folder: Path
    landmarks: Path
    name: str
    mirrored: bool = False
    detector: Path | None = None

    @property
    def is_own(self) -> bool:
        """Whether the landmarks are those of a file of one's own, whatever its kind."""
        return self.name not in QUALITIES

    def models(self, threads: int = 1) -> box_detector.Models | TopDownModels:
        """The networks, loaded; not to be shared between threads.

        Raises
        ------
        ObservationError
            The extra `detect`, or `onnx`, is not installed.
        FileError, PluginError
            A network that cannot be used.
        """
        if self.is_own and not is_blazepose(self.landmarks):
            points, layout = open_points(self.landmarks, threads)
            people: Any
            if self.detector:
                people = open_people(self.detector, threads, layout.size[1] / layout.size[0])
            else:
                file = self.folder / box_detector.DETECTOR
                people = box_detector.PersonDetector(box_detector.interpreter(file, threads))
            return TopDownModels(points, layout, people, mirrored=self.mirrored)
        more = {"people": open_people(self.detector, threads)} if self.detector else {}
        return box_detector.Models(self.folder, threads, self.landmarks, mirrored=self.mirrored, **more)


def jobs_of_take(take: Take) -> list[DetectionJob]:
    """Every camera of a take that has a video; TakeError where none has."""
    rate, clocks_unknown = _rate(take) if take.frames else 0.0, is_uncalibrated(take)
    found = [
        DetectionJob(
            c.name, c.video, detections_file(take.path, c.name), take.rate, _seconds(take, c, rate),
            None if clocks_unknown else c.time_offset,
        ) for c in take.cameras if c.video is not None
    ]  # fmt: skip
    if not found:
        raise TakeError(
            "no camera of the take has a video", file=take.path, remedy='Add video = "..." to its [[camera]] entries.'
        )
    return found


def _rate(take: Take) -> float:
    """Rate [Hz] of a take's steps: its own, or the highest of its videos'."""
    rates = [take.rate or 0.0]
    for camera in take.cameras if take.rate is None else ():
        if camera.video is not None:
            with Video(camera.video) as video:
                rates.append(video.rate)
    return max(rates)


def _seconds(take: Take, camera: CameraEntry, rate: float) -> tuple[float, float] | None:
    """Of a camera's video that lie in the take's frames, a step more at both ends."""
    if take.frames is None:
        return None
    start, stop = take.frames
    return (start - 1) / rate - camera.time_offset, (stop + 1) / rate - camera.time_offset


def detect(
    jobs: Sequence[DetectionJob], settings: DetectionSettings = DEFAULT_SETTINGS, *, force: bool = False,
    progress: Step | None = None, tell: Tell,
) -> list[DetectionJob]:  # fmt: skip
    """Look through the videos whose file is not there yet, or is of another video or other settings; returns these.

    Every file is written as soon as its video is done, so that what was interrupted goes on with the others.
    """
    keys = {job: detection_key(job) for job in jobs}
    if settings.quality is None:  # what is done anew is done as before
        stored = (detections_key(job.file, "network") for job in jobs)
        before = next((Path(file) for file in stored if file and Path(file).is_file()), None)
    else:
        before = None
    wanted = {**asdict(settings), "quality": settings.quality and _name_of(settings.quality)}
    wanted["detector"] = settings.detector and _name_of(settings.detector)
    if not force:
        for job in jobs:
            _from_beside(job, keys[job], wanted)
    todo = [job for job in jobs if force or not _fits(detections_key(job.file), keys[job], wanted, job.seconds)]
    if not todo:
        return []
    files = _alone(settings, before) or networks(progress, tell, settings.quality or before or QUALITY)
    files = replace(files, detector=settings.detector)
    if files.name != "balanced" and len(jobs) == 1:  # depths of one camera gain by it; several give the same motion
        files = replace(files, mirrored=True)
    s = settings
    full = DetectionSettings(PEOPLE if s.people is None else s.people, bool(s.masks), bool(s.hands), bool(s.face))
    threads = max(cores() // len(todo), 1)  # cameras run side by side; what cores are left help them
    looks = _looks(jobs) if files.name == "auto" else {}

    def work(job: DetectionJob, step: Step) -> None:
        key = f"{keys[job]} {_settings(full, job.seconds)}"
        key += f"{' mirrored=True' * files.mirrored} quality={files.name}"
        key += f" detector={wanted['detector']}" if files.detector else ""
        _look_through(replace(job, looks=looks.get(job)), files, full, key, step, threads)

    with hushed():
        models = files.models()
    if files.is_own:
        has_hands = models.layout.keypoint_set in WITH_HANDS
        missing = ["masks"] if full.masks and not models.layout.has_masks else []
        missing += ["hands"] if full.hands and not has_hands else []
        for what in missing:
            tell(f"No {what} are added to the points of {files.landmarks.name}.")
    each_video(todo, work, progress, of=len(jobs))
    return todo


def _alone(settings: DetectionSettings, before: Path | None) -> Networks | None:
    """Networks of one's own with which no built-in one is used, nor fetched; None for others."""
    own = settings.quality or before
    if not settings.detector or settings.hands or settings.face or not isinstance(own, Path) or is_blazepose(own):
        return None
    return Networks(own.parent, own, _name_of(own))


def _from_beside(job: DetectionJob, key: str, wanted: Mapping[str, object]) -> None:
    """Copy what another take of the same folder found in the same video already."""
    if _fits(detections_key(job.file), key, wanted, job.seconds):
        return
    for other in sorted(job.file.parent.parent.glob(f"*-detect/{escape(job.file.name)}")):
        if _fits(detections_key(other), key, wanted, job.seconds):
            with writing(job.file) as temporary:
                shutil.copyfile(other, temporary)
            return


def seconds_of(job: DetectionJob, video: Video) -> tuple[int, int]:
    """Frames (first, stop) of a video that are looked through."""
    if job.seconds is None:
        return 0, len(video)
    first, stop = (int(k) for k in np.searchsorted(video.times, np.array(job.seconds) - 1e-6))
    return first, stop


def _looks(jobs: Sequence[DetectionJob]) -> dict[DetectionJob, range]:
    """Images of each video, from the first one looked through, that are looked at for certain: of all cameras at once.

    Empty, so that all are looked at, where the cameras do not take their images together, or that is not known.
    """
    rates, firsts = [], []
    for job in jobs:
        with Video(job.video, rate=job.rate) as video:
            ahead = np.nan if job.time_offset is None or video.unevenness else job.time_offset * video.rate
            rates.append(video.rate)
            firsts.append(ahead + seconds_of(job, video)[0])  # on the common clock, in steps
    step, off = max(round(rates[0] / LOOK_RATE), 1), np.subtract(firsts, np.rint(firsts))
    if step == 1 or not (np.allclose(rates, rates[0], rtol=1e-3) and np.all(np.abs(off) < _MAX_STEP_ERROR)):
        return {}
    return {job: range(-round(first) % step, sys.maxsize, step) for job, first in zip(jobs, firsts)}


def _look_through(
    job: DetectionJob, files: Networks, settings: DetectionSettings, key: str, tell: Step, threads: int
) -> None:

    from kinefit.exporters.motion_file import write_detections  # all exporters, which take their time to import

    models, folder = files.models(threads), files.folder
    with Video(job.video, rate=job.rate) as video:
        first, last = seconds_of(job, video)

        def counted(images: Iterable[NDArray]) -> Iterator[NDArray]:
            for number, image in enumerate(images):
                tell(job.camera, number, last - first)
                yield image
            tell(job.camera, last - first, last - first)

        adders: dict[Literal["hands", "face"], Adder] = {}
        if settings.hands and models.layout.keypoint_set in WITH_HANDS:
            adders["hands"] = HandFollower(HandModels(folder, threads), layout=models.layout)
        if settings.face:
            adders["face"] = FaceFinder(FaceModels(folder, threads), models.layout)
        found = detect_people(
            counted(video.frames(first, last)), models, camera=job.camera, rate=video.rate,
            people=settings.people or 0, masks=bool(settings.masks), adders=adders, looks=job.looks,
        )  # fmt: skip
        times = video.times if video.unevenness else None
        found = replace(found.within(first, len(video)), times=times, source=str(job.video))
        if files.is_own:
            found = replace(found, network=str(files.landmarks.absolute()))
    write_detections(found, job.file, key=key)


def networks(progress: Step | None, tell: Tell, quality: str | Path = "balanced") -> Networks:
    """The networks of a quality, or with a landmark network of one's own; their licence is shown as they are fetched.

    Where the large one cannot be fetched, that of "balanced", which comes with the one that finds people, stands in for
    it, and says so.
    """
    box_detector.litert_interpreter()
    fetched: list[int] = []

    def report(done: int, total: int) -> None:
        if not fetched:
            tell(f"Downloading the networks of the built-in detector, once: {MODELS_CREDIT}.")
        fetched.append(done)
        if progress:
            progress("download MB", done // 10**6, total // 10**6)

    folder = detector_models(report)
    if isinstance(quality, Path):
        return Networks(folder, quality, _name_of(quality))
    if QUALITIES[quality] == box_detector.LANDMARKS:
        return Networks(folder, folder / box_detector.LANDMARKS, quality)
    try:
        return Networks(folder, landmark_models(report) / QUALITIES[quality], quality)
    except AssetError as error:
        tell(f"{error} Until then, the network of quality 'balanced' is used.")
        return Networks(folder, folder / box_detector.LANDMARKS, "balanced")


def _name_of(quality: str | Path) -> str:
    """Name that distinguishes results by quality, or by the network's file and those of its weights and description."""
    if isinstance(quality, str):
        return quality
    try:
        digest = hashlib.sha256()
        for part in regular(quality), Path(f"{quality}.data"), Path(f"{quality}_data"), description_file(quality):
            if part == quality or part.is_file():
                with part.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
    except OSError as error:
        raise FileError(f"cannot be read ({error.strerror})", file=quality, remedy="Check its path.") from error
    return digest.hexdigest()[:16]


def detection_key(job: DetectionJob) -> str:
    """Begin of the key of a video's detections: text that another video, or another detector, does not have."""
    return video_key(job.video, job.rate, f"{MODELS_PACKAGE} {_METHOD}")


def _settings(s: DetectionSettings, seconds: tuple[float, float] | None) -> str:
    part = "" if seconds is None else " seconds={}:{}".format(*seconds)
    return f"people={s.people} masks={s.masks}{' hands=True' * bool(s.hands)}{' face=True' * bool(s.face)}{part}"


def _fits(
    found: str | None, key: str, wanted: Mapping[str, object], seconds: tuple[float, float] | None
) -> bool:
    """Whether what was found is of this video and of the settings that matter, those that are not None."""
    if found is None or not found.startswith(key + " "):
        return False
    stated = dict(part.split("=") for part in found[len(key) + 1 :].split())
    settings = {"quality": "balanced", "hands": "False", "face": "False", **stated}
    first, last = (float(s) for s in settings.get("seconds", "-inf:inf").split(":"))
    start, stop = seconds or (-np.inf, np.inf)
    if not first <= start <= stop <= last:
        return False
    return all(value is None or settings.get(name) == str(value) for name, value in wanted.items())


@contextmanager
def hushed() -> Iterator[None]:
    """Discard what LiteRT writes to stderr outside of Python: a message on how it runs, amid the progress."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
