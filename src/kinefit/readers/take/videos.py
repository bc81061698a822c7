"""Videos of a take: stereo pairs as recordings of depth, and single images."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, KinefitError, TakeError
from kinefit.geometry.camera import ImageFrame
from kinefit.images.stereo import StereoRectifier
from kinefit.observations import DepthVideo
from kinefit.readers.take.entries import StereoEntry
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.readers.videos.video import Video

_TYPICAL = 0.67  # share of the range at which a standard deviation of disparity becomes one of depth


@dataclass(frozen=True)
class _Pair:
    """A stereo pair as a recording of depth."""

    rectifier: StereoRectifier
    left: Video
    right: Video

    def image(self, i: int) -> NDArray:
        right = self.right.frame_at(float(self.left.times[i])) or 0
        return self.rectifier.frame(self.left.read(i), self.right.read(right), 0.0).depth


def load_stereo(take: Take, seen: Observations) -> tuple[DepthVideo, ...]:
    """Depth of all stereo pairs of a take, in its order.

    Raises
    ------
    TakeError, CalibrationError
        No video of a camera; cameras that are not calibrated, or that no pair can be rectified of.
    """
    return tuple(_pair(take, seen, entry) for entry in take.stereo)


def stereo_sigma(entry: StereoEntry, video: DepthVideo, seen: Observations) -> float:
    """[m] standard deviation of a depth, at two thirds of the range."""
    assert video.camera is not None and seen.rig is not None
    left, right = seen.rig[entry.left], seen.rig[entry.right]
    baseline = float(np.linalg.norm(left.centre_world - right.centre_world))
    z = _TYPICAL * entry.range[1]
    return entry.sigma * z**2 / (video.camera.matrix[0, 0] * baseline)


def _pair(take: Take, seen: Observations, entry: StereoEntry) -> DepthVideo:
    lacking = [name for name in (entry.left, entry.right) if name not in seen.videos]
    if lacking or seen.rig is None:
        problem = f"no video of camera {', '.join(lacking)}" if lacking else "its cameras are not calibrated"
        raise TakeError(problem, file=take.path, place=f"stereo {entry.name}", remedy="Add it to the [[camera]].")
    near, far = entry.range
    try:
        left, right = seen.rig[entry.left], seen.rig[entry.right]
        rectifier = StereoRectifier(left, right, near=near, far=far, name=entry.name)
    except KinefitError as error:
        raise CalibrationError(error.problem, file=take.path, place=error.place, remedy=error.remedy) from error
    both = _Pair(rectifier, *(Video(seen.videos[name], rate=seen.rate) for name in (entry.left, entry.right)))
    times = both.left.times[: np.searchsorted(both.left.times, both.right.times[-1] + 0.5 / seen.rate)]
    return DepthVideo(
        sensor=entry.name, rate=seen.rate, times=times, size=rectifier.camera.size,
        image=both.image, near=near, far=far, camera=rectifier.camera, source=str(seen.videos[entry.left]),
    )  # fmt: skip


class TakePictures:
    """Images of a take's videos on demand; a video is opened when its first image is requested.

    Parameters
    ----------
    take : Take
    seen : what its sensors saw
    """

    def __init__(self, take: Take, seen: Observations) -> None:
        self._seen, self._rate = seen, take.rate
        self._offsets = {entry.name: entry.time_offset for entry in take.cameras}
        self._open: dict[str, Video | None] = {}

    def __call__(self, camera: str, frame: int) -> tuple[NDArray, ImageFrame] | None:
        """Image (H, W, 3) uint8 RGB at a frame of the keypoints, and its image frame.

        None where the camera has no video, or none that can be read: what is looked up is then less certain.
        """
        try:
            if camera not in self._open:
                path = self._seen.videos.get(camera)
                self._open[camera] = None if path is None else Video(path, rate=self._rate)
            video = self._open[camera]
            if video is None:
                return None
            time = (self._seen.frames[0] + frame) / self._seen.rate - self._offsets[camera]
            number = video.frame_at(time)
            return None if number is None else (video.read(number), self._seen.images[camera])
        except KinefitError:
            self._open[camera] = None
            return None

    def __enter__(self) -> TakePictures:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for video in self._open.values():
            if video is not None:
                video.close()
