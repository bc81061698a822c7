"""Copies of a take's videos with all faces hidden, to keep in place of the videos."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import TakeError
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing.detecting import detection_key, jobs_of_take
from kinefit.takes.preparing.each_video import Step, Tell
from kinefit.takes.preparing.faces import HiddenVideo, ensure_faces
from kinefit.takes.preparing.take import with_detections

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
    from kinefit._files import write_text
    from kinefit.exporters.motion_file import write_detections
    from kinefit.exporters.pictures.overlay import write_pictures
    from kinefit.readers.landmarks.detections import detections_key, read_detections

    take = replace(read_take(path), hide_faces=True)
    jobs = jobs_of_take(take)
    _check(take)
    with_detections(take, progress, tell)
    heads, copies = ensure_faces(take, progress, tell), dict[str, Path]()
    for job in jobs:
        copies[job.camera] = path.parent / FOLDER / f"{job.file.stem}.mp4"
        key = detections_key(job.file)
        found = read_detections(job.file) if key is not None else None

        def of_people(frame: int, points: NDArray | None = None if found is None else found.points) -> NDArray:
            from kinefit.images.detectors.faces import head_circles

            return np.zeros((0, 3)) if points is None else head_circles(points[frame, :, :11])

        def shown(video: Video, camera: str = job.camera) -> Iterator[NDArray[np.uint8]]:
            for frame, image in enumerate(video.frames()):
                if progress:
                    progress(f"hiding {camera}", frame + 1, len(video))
                yield image

        with HiddenVideo(job.video, heads[job.camera], rate=job.rate, more=of_people) as video:
            write_pictures(shown(video), copies[job.camera], video.rate, video.size, times=video.times)
        if found is not None and key is not None:
            own, of_copy = detection_key(job), detection_key(replace(job, video=copies[job.camera]))
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
