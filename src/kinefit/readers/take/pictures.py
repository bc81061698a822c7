"""Single pictures of a take's videos, by camera and step."""

from __future__ import annotations

from types import TracebackType

from numpy.typing import NDArray

from kinefit.errors import KinefitError
from kinefit.geometry.camera import ImageFrame
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.readers.video import Video


class TakePictures:
    """The pictures of a take's videos, for whoever wants to look at some of them; opened where one is asked for.

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
