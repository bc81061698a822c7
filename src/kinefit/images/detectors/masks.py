"""Masks of the people in an image: others painted over, masks of one region in another, their run lengths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.pose_model import SIZE
from kinefit.images.detectors.roi import Roi

MIN_MASK = 0.5
"""Probability from which on a pixel is the person's."""

_MIN_COVERED = 0.3  # probability from which on a pixel is painted over
_DILATION_PX = 7  # of the crop, around it
_GREY = 128  # the paint
_MIN_DISTANCE = 0.3  # between the middles of the hips of two people, in sides; one who is followed twice has less


def without_others(
    crop: NDArray[np.uint8], roi: Roi, own: tuple[Roi, NDArray] | None, others: Sequence[tuple[Roi, NDArray]]
) -> NDArray[np.uint8]:
    """A region with other people in it painted over, but for pixels that were the person's own.

    Those at the very same place are not: they may be the same person, followed twice.
    """
    beside = [
        shape for shape in others
        if np.linalg.norm(shape[0].centre - roi.centre) > _MIN_DISTANCE * min(shape[0].side, roi.side)
    ]  # fmt: skip
    theirs = [cv2.dilate(moved_mask(shape, roi), np.ones((_DILATION_PX, _DILATION_PX), np.uint8)) for shape in beside]
    theirs = [mask for mask in theirs if mask.any()]
    if theirs:
        mine = moved_mask(own, roi) if own else np.zeros(crop.shape[:2], np.uint8)
        crop[(np.maximum.reduce(theirs) > 0) & (mine == 0)] = _GREY
    return crop


def moved_mask(shape: tuple[Roi, NDArray], roi: Roi) -> NDArray[np.uint8]:
    """Pixels of a region (SIZE, SIZE), 0 or 1, that a mask of another region holds for likely."""
    A_roi_image = cv2.invertAffineTransform(roi.A_image_crop(SIZE))
    A = A_roi_image @ np.vstack([shape[0].A_image_crop(SIZE), [0, 0, 1]])
    return (cv2.warpAffine(shape[1], A, (SIZE, SIZE)) > MIN_MASK).astype(np.uint8)


def mask_runs(mask: NDArray[np.float32], roi: Roi, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Run lengths, down the columns of a picture (height, width), of the pixels that are likely the person's."""
    height, width = shape
    nothing = np.array([width * height], np.uint32)
    rows, columns = (np.flatnonzero((mask > MIN_MASK).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return nothing
    box = np.array([[u, v] for u in (columns[0] - 1, columns[-1] + 1) for v in (rows[0] - 1, rows[-1] + 1)])
    corners = roi.to_image(box, SIZE)
    u0, v0 = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, [width, height])
    u1, v1 = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 1, 0, [width, height])
    if u0 >= u1 or v0 >= v1:
        return nothing
    A = roi.A_image_crop(SIZE)[::-1]  # each row of what is drawn is a column of the picture, between two empty pixels
    A[:, 2] -= v0 - 1, u0
    soft = cv2.warpAffine(mask, A, (int(v1 - v0) + 2, int(u1 - u0)), flags=cv2.INTER_LINEAR)
    inside = soft > MIN_MASK
    inside[:, [0, -1]] = False
    u, v = np.divmod(np.flatnonzero(inside[:, 1:] != inside[:, :-1]), v1 - v0 + 1)
    changes = (u + u0) * height + v + v0
    return np.diff(np.concatenate([[0], changes, [width * height]])).astype(np.uint32)


def cover(image: NDArray[np.uint8], shapes: Iterable[tuple[Roi, NDArray]]) -> NDArray[np.uint8]:
    """The picture with those who are known painted over, so that the detector sees whoever else is there.

    It was made for one person in the picture and overlooks those beside another.
    """
    covered = image.copy()
    for roi, mask in shapes:
        wide = cv2.dilate((mask > _MIN_COVERED).astype(np.uint8), np.ones((_DILATION_PX, _DILATION_PX), np.uint8))
        size = (image.shape[1], image.shape[0])
        covered[cv2.warpAffine(wide, roi.A_image_crop(SIZE), size, flags=cv2.INTER_NEAREST) > 0] = _GREY
    return covered
