"""Images for the pages: JPEG, scaled, and unrecognisable where faces are hidden and not found yet."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

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

