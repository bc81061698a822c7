"""Silhouettes: which pixels are the body, and their outline to parts of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import rgb_image, shaped
from kinefit.errors import ObservationError
from kinefit.images import _kernels_silhouette as kernels

_HALF = 127.5  # between a pixel of the body and one beside it


def outline(mask: ArrayLike, *, level: float = _HALF) -> NDArray:
    """Outline (4, N) of a mask: u, v [px] and the unit normal (a, b), away from the body, at every pixel's border.

    Where the mask has values between 0 and 255 the outline runs within pixels: a mask made smaller by averaging
    (`cv2.INTER_AREA`) keeps its outline to a tenth of a pixel. At the image's own border there is no outline.

    Parameters
    ----------
    mask : (H, W) uint8
    """
    image = _mask(mask)
    out = np.empty((4, 2 * image.size if image.size < 10000 else image.size // 2))
    n = kernels.crossings(image, level, out)
    return out[:, :n].copy()


def colour_mask(image: ArrayLike, low: ArrayLike, high: ArrayLike) -> NDArray:
    """(H, W) uint8, 255 where a picture (H, W, 3) has a colour between low and high (3,), without single pixels."""
    pixels, (low, high) = rgb_image(image), (shaped(v, (3,), "a threshold") for v in (low, high))
    if not np.all(low <= high):
        raise ObservationError(f"thresholds {low} to {high} leave no colour", remedy="Give the lower ones first.")
    return np.asarray(cv2.morphologyEx(cv2.inRange(pixels, low, high), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))


def colour_silhouette(
    image: ArrayLike, low: ArrayLike, high: ArrayLike, *, smooth: float = 1.0
) -> tuple[NDArray, NDArray]:
    """Silhouette by a threshold on colour, and its contour by the Laplace operator (P1 2.4).

    Parameters
    ----------
    image : (H, W, 3) uint8
    low, high : (3,) least and largest value of each channel that is the body's.
    smooth : float [px] of the Gaussian before the Laplace operator.

    Returns
    -------
    mask : (H, W) uint8, 0 or 255.
    contour : (H, W) bool, pixels of the body at which the Laplace operator of the smoothed mask changes its sign.
    """
    mask = colour_mask(image, low, high)
    curved = cv2.Laplacian(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), smooth), cv2.CV_32F, ksize=3)
    beside = cv2.dilate((curved > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return mask, (mask > 0) & (curved < 0) & beside


def choose_person(mask: ArrayLike, near: ArrayLike | None = None, *, share: float = 0.3) -> NDArray:
    """Of several blobs those that are the person: (H, W) uint8, the others emptied.

    Parameters
    ----------
    mask : (H, W) uint8
    near : (H, W) bool, optional
        Where the person is thought to be, with the room that it may have moved through: blobs of which at least
        `share` lies there are its, in one piece or several. Without it, or where no blob does, the largest one.
    """
    image = _mask(mask)
    if len(cv2.findContours(image, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]) <= 1:
        return image
    count, labels, stats, _ = cv2.connectedComponentsWithStats((image > 0).astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0.0
    mine = np.zeros(count, bool)
    if near is not None:
        inside = np.bincount(labels[np.asarray(near, bool)], minlength=count)
        mine = (inside >= share * area) & (area > 0)
    if not mine.any():
        mine[np.argmax(area)] = True
    return np.where(mine[labels], image, 0).astype(np.uint8)


def _mask(mask: ArrayLike) -> NDArray:
    image = np.ascontiguousarray(mask)
    if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
        problem = f"a mask of shape {image.shape} and type {image.dtype}"
        raise ObservationError(problem, remedy="Give (height, width) of uint8, 0 to 255.")
    return image
