"""Images as smooth functions: grey values between the pixels, and how noisy the pixels are."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.photogrammetry.matching import _kernels_spline as kernels

_MASK = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
_SMALLEST = 16  # [px] a side, two windows' margins
_LEAST_NOISE = 1.0 / np.sqrt(12.0)  # of whole grey values


def grey(image: ArrayLike) -> NDArray[np.float32]:
    """Grey values (H, W) float32 of an image (H, W), or (H, W, 3) RGB (weights of ITU-R BT.601).

    Raises
    ------
    ObservationError
        Another shape, too small, or a value that is not finite.
    """
    pixels = np.asarray(image)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3) or min(pixels.shape[:2]) < _SMALLEST:
        problem = f"an image of shape {pixels.shape}"
        remedy = f"Give (height, width) or (height, width, 3), {_SMALLEST} or more a side."
        raise ObservationError(problem, remedy=remedy)
    out = np.ascontiguousarray(pixels, dtype=np.float32)
    if out.ndim == 3:
        out = cv2.cvtColor(out, cv2.COLOR_RGB2GRAY)
    if not np.isfinite(out).all():
        raise ObservationError("an image with a value that is not finite", remedy="Fill it, or leave the image out.")
    return out


@dataclass(frozen=True, eq=False)
class SplineImage:
    """The quintic B-spline through the pixels of an image, mirrored at the edges.

    A spline of the fifth degree is taken: a cubic one has four times its bias over the sub-pixel shift (0.0042 against
    0.0010 px for grains of 1 px), and 1 to 2 % more noise on the DIC Challenge.

    Parameters
    ----------
    grey : (H, W) float32, the pixels
    coefficients : (H, W) float32
    noise : standard deviation of the noise of a pixel; of texture as fine as noise it sees more
    """

    grey: NDArray[np.float32]
    coefficients: NDArray[np.float32]
    noise: float

    @classmethod
    def of(cls, image: ArrayLike, *, smooth: float = 0.0) -> SplineImage:
        """From the pixels (H, W) or (H, W, 3) RGB; errors as of `grey`.

        `smooth` [px] is the standard deviation of a Gaussian over 5x5 px that comes first. It takes away what pixels do
        not resolve, and helps where texture is sharper than pixels and noise is small, as in drawn pictures; of noisy
        ones it makes points less precise (6 to 7 % at 1 px on the DIC Challenge).
        """
        pixels = grey(image)
        if smooth < 0.0 or not np.isfinite(smooth):
            raise ObservationError(f"a smoothing of {smooth} px", remedy="Give 0, or a positive number.")
        pixels = cv2.GaussianBlur(pixels, (5, 5), smooth) if smooth > 0.0 else pixels
        out = np.empty_like(pixels)
        kernels.coefficients(pixels, out)
        return cls(pixels, out, pixel_noise(pixels))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.grey.shape[1], self.grey.shape[0]

    def values(self, uv: ArrayLike) -> NDArray:
        """Grey values (N,) at places (N, 2) [px]; NaN where less than three pixels surround them."""
        places = np.array(uv, float, order="C").reshape(-1, 2)
        out = np.empty(len(places))
        kernels.values(self.coefficients, places, out)
        return out


def pixel_noise(pixels: NDArray) -> float:
    """Standard deviation of the noise of a pixel, from a mask that smooth texture does not pass (Immerkaer 1996).

    The median is taken, as edges and fine texture do pass it; and no less than rounding to whole grey values leaves.
    """
    passed = cv2.filter2D(pixels, cv2.CV_32F, _MASK.astype(np.float32))[1:-1, 1:-1]
    return max(1.4826 * float(np.median(np.abs(passed))), _LEAST_NOISE)


def template_share(first: SplineImage, second: SplineImage) -> float:
    """Part of the variance of the noise of both images that is the first one's."""
    return first.noise**2 / (first.noise**2 + second.noise**2)
