"""Heads in the videos of a take, found once and kept beside it, and the videos, or copies, with all faces hidden.

The file, TAKE-detect/CAMERA-faces.npz, is a compressed archive of numpy arrays: `searched` and `searched_small` (N,),
frames that were looked through for heads of any and of small size; `found` (M, 5) frame, u, v, radius [px], and 1 for
those of the search for small ones; `key`, which another video does not have.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_npz, write_text, writing
from kinefit._threads import cores
from kinefit.errors import FileError, TakeError
from kinefit.images.detectors.faces import FaceDetector, head_circles
from kinefit.images.detectors.layouts import HEAD_POINTS
from kinefit.observations import Detections
from kinefit.readers.assets import MODELS_PACKAGE
from kinefit.readers.landmarks.detections import detections_key, read_detections
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.load import Observations
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing import detecting
from kinefit.takes.preparing.detecting import DetectionJob, Step, Tell, jobs_of_take, networks, seconds_of
from kinefit.takes.preparing.take import with_detections

_METHOD = "faces 1"  # raise it when other circles are found in the same video
_STEP, _SMALL_STEP = 0.1, 0.4  # [s] between frames that are searched; for small heads, which move by few pixels
_MAX_MOVE, _MAX_RATIO = 2.5, 1.6  # [radii] of a head between two frames that are searched, and of its radii then


@dataclass(frozen=True, eq=False)
class Heads:
    """Circles around the heads in a video.

    Parameters
    ----------
    searched, searched_small : (N,) frames, increasing
    found : (M, 5)
        Frame, middle u, v and radius [px], and 1 of a small head, else 0.
    """

    searched: NDArray
    searched_small: NDArray
    found: NDArray

    def at(self, frame: int) -> NDArray | None:
        """(N, 3) [px] circles of a frame, those of the two searched before it and after it; None: not searched."""
        reach = np.diff(self.searched).max(initial=1)
        if not len(self.searched) or not -reach <= frame - self.searched[0] <= np.ptp(self.searched) + reach:
            return None
        circles = [np.zeros((0, 3))]
        for small, searched in enumerate((self.searched, self.searched_small)):
            last = int(np.searchsorted(searched, frame, "right")) - 1
            found = self.found[self.found[:, 4] == small]
            near = {int(f): found[found[:, 0] == f, 1:4] for f in searched[max(last - 1, 0) : last + 3]}
            circles += near.values()
            if 0 <= last < len(searched) - 1:
                before, after = (int(f) for f in searched[last : last + 2])
                circles.append(_between(near[before], near[after], (frame - before) / (after - before)))
        return np.concatenate(circles)


def _between(a: NDArray, b: NDArray, share: float) -> NDArray:
    """Circles on the way from those of one frame to those of another that they may have become."""
    pairs = [
        (one, two) for one in a for two in b
        if np.linalg.norm(one[:2] - two[:2]) < _MAX_MOVE * min(one[2], two[2])
        and max(one[2], two[2]) < _MAX_RATIO * min(one[2], two[2])
    ]  # fmt: skip
    return np.array([[*(one + share * (two - one))[:2], max(one[2], two[2])] for one, two in pairs]).reshape(-1, 3)


class HiddenVideo(Video):
    """A video whose images have all faces hidden.

    Parameters
    ----------
    path, rate : see `Video`
    heads : Heads
    more : called with a frame: further circles (N, 3) [px] around heads in it, such as of keypoints
    """

    def __init__(
        self, path: Path, heads: Heads, *, rate: float | None = None,
        more: Callable[[int], NDArray] = lambda frame: np.zeros((0, 3)),
    ) -> None:  # fmt: skip
        super().__init__(path, rate=rate)
        self._heads, self._more = heads, more

    def read(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB, upright, with all faces hidden; all of it where it was not searched."""
        from kinefit.exporters.pictures.drawing import hide_all, hide_circles

        image, circles = super().read(i), self._heads.at(i)
        return hide_all(image) if circles is None else hide_circles(image, np.concatenate([circles, self._more(i)]))


def shown_video(take: Take, seen: Observations, camera: str, *, find: bool = True) -> Video:
    """A camera's video as images for others show it: with faces hidden, where the take says so.

    Without `find`, videos in which faces were not looked for yet are blurred as a whole.

    Raises
    ------
    KinefitError
        As `ensure_faces`.
    """
    path = seen.videos[camera]
    if not take.hide_faces:
        return Video(path, rate=seen.rate)
    none = Heads(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 5)))
    heads = ensure_faces(take, cameras=(camera,), find=find).get(camera, none)
    offset = next(entry.time_offset for entry in take.cameras if entry.name == camera)

    def of_keypoints(frame: int) -> NDArray:
        circles = [np.zeros((0, 3))]
        for keypoints in seen.keypoints:
            if keypoints.camera == camera:
                at = round((video.times[frame] + offset - keypoints.time_offset) * keypoints.rate)
                uv = seen.images[camera].from_calibration(keypoints.points[max(at - 1, 0) : max(at + 2, 0)])
                circles.append(_heads_of(keypoints.names, uv.reshape(-1, *uv.shape[2:])))
        return np.concatenate(circles)

    video = HiddenVideo(path, heads, rate=seen.rate, more=of_keypoints)
    return video


def _heads_of(names: Sequence[str], points: NDArray) -> NDArray:
    """Circles (N, 3) u, v, radius [px] around the heads of people, by their points (P, K, 2) [px] of these names."""
    named = [k for k, name in enumerate(names) if HEAD_POINTS.search(name.lower())]
    return head_circles(points[:, named]) if named else np.zeros((0, 3))


def ensure_faces(
    take: Take, progress: Step | None = None, tell: Tell = lambda text: None, *,
    cameras: Collection[str] | None = None, find: bool = True,
) -> dict[str, Heads]:  # fmt: skip
    """{camera: Heads} of the videos of a take, or of some of its cameras.

    Heads are looked for where that was not done yet; without `find`, these videos are missing.

    Raises
    ------
    ObservationError
        The extra `detect` is not installed.
    AssetError, FileError, ExportError
        What fetching the networks, reading a video and writing the file raise.
    """
    chosen = [job for job in jobs_of_take(take) if cameras is None or job.camera in cameras]
    jobs = {job: _seconds_key(job, f"{MODELS_PACKAGE} {_METHOD}") for job in chosen}
    todo = [job for job, key in jobs.items() if find and _read(_file(job), key) is None]
    if todo:
        folder, threads = networks(progress, tell).folder, max(cores() // len(todo), 1)

        def work(job: DetectionJob, step: Step) -> None:
            _write(find_faces(job, threads=threads, folder=folder, step=step), _file(job), jobs[job])

        with detecting.hushed():
            FaceDetector(folder)
        detecting.each_video(todo, work, progress, of=len(jobs))
    found = {job.camera: _read(_file(job), key) for job, key in jobs.items()}
    return {camera: heads for camera, heads in found.items() if heads is not None}


def _seconds_key(job: DetectionJob, method: str) -> str:
    return detecting.video_key(job.video, job.rate, f"{method} {job.seconds or ''}")


def _file(job: DetectionJob) -> Path:
    return job.file.with_name(f"{job.file.stem}-faces.npz")


def find_faces(job: DetectionJob, *, threads: int = 1, folder: Path | None = None, step: Step | None = None) -> Heads:
    """Look through the frames of a video that a take uses; `folder` is that of the networks."""
    detect = FaceDetector(folder or networks(None, lambda text: None).folder, threads)
    with Video(job.video, rate=job.rate) as video:
        first, last = seconds_of(job, video)
        small = _grid(first, last, video.rate * _SMALL_STEP)
        searched = sorted({*_grid(first, last, video.rate * _STEP), *small})
        found = [np.zeros((0, 5))]
        for number, frame in enumerate(searched):
            if step:
                step(f"faces {job.camera}", number, len(searched))
            circles = detect(video.read(frame), small=frame in small)
            found.append(np.column_stack([np.full(len(circles), frame), circles]))
        if step:
            step(f"faces {job.camera}", len(searched), len(searched))
    return Heads(np.array(searched), np.array(small), np.concatenate(found))


def _grid(first: int, last: int, every: float) -> list[int]:
    """Frames from `first` to the one before `last`, both among them."""
    return sorted({*range(first, last, max(round(every), 1)), last - 1}) if last > first else []


def _write(heads: Heads, path: Path, key: str) -> None:
    with writing(path) as temporary:
        np.savez_compressed(
            temporary, key=np.array(key), searched=heads.searched, searched_small=heads.searched_small,
            found=heads.found.astype(np.float32),
        )  # fmt: skip


def _read(path: Path, key: str) -> Heads | None:
    """What is kept of a video; None where there is nothing, or of another video."""
    try:
        arrays = read_npz(path, remedy="")
        if str(arrays["key"]) != key:
            return None
        return Heads(arrays["searched"], arrays["searched_small"], arrays["found"].astype(float))
    except (FileError, KeyError, ValueError):
        return None


_VIDEO = re.compile(r'^video = "[^"\n]*"', re.M)
FOLDER = "hidden-faces"
"""Beside the take file: where the copies lie."""


def hide_in_copies(path: Path, progress: Step | None, tell: Tell) -> list[Path]:
    """Write copies of a take's videos with all faces hidden, and let the take file name these; returns them.

    Keypoints are detected in the videos themselves before, where the take has none, and kept as those of the copies.

    Raises
    ------
    TakeError
        A video is not a file, or has an odd number of rows or columns.
    KinefitError
        As `ensure_faces`, `with_detections`.
    """
    from kinefit.exporters.motion_file import write_detections
    from kinefit.exporters.pictures.overlay import write_pictures

    take = replace(read_take(path), hide_faces=True)
    jobs = jobs_of_take(take)
    _check(take)
    with_detections(take, progress, tell)
    heads, copies = ensure_faces(take, progress, tell), dict[str, Path]()
    for job in jobs:
        copies[job.camera] = path.parent / FOLDER / f"{job.file.stem}.mp4"
        key = detections_key(job.file)
        found = read_detections(job.file) if key is not None else None

        def of_people(frame: int, found: Detections | None = found) -> NDArray:
            return _heads_of(found.names, found.points[frame]) if found else np.zeros((0, 3))

        def shown(video: Video, camera: str = job.camera) -> Iterator[NDArray[np.uint8]]:
            for frame, image in enumerate(video.frames()):
                if progress:
                    progress(f"hiding {camera}", frame + 1, len(video))
                yield image

        with HiddenVideo(job.video, heads[job.camera], rate=job.rate, more=of_people) as video:
            write_pictures(shown(video), copies[job.camera], video.rate, video.size, times=video.times)
        if found is not None and key is not None:
            own, of_copy = detecting.detection_key(job), detecting.detection_key(replace(job, video=copies[job.camera]))
            write_detections(found, job.file, key=key.replace(own, of_copy, 1))
    names = iter([f"{FOLDER}/{copies[camera.name].name}" for camera in take.cameras if camera.video is not None])
    write_text(path, _VIDEO.sub(lambda line: f'video = "{next(names)}"', path.read_text("utf-8")))
    return list(copies.values())


def _check(take: Take) -> None:
    """Refuse videos that cannot be copied as they are."""
    for camera in take.cameras:
        if camera.video is not None and not camera.video.is_file():
            problem = "--hide-faces copies only video files, not images in folders or recordings"
            remedy = "Convert them to videos first."
            raise TakeError(problem, file=take.path, place=f"camera {camera.name}", remedy=remedy)
        if camera.video is not None:
            with Video(camera.video) as video:
                if video.size[0] % 2 or video.size[1] % 2:
                    problem = f"the video has {video.size[0]} x {video.size[1]} px; copies need even numbers"
                    raise TakeError(problem, file=camera.video, remedy="Set hide_faces = true in [take] instead.")
