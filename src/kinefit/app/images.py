"""Images for the pages: JPEG, scaled, and unrecognisable where faces are hidden and not found yet."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.preparing.faces import shown_video
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.readers.video import Video

_JPEG_QUALITY = 85
_HIDDEN_PX = 24  # longer side of an image in which no face can be recognised


def jpeg(image: NDArray[np.uint8], longest: int) -> bytes:
    """An RGB image (H, W, 3) as JPEG, its longer side scaled down to at most `longest` [px]."""
    small = scaled(image, longest)
    return cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def scaled(image: NDArray[np.uint8], longest: int) -> NDArray[np.uint8]:
    """An image (H, W, 3) whose longer side has at most `longest` [px]."""
    share = longest / max(image.shape[:2])
    if share >= 1.0:
        return image
    size = max(1, round(share * image.shape[1])), max(1, round(share * image.shape[0]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


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
