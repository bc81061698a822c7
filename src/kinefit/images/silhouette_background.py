"""Silhouettes by what is behind: a picture of the empty scene against the one with the body in it, shadows left out."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import rgb_image
from kinefit.errors import ObservationError

_FLOOR = 3.0  # [grey levels] least noise of a camera: rounding and compression
_BLUR = 1.0  # [px] of the smoothing: more of it lets outlines grow
_SHARE = 0.002  # of the image, holes and specks smaller than that are filled and dropped


class BackgroundPlate:
    """The empty scene, and what differs from it.

    A pixel is told in brightness and colour apart (Horprasert et al. 1999): α, by how much the plate's colour must be
    dimmed to come nearest to it, and the distance d that then remains. What differs in d is the body; what only differs
    in α is the body where it is brighter, or darker than any shadow; else it is a shadow.

    Parameters
    ----------
    plate : (H, W, 3) uint8, the empty scene, of the same camera standing still.
    threshold : float, deviations of the noise from which something differs.
    shadow : float in 0..1, of a brightness that a shadow leaves at least.
    noise : float [grey levels], optional; default: found in every picture, as most of it shows the scene.

    Raises
    ------
    ObservationError
        No colour picture.
    """

    def __init__(
        self, plate: ArrayLike, *, threshold: float = 4.0, shadow: float = 0.5, noise: float | None = None
    ) -> None:
        self.plate = _smooth(rgb_image(plate))
        self.threshold, self.shadow, self.noise = threshold, shadow, noise
        self._square = np.einsum("ijk,ijk->ij", self.plate, self.plate) + 1.0

    @classmethod
    def of(cls, images: Iterable[NDArray], **options: float) -> BackgroundPlate:
        """From pictures in which the body stands at different places: their median, pixel by pixel."""
        stack = [rgb_image(image) for image in images]
        if not stack:
            raise ObservationError("no pictures to learn the background from", remedy="Give ten or more.")
        return cls(np.median(stack, axis=0).astype(np.uint8), **options)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.plate.shape[1], self.plate.shape[0]

    def mask(self, image: ArrayLike) -> NDArray:
        """(H, W) uint8, 255 where a picture (H, W, 3) differs from the plate.

        Raises
        ------
        ObservationError
            A picture of another size.
        """
        picture = _smooth(rgb_image(image))
        if picture.shape != self.plate.shape:
            problem = f"a picture of {picture.shape[1::-1]} px, the background has {self.size}"
            raise ObservationError(problem, remedy="Take both with the same camera and settings.")
        alpha = np.einsum("ijk,ijk->ij", picture, self.plate) / self._square
        alpha /= max(float(np.median(alpha[::4, ::4])), 1e-3)  # the camera's own exposure
        away = picture - alpha[..., None] * self.plate
        d = np.sqrt(np.einsum("ijk,ijk->ij", away, away))
        noise = max(1.4826 * float(np.median(d[::4, ::4])), _FLOOR) if self.noise is None else self.noise
        change = np.abs(alpha - 1.0) * np.sqrt(self._square)
        brighter = (alpha > 1.0) & (change > 2.0 * self.threshold * noise)
        darker = (alpha < self.shadow) & (change > self.threshold * noise)
        raw = ((d > self.threshold * noise) | brighter | darker).astype(np.uint8)
        return cleaned(255 * raw)


def cleaned(mask: NDArray, *, share: float = _SHARE) -> NDArray:
    """A mask (H, W) uint8 without specks, and with holes filled, that are smaller than a share of the image."""
    least = share * mask.size
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    out = cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel)
    for value in (255, 0):
        _, labels, stats, _ = cv2.connectedComponentsWithStats((out == value).astype(np.uint8), connectivity=4)
        small = stats[:, cv2.CC_STAT_AREA] < least
        small[0] = False
        out[small[labels]] = 255 - value
    return out


def _smooth(picture: NDArray) -> NDArray:
    """As float32, with the noise of single pixels taken off."""
    return np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _BLUR))
