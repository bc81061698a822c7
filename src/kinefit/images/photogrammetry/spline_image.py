"""Images as quintic B-splines: grey values between pixels, and the noise of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.images.photogrammetry.matching import _kernels_matching as kernels

_NOISE_MASK = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]]) / 6.0
_MIN_SIDE_PX = 16  # of an image: two windows' margins
_MIN_NOISE = 1.0 / np.sqrt(12.0)  # rounding to whole grey values


def grey(image: ArrayLike) -> NDArray[np.float32]:
    """Grey values (H, W) float32 of an image (H, W), or (H, W, 3) RGB (weights of ITU-R BT.601).

    Raises
    ------
    ObservationError
        The shape is another, the image too small, or a value not finite.
    """
    pixels = np.asarray(image)
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3) or min(pixels.shape[:2]) < _MIN_SIDE_PX:
        problem = f"an image of shape {pixels.shape}"
        remedy = f"Give (height, width) or (height, width, 3), {_MIN_SIDE_PX} or more a side."
        raise ObservationError(problem, remedy=remedy)
    out = np.ascontiguousarray(pixels, dtype=np.float32)
    if out.ndim == 3:
        out = cv2.cvtColor(out, cv2.COLOR_RGB2GRAY)
    if not np.isfinite(out).all():
        raise ObservationError("an image with a value that is not finite", remedy="Fill it, or remove the image.")
    return out


@dataclass(frozen=True, eq=False)
class SplineImage:
    """The quintic B-spline through the pixels of an image, mirrored at the edges.

    A cubic spline would have four times the bias over the sub-pixel shift (0.0042 against 0.0010 px for grains of 1 px)
    and 1 to 2 % more noise on the DIC Challenge.

    Parameters
    ----------
    grey : (H, W) float32, the pixels
    coefficients : (H, W) float32
    noise : standard deviation of a pixel's noise in grey values; too large if the texture is as fine as noise
    """

    grey: NDArray[np.float32]
    coefficients: NDArray[np.float32]
    noise: float

    @classmethod
    def of(cls, image: ArrayLike, *, smooth: float = 0.0) -> SplineImage:
        """Make a spline of pixels (H, W) or (H, W, 3) RGB.

        Parameters
        ----------
        smooth : [px] standard deviation of a Gaussian filter over 5x5 px, applied first; default: none
            It helps with texture sharper than the pixels and little noise, as in rendered images. With noisy images
            points become less precise (6 to 7 % at 1 px on the DIC Challenge).

        Raises
        ------
        ObservationError
            As `grey`, or `smooth` is negative.
        """
        pixels = grey(image)
        if smooth < 0.0 or not np.isfinite(smooth):
            raise ObservationError(f"a smoothing of {smooth} px", remedy="Give 0, or a positive number.")
        pixels = cv2.GaussianBlur(pixels, (5, 5), smooth) if smooth > 0.0 else pixels
        from scipy.ndimage import spline_filter  # a third of a second, for matched images alone

        out = spline_filter(pixels, order=5, output=np.float32, mode="mirror")
        return cls(pixels, out, pixel_noise(pixels))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.grey.shape[1], self.grey.shape[0]

    def values(self, uv: ArrayLike) -> NDArray:
        """(N,) grey values at points (N, 2) [px]; NaN where fewer than three pixels surround a point."""
        places = np.array(uv, float, order="C").reshape(-1, 2)
        out = np.empty(len(places))
        kernels.values(self.coefficients, places, out)
        return out


def pixel_noise(pixels: NDArray) -> float:
    """Estimate the standard deviation of the noise of pixels (H, W), in grey values (Immerkaer 1996).

    A filter mask removes smooth texture. The median of its output is robust to edges and fine texture. The noise is at
    least that of rounding to whole grey values.
    """
    passed = cv2.filter2D(pixels, cv2.CV_32F, _NOISE_MASK.astype(np.float32))[1:-1, 1:-1]
    return max(1.4826 * float(np.median(np.abs(passed))), _MIN_NOISE)


def template_share(first: SplineImage, second: SplineImage) -> float:
    """Share (0 to 1) of the first image in the noise variance of both images together."""
    return first.noise**2 / (first.noise**2 + second.noise**2)
