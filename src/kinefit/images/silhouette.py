"""Silhouettes: masks of the body by colour or background, and their contours with sub-pixel positions."""

from __future__ import annotations

from collections.abc import Iterable

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


_MIN_NOISE = 3.0  # [grey levels] of a camera: rounding and compression
_BLUR_PX = 1.0  # sigma of the smoothing: a larger one enlarges silhouettes
_MIN_BLOB_SHARE = 0.002  # of the image: smaller holes are filled, smaller specks removed


class BackgroundPlate:
    """Background subtraction against an image of the empty scene.

    Each pixel is compared in brightness and in colour (Horprasert et al. 1999): α is the factor by which the plate's
    colour comes nearest to the pixel's, d the remaining distance. A pixel with a large d is foreground. With a small d
    it is foreground if it is brighter, or darker than a shadow can be; else it is background or shadow.

    Parameters
    ----------
    plate : (H, W, 3) uint8, the empty scene, from the same fixed camera.
    threshold : float [standard deviations of the noise], smallest difference of the foreground.
    shadow : float in 0..1, smallest share of the brightness that remains in a shadow.
    noise : float [grey levels], optional; default: estimated in every image, as most of it shows the background.

    Raises
    ------
    ObservationError
        No colour image.
    """

    def __init__(
        self, plate: ArrayLike, *, threshold: float = 4.0, shadow: float = 0.5, noise: float | None = None
    ) -> None:
        self.plate = _smooth(rgb_image(plate))
        self.threshold, self.shadow, self.noise = threshold, shadow, noise
        self._square = np.einsum("ijk,ijk->ij", self.plate, self.plate) + 1.0

    @classmethod
    def of(cls, images: Iterable[NDArray], **options: float) -> BackgroundPlate:
        """Background from images (H, W, 3) uint8 with the body at different positions: the median of each pixel.

        Raises
        ------
        ObservationError
            No images, or no colour images.
        """
        stack = [rgb_image(image) for image in images]
        if not stack:
            raise ObservationError("no images to learn the background from", remedy="Give ten or more.")
        return cls(np.median(stack, axis=0).astype(np.uint8), **options)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.plate.shape[1], self.plate.shape[0]

    def mask(self, image: ArrayLike) -> NDArray:
        """Foreground mask (H, W) uint8, 0 or 255, of an image (H, W, 3) uint8.

        Raises
        ------
        ObservationError
            An image of another size.
        """
        smoothed = _smooth(rgb_image(image))
        if smoothed.shape != self.plate.shape:
            problem = f"an image of {smoothed.shape[1::-1]} px, but the background has {self.size}"
            raise ObservationError(problem, remedy="Record both with the same camera and settings.")
        alpha = np.einsum("ijk,ijk->ij", smoothed, self.plate) / self._square
        difference = smoothed - alpha[..., None] * self.plate
        alpha /= max(float(np.median(alpha[::4, ::4])), 1e-3)  # the camera's own exposure
        d = np.sqrt(np.einsum("ijk,ijk->ij", difference, difference))
        noise = max(1.4826 * float(np.median(d[::4, ::4])), _MIN_NOISE) if self.noise is None else self.noise
        change = np.abs(alpha - 1.0) * np.sqrt(self._square)
        brighter = (alpha > 1.0) & (change > 2.0 * self.threshold * noise)
        darker = (alpha < self.shadow) & (change > self.threshold * noise)
        raw = ((d > self.threshold * noise) | brighter | darker).astype(np.uint8)
        return cleaned(255 * raw)


def cleaned(mask: NDArray, *, share: float = _MIN_BLOB_SHARE) -> NDArray:
    """Remove specks and fill holes of a mask (H, W) uint8 that are smaller than a share 0..1 of the image."""
    min_area = share * mask.size
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    out = cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel)
    for value in (255, 0):
        _, labels, stats, _ = cv2.connectedComponentsWithStats((out == value).astype(np.uint8), connectivity=4)
        small = stats[:, cv2.CC_STAT_AREA] < min_area
        small[0] = False
        out[small[labels]] = 255 - value
    return out


def _smooth(smoothed: NDArray) -> NDArray:
    """Smoothed image as float32."""
    return np.asarray(cv2.GaussianBlur(smoothed.astype(np.float32), (0, 0), _BLUR_PX))
