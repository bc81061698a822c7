"""Masks of people in an image: paint over other people, resample a mask to another region, encode run lengths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.pose_model import SIZE
from kinefit.images.detectors.roi import Roi

MIN_MASK = 0.5
"""Probability of a pixel of the person."""

_MIN_COVERED_PROBABILITY = 0.3  # of a pixel that is painted over
_DILATION = np.ones((7, 7), np.uint8)  # [px of the crop] of masks that are painted over
_PAINT_GREY = 128
_MIN_HIP_DISTANCE = 0.3  # [sides of the region] between two people; one person tracked twice has less


def without_others(
    crop: NDArray[np.uint8], roi: Roi, own: tuple[Roi, NDArray] | None, others: Sequence[tuple[Roi, NDArray]]
) -> NDArray[np.uint8]:
    """Paint over other people in a crop, except for pixels of the person's own last mask.

    People at the same position are not painted over: they may be duplicates of this person.
    """
    other_people = [
        shape for shape in others
        if np.linalg.norm(shape[0].centre - roi.centre) > _MIN_HIP_DISTANCE * min(shape[0].side, roi.side)
    ]  # fmt: skip
    masks = [cv2.dilate(moved_mask(shape, roi), _DILATION) for shape in other_people]
    masks = [mask for mask in masks if mask.any()]
    if masks:
        own_mask = moved_mask(own, roi) if own else np.zeros(crop.shape[:2], np.uint8)
        crop[(np.maximum.reduce(masks) > 0) & (own_mask == 0)] = _PAINT_GREY
    return crop


def moved_mask(shape: tuple[Roi, NDArray], roi: Roi) -> NDArray[np.uint8]:
    """Resample the mask of one region to another: (SIZE, SIZE), 1 where its probability exceeds `MIN_MASK`."""
    A_roi_image = cv2.invertAffineTransform(roi.A_image_crop(SIZE))
    A = A_roi_image @ np.vstack([shape[0].A_image_crop(SIZE), [0, 0, 1]])
    return (cv2.warpAffine(shape[1], A, (SIZE, SIZE)) > MIN_MASK).astype(np.uint8)


def mask_runs(mask: NDArray[np.float32], roi: Roi, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Encode a mask (256, 256) of a region as run lengths, down the columns of an image (height, width) [px]."""
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
    A = roi.A_image_crop(SIZE)[::-1]  # each row of `soft` is a column of the image, between two empty pixels
    A[:, 2] -= v0 - 1, u0
    soft = cv2.warpAffine(mask, A, (int(v1 - v0) + 2, int(u1 - u0)), flags=cv2.INTER_LINEAR)
    inside = soft > MIN_MASK
    inside[:, [0, -1]] = False
    u, v = np.divmod(np.flatnonzero(inside[:, 1:] != inside[:, :-1]), v1 - v0 + 1)
    changes = (u + u0) * height + v + v0
    return np.diff(np.concatenate([[0], changes, [width * height]])).astype(np.uint32)


def cover(image: NDArray[np.uint8], shapes: Iterable[tuple[Roi, NDArray]]) -> NDArray[np.uint8]:
    """Paint over the tracked people in an image (H, W, 3), so that the detector finds other people.

    The detector was made for images of one person and misses a second one close by.
    """
    covered = image.copy()
    for roi, mask in shapes:
        wide = cv2.dilate((mask > _MIN_COVERED_PROBABILITY).astype(np.uint8), _DILATION)
        size = (image.shape[1], image.shape[0])
        covered[cv2.warpAffine(wide, roi.A_image_crop(SIZE), size, flags=cv2.INTER_NEAREST) > 0] = _PAINT_GREY
    return covered
