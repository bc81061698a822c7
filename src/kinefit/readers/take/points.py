"""Points of a take that no file of a detector has: joints that were clicked, face and hands by the colour of the skin.

The latter are a `[[keypoints]]` with format = "skin".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import TakeError, choices
from kinefit.geometry.camera import ImageFrame
from kinefit.images.detectors.skin import LANDMARKS, WRISTS, SkinTracker, face_box
from kinefit.observations import MEDIAPIPE_33, ClickVideo, KeypointVideo
from kinefit.readers.landmarks.annotations import read_clicks
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.take.cameras import TakeCameras, stated_rate
from kinefit.readers.take.entries import KeypointsEntry, Take
from kinefit.readers.videos.video import Video

_CLICK_CROSS_PX = 20.0  # from a click to the ends of the two lines that cross there: short, that no lens bends them


def load_clicks(cameras: TakeCameras) -> tuple[ClickVideo, ...]:
    """Joints that were clicked: each is two image lines that cross in it, along u and v, with its landmark on both.

    Raises
    ------
    TakeError
        Nothing states the rate; a camera that the take does not have.
    FileError
        As `read_clicks`.
    """
    take, images, out = cameras.take, cameras.images, list[ClickVideo]()
    if take.clicks is None:
        return ()
    steps = read_clicks(take.clicks)
    for camera in dict.fromkeys(camera for of in steps for camera in of.points):
        if camera not in images:
            problem = choices("camera", camera, images)
            raise TakeError(problem, file=take.clicks, place="[start] clicks", remedy="Remove its clicks.")
        rate = stated_rate(cameras.fastest, take.path)
        mine = [of for of in steps if of.points.get(camera)]
        names = tuple(dict.fromkeys(name for of in mine for name in of.points[camera]))
        uv = np.array([[of.points[camera].get(name, (np.nan, np.nan)) for name in names] for of in mine])
        cross = _CLICK_CROSS_PX * np.array([[[0, -1], [0, 1]], [[-1, 0], [1, 0]]])
        ends = images[camera].to_calibration(uv[:, :, None, None] + cross).reshape(len(mine), -1, 2, 2)
        offset = cameras.offset(camera)
        times = offset + np.array([round(of.step - offset * rate) for of in mine]) / rate
        titles = tuple(f"{name} {axis}" for name in names for axis in "uv")
        landmarks = tuple((name,) for name in names for _ in "uv")
        out.append(ClickVideo(camera, rate, times, titles, landmarks, ends, source=str(take.clicks)))
    return tuple(out)


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
    if found.names != MEDIAPIPE_33:
        raise TakeError(
            f"the detector's file has points of {found.keypoint_set or 'the body'}, which do not place the face",
            file=file, remedy="Write face = [left, top, width, height] of the first image used.",
        )  # fmt: skip
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
