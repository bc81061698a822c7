"""Silhouettes: masks of the body, and their contours with sub-pixel positions."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import rgb_image, shaped
from kinefit.errors import ObservationError
from kinefit.images import _kernels_silhouette as kernels

_CONTOUR_LEVEL = 127.5  # of masks from 0 to 255


def outline(mask: ArrayLike, *, level: float = _CONTOUR_LEVEL) -> NDArray:
    """Contour (4, N) of a mask: position u, v [px] and unit normal (a, b), pointing away from the body.

    Where the mask has values between 0 and 255 the contour runs within pixels: a mask downscaled by averaging
    (`cv2.INTER_AREA`) keeps its contour to a tenth of a pixel. The border of the image is no contour.

    Parameters
    ----------
    mask : (H, W) uint8
    level : float in 0..255, value of the mask at the contour

    Raises
    ------
    ObservationError
        No mask.
    """
    image = _mask(mask)
    out = np.empty((4, 2 * image.size if image.size < 10000 else image.size // 2))
    n = kernels.crossings(image, level, out)
    return out[:, :n].copy()


def colour_mask(image: ArrayLike, low: ArrayLike, high: ArrayLike) -> NDArray:
    """Threshold an image (H, W, 3) by colours low to high (3,), 0..255: (H, W) uint8, 0 or 255, without single pixels.

    Raises
    ------
    ObservationError
        No colour image, or thresholds in the wrong order.
    """
    pixels, (low, high) = rgb_image(image), (shaped(v, (3,), "a threshold") for v in (low, high))
    if not np.all(low <= high):
        raise ObservationError(f"thresholds {low} to {high} leave no colour", remedy="Give the lower limits first.")
    return np.asarray(cv2.morphologyEx(cv2.inRange(pixels, low, high), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))


def colour_silhouette(
    image: ArrayLike, low: ArrayLike, high: ArrayLike, *, smooth: float = 1.0
) -> tuple[NDArray, NDArray]:
    """Silhouette by colour thresholds, and its contour by the Laplace operator (P1 2.4).

    Parameters
    ----------
    image : (H, W, 3) uint8
    low, high : (3,) smallest and largest value of the body in each channel, 0..255.
    smooth : float [px], sigma of the Gaussian before the Laplace operator.

    Returns
    -------
    mask : (H, W) uint8, 0 or 255.
    contour : (H, W) bool, pixels of the body at which the Laplacian of the smoothed mask changes its sign.

    Raises
    ------
    ObservationError
        No colour image, or thresholds in the wrong order.
    """
    mask = colour_mask(image, low, high)
    curved = cv2.Laplacian(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), smooth), cv2.CV_32F, ksize=3)
    outside = cv2.dilate((curved > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return mask, (mask > 0) & (curved < 0) & outside


def choose_person(mask: ArrayLike, near: ArrayLike | None = None, *, share: float = 0.3) -> NDArray:
    """Keep the blobs of a mask that belong to the person: (H, W) uint8, the others set to 0.

    Parameters
    ----------
    mask : (H, W) uint8
    near : (H, W) bool, optional
        Region in which the person is expected, enlarged by the motion since then. Blobs with at least `share` of
        their area in it are kept. Without it, or if there are none, the largest blob is kept.
    share : float in 0..1

    Raises
    ------
    ObservationError
        No mask.
    """
    image = _mask(mask)
    if len(cv2.findContours(image, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]) <= 1:
        return image
    count, labels, stats, _ = cv2.connectedComponentsWithStats((image > 0).astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0.0
    chosen = np.zeros(count, bool)
    if near is not None:
        inside = np.bincount(labels[np.asarray(near, bool)], minlength=count)
        chosen = (inside >= share * area) & (area > 0)
    if not chosen.any():
        chosen[np.argmax(area)] = True
    return np.where(chosen[labels], image, 0).astype(np.uint8)


def _mask(mask: ArrayLike) -> NDArray:
    image = np.ascontiguousarray(mask)
    if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
        problem = f"a mask of shape {image.shape} and type {image.dtype}"
        raise ObservationError(problem, remedy="Give (height, width) of uint8, 0 to 255.")
    return image
