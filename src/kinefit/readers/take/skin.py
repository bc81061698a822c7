"""Face and hands of a take by the colour of the skin: `[[keypoints]]` with format = "skin"."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import TakeError
from kinefit.geometry.camera import ImageFrame
from kinefit.images.detectors.skin import LANDMARKS, WRISTS, SkinTracker, face_box
from kinefit.observations import KeypointVideo
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.take.cameras import TakeCameras
from kinefit.readers.take.entries import KeypointsEntry, Take
from kinefit.readers.videos.video import Video

_NAMES = {"HANDS": LANDMARKS, "WRISTS": WRISTS}


def load_skin(entry: KeypointsEntry, cameras: TakeCameras) -> KeypointVideo:
    """A `[[keypoints]]` of a take with format = "skin"; images are read when their frames are asked for.

    Raises
    ------
    TakeError
        Nothing states where the face is.
    KinefitError
        What reading the video, and the tracker at a face that is not in it, raise.
    """
    take, video, offset = cameras.take, cameras.video(entry.camera), cameras.offset(entry.camera)
    used = entry.frames or take.frames
    begin, end = 0, len(video)
    if used is not None:  # half a step before the first of them, and before the one after the last
        bounds = (np.array(used) - 0.5) / (cameras.fastest or video.rate) - offset
        begin, end = (int(k) for k in np.searchsorted(video.times, bounds))
    if begin >= end:
        raise TakeError("none of its frames is in the video", remedy=f"The video has {len(video)} frames.")
    face = entry.face
    if face is None:
        begin, face = _detected_face(take, entry, begin, end)
    seen = _Seen(video, begin, face, cameras.images[entry.camera])
    times = offset + video.times[begin:end]
    names = _NAMES[entry.set or "HANDS"]
    return KeypointVideo(entry.camera, video.rate, times, names, seen.points, source=str(video.path))


def _detected_face(
    take: Take, entry: KeypointsEntry, begin: int, end: int
) -> tuple[int, tuple[float, float, float, float]]:
    """The first frame in which the built-in detector saw somebody, and the face there, of which it saw best."""
    file = detections_file(take.path, entry.camera)
    if not file.exists():
        raise TakeError(
            "the place of the face is not stated",
            remedy="Write face = [left, top, width, height] of the first image used, or run `kinefit detect`.",
        )
    found = read_detections(file)
    frames = [i for i in range(begin, min(end, len(found))) if found.seen[i].any()]
    if not frames:
        raise TakeError("no person is detected", remedy="Write face = [left, top, width, height] of the first one.")
    people = np.where(found.seen[frames[0]], found.confidence[frames[0]].mean(axis=1), -1.0)
    return frames[0], face_box(found.points[frames[0], int(np.argmax(people))])


class _Seen:
    """Face and hands in the frames of a video: followed from the first one on, each image once."""

    def __init__(
        self, video: Video, begin: int, face: tuple[float, float, float, float], image: ImageFrame
    ) -> None:
        self._video, self._begin, self._image = video, begin, image
        self._tracker = SkinTracker(video.read(begin), face, rate=video.rate)
        self._found: list[tuple[NDArray, NDArray]] = []

    def points(self, i: int) -> tuple[NDArray, NDArray]:
        """Places (3, 2) [px] in the calibration's image and confidence (3,) in frame `i` after the first."""
        while len(self._found) <= i:
            self._tracker.update(self._video.read(self._begin + len(self._found)))
            frame = self._tracker.frame("", 0.0)
            self._found.append((self._image.to_calibration(frame.uv), frame.confidence))
        return self._found[i]
