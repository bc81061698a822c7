"""Images for the pages: scaled, unrecognisable where faces are hidden; one of each person of a take."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import KinefitError, TrackingError
from kinefit.exporters.report.page import scaled
from kinefit.fitting.multiview.people import PersonTrack
from kinefit.readers.landmarks.detections import detections_key
from kinefit.readers.take.cameras import is_uncalibrated
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.load import Observations
from kinefit.readers.videos.video import Video
from kinefit.takes.batch.results import silent
from kinefit.takes.in_view import people_in_view
from kinefit.takes.missing import cameras_file, last_found, prepared
from kinefit.takes.preparing.detecting import detection_key, jobs_of_take
from kinefit.takes.preparing.faces import shown_video

_JPEG_QUALITY = 85
_HIDDEN_PX = 24  # longer side of an image in which no face can be recognised


def jpeg(image: NDArray[np.uint8], longest: int) -> bytes:
    """An RGB image (H, W, 3) as JPEG, its longer side scaled down to at most `longest` [px]."""
    small = scaled(image, longest)
    return cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def unrecognisable(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same image, as blurred as it must be before faces have been looked for."""
    size = image.shape[1], image.shape[0]
    return np.asarray(cv2.resize(scaled(image, _HIDDEN_PX), size, interpolation=cv2.INTER_CUBIC), np.uint8)


class ShownVideos:
    """The videos of a take as they may be shown, each opened when it is first asked for.

    Where faces are hidden and were not looked for yet, images are blurred as a whole.
    """

    def __init__(self, take: Take, seen: Observations) -> None:
        self._take, self._seen, self._open = take, seen, dict[str, Video]()

    def __call__(self, camera: str) -> Video:
        """The video of a camera."""
        if camera not in self._open:
            self._open[camera] = shown_video(self._take, self._seen, camera, find=False)
        return self._open[camera]

    def close(self) -> None:
        """Close all of them."""
        for video in self._open.values():
            video.close()


_MARGIN = 0.15  # of a person's height around the keypoints: head and feet reach beyond them
_MIN_CONFIDENCE = 0.5  # of a keypoint that counts


@dataclass(frozen=True, eq=False)
class PersonPicture:
    """A person as a camera sees it best.

    Parameters
    ----------
    number : int, from 1, as `person` in the take has it
    image : (H, W, 3) uint8 RGB
    """

    number: int
    image: NDArray[np.uint8]


class PeoplePictures:
    """Pictures of the people of takes, kept until a take or what was detected in it changes."""

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[object, ...], tuple[PersonPicture, ...]]] = {}
        self._working = threading.Lock()

    def of(self, take: Path, *, hide_faces: bool) -> tuple[PersonPicture, ...]:
        """Pictures of all people of a take file if there are several and they are detected already. Slow at first."""
        with self._working:
            made_from = hide_faces, *_files_of(take)
            if self._known.get(take, ((),))[0] != made_from:
                self._known[take] = made_from, people_pictures(take, hide_faces=hide_faces)
            return self._known[take][1]

    def known(self, take: Path, number: int, *, hide_faces: bool) -> NDArray[np.uint8] | None:
        """The image of one person if `of` has found it."""
        made_from, pictures = self._known.get(take, ((None,), ()))
        if made_from[0] is not hide_faces:
            return None
        return next((picture.image for picture in pictures if picture.number == number), None)


def _files_of(take: Path) -> list[tuple[str, int]]:
    folder = take.with_name(f"{take.stem}-detect")
    files = [cameras_file(take), *sorted(folder.glob("*.npz"))]
    return [(file.name, file.stat().st_mtime_ns) for file in files if file.exists()]


def people_pictures(take_file: Path, *, hide_faces: bool) -> tuple[PersonPicture, ...]:
    """A picture of each person of a take; none of one alone, nor before people and cameras are found. Detects nothing.

    Parameters
    ----------
    take_file : Path
    hide_faces : whether faces are hidden; images in which they were not looked for yet are blurred as a whole
    """
    try:
        take = replace(read_take(take_file), person=None, hide_faces=False)
        if not _is_detected(take) or is_uncalibrated(last_found(take)):
            return ()
        take = prepared(take, _refuse, silent)
        view = people_in_view(take)
        if view is None or len(view.people) < 2 or not view.seen.keypoints:
            return ()
        numbers = [k for k, person in enumerate(view.people) if person.image_of is None]
        with closing(ShownVideos(replace(take, hide_faces=hide_faces), view.seen)) as videos:
            found = [(k + 1, _picture(view.people[k], take, view.seen, videos)) for k in numbers]
    except (KinefitError, OSError):
        return ()
    return tuple(PersonPicture(k, image) for k, image in found if image is not None)


def _refuse(*_: object) -> None:
    """In place of a `Step`: whatever has to be computed is not computed here."""
    raise TrackingError("the people of this take are not detected yet", remedy="Check the recording first.")


def _is_detected(take: Take) -> bool:
    """Whether the detector's files are there for all videos that have none of their own keypoints, and of these."""
    if take.keypoints and all(entry.file is not None for entry in take.keypoints):
        return True
    return all((detections_key(job.file) or "").startswith(f"{detection_key(job)} ") for job in jobs_of_take(take))


def _picture(
    person: PersonTrack, take: Take, seen: Observations, videos: Callable[[str], Video]
) -> NDArray[np.uint8] | None:  # fmt: skip
    """The part of an image in which a person is largest among those that show most of it; None without a video."""
    best: tuple[float, str, int, NDArray] | None = None
    for keypoints, chosen in zip(seen.keypoints, person.chosen, strict=True):
        frames = np.flatnonzero(chosen >= 0)
        if keypoints.camera not in seen.videos or not len(frames):
            continue
        points = keypoints.points[frames, chosen[frames]]
        confident = keypoints.confidence[frames, chosen[frames]] > _MIN_CONFIDENCE
        score = _heights(points, confident) * confident.mean(axis=1)
        k = int(np.argmax(score))
        if best is None or score[k] > best[0]:
            best = float(score[k]), keypoints.camera, int(frames[k]), points[k][confident[k]]
    if best is None or not best[0]:
        return None
    _, camera, frame, uv = best
    video = videos(camera)
    offset = next(entry.time_offset for entry in take.cameras if entry.name == camera)
    at = video.frame_at((seen.frames[0] + frame) / seen.rate - offset)
    if at is None:
        return None
    uv = seen.images[camera].from_calibration(uv)
    margin = _MARGIN * float(np.ptp(uv[:, 1]))
    left, top = np.maximum(uv.min(axis=0) - margin, 0).astype(int)
    right, bottom = np.maximum(uv.max(axis=0) + margin, 0).astype(int)
    image = video.read(at)[top : bottom + 1, left : right + 1]
    return np.ascontiguousarray(image) if image.size else None


def _heights(points: NDArray, confident: NDArray) -> NDArray:
    """(F,) [px] of keypoints (F, K, 2), those that are confident (F, K); 0 where none is."""
    v = points[..., 1]
    top, bottom = np.where(confident, v, np.inf).min(axis=1), np.where(confident, v, -np.inf).max(axis=1)
    return np.maximum(bottom - top, 0.0)
