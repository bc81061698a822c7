"""Faces made unrecognisable in pictures, in circles that are given."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_BLOCKS = 4  # over the head: a face is known down to about ten
_ALL_BLOCKS = 12  # over the longer side of a picture that shows faces one knows not where


def hide_circles(image: NDArray[np.uint8], circles: NDArray) -> NDArray[np.uint8]:
    """A copy of a picture (H, W, 3) uint8 in which nothing can be made out within circles (N, 3) [px] u, v, radius."""
    out = np.array(image, order="C")
    classes = np.ceil(np.log2(np.maximum(circles[:, 2], 1.0)))
    for size in np.unique(classes):  # circles of nearly one radius at once, large ones last
        mask = np.zeros(image.shape[:2], np.uint8)
        for u, v, radius in circles[classes == size]:
            cv2.circle(mask, (round(u), round(v)), max(1, round(radius)), 1, -1)
        left, top, width, height = cv2.boundingRect(mask)
        if width and height:
            part, inside = (a[top : top + height, left : left + width] for a in (out, mask))
            cv2.copyTo(_coarse(part, 2 * 2**size / _BLOCKS), inside, part)
    return out


def hide_all(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A copy of a picture in which nobody can be recognised."""
    return _coarse(image, max(image.shape[:2]) / _ALL_BLOCKS)


def _coarse(image: NDArray[np.uint8], block: float) -> NDArray[np.uint8]:
    """The picture in blocks of so many pixels, blended."""
    height, width = image.shape[:2]
    few = (max(1, round(width / block)), max(1, round(height / block)))
    small = cv2.resize(image, few, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
