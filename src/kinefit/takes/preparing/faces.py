"""Heads in the videos of a take, found once and kept beside it, and the videos with all faces hidden.

The file, TAKE-detect/CAMERA-faces.npz, is a compressed archive of numpy arrays: `searched` and `searched_small` (N,),
frames that were looked through for heads of any and of small size; `found` (M, 5) frame, u, v, radius [px], and 1 for
those of the search for small ones; `key`, which another video does not have.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_npz
from kinefit._threads import cores
from kinefit.errors import FileError
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing.detecting import DetectionJob, jobs_of_take, networks, seconds_of
from kinefit.takes.preparing.each_video import Step, Tell, each_video, video_key

if TYPE_CHECKING:
    from kinefit.readers.take.file import Take
    from kinefit.readers.take.load import Observations

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
        from kinefit.images.detectors.faces import head_circles
        from kinefit.images.detectors.layouts import HEAD_POINTS

        circles = [np.zeros((0, 3))]
        for keypoints in seen.keypoints:
            if keypoints.camera == camera:
                named = [k for k, name in enumerate(keypoints.names) if HEAD_POINTS.search(name.lower())]
                at = round((video.times[frame] + offset - keypoints.time_offset) * keypoints.rate)
                near = keypoints.points[max(at - 1, 0) : max(at + 2, 0), :, named]
                uv = seen.images[camera].from_calibration(near)
                circles += [head_circles(uv.reshape(-1, len(named), 2))] if named else []
        return np.concatenate(circles)

    video = HiddenVideo(path, heads, rate=seen.rate, more=of_keypoints)
    return video


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
    from kinefit.readers.assets import MODELS_PACKAGE

    chosen = [job for job in jobs_of_take(take) if cameras is None or job.camera in cameras]
    jobs = {job: _seconds_key(job, f"{MODELS_PACKAGE} {_METHOD}") for job in chosen}
    todo = [job for job, key in jobs.items() if find and _read(_file(job), key) is None]
    if todo:
        from kinefit.images.detectors.faces import FaceDetector
        from kinefit.takes.preparing.detecting import hushed

        folder, threads = networks(progress, tell).folder, max(cores() // len(todo), 1)

        def work(job: DetectionJob, step: Step) -> None:
            _write(find_faces(job, threads=threads, folder=folder, step=step), _file(job), jobs[job])

        with hushed():
            FaceDetector(folder)
        each_video(todo, work, progress, of=len(jobs))
    found = {job.camera: _read(_file(job), key) for job, key in jobs.items()}
    return {camera: heads for camera, heads in found.items() if heads is not None}


def _seconds_key(job: DetectionJob, method: str) -> str:
    return video_key(job.video, job.rate, f"{method} {job.seconds or ''}")


def _file(job: DetectionJob) -> Path:
    return job.file.with_name(f"{job.file.stem}-faces.npz")


def find_faces(job: DetectionJob, *, threads: int = 1, folder: Path | None = None, step: Step | None = None) -> Heads:
    """Look through the frames of a video that a take uses; `folder` is that of the networks."""
    from kinefit.images.detectors.faces import FaceDetector

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
    from kinefit._files import writing

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
