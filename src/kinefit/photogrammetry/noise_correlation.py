"""Noise of neighbouring pixels that goes together, as a colour filter or JPEG leaves it: what it does to precision.

A least-squares fit takes the noise of each pixel for new. Where it is not, the standard deviations are too small, by
the root of sum over lags of rho_r(lag) rho_g(lag): the autocorrelations of the residuals and of the template's
gradients.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.photogrammetry import _kernels_spline as spline
from kinefit.photogrammetry.spline_image import SplineImage

_LAGS = 3  # [px] as far as a colour filter's interpolation and the ringing of JPEG reach most of the way
_SAMPLE = 100  # windows, over which an autocorrelation is known to a hundredth
_FEWEST = 20


def variance_factor(first: SplineImage, second: SplineImage, at: NDArray, rows: NDArray, halves: NDArray) -> float:
    """Factor of the variances of found matches, 1 or more; 1 for fewer than 20.

    Parameters
    ----------
    at : (N, 2) [px] centres of windows in the first image
    rows : (N, 8 or more) where each is in the second, its map, the offset and the gain, as the kernels tell them
    halves : (N,) of the windows
    """
    if len(at) < _FEWEST:
        return 1.0
    chosen = np.linspace(0, len(at) - 1, min(len(at), _SAMPLE)).astype(int)
    residual, slope = np.zeros((_LAGS + 1, 2 * _LAGS + 1)), np.zeros((_LAGS + 1, 2 * _LAGS + 1))
    passed = []
    for k in chosen:
        side = np.arange(-halves[k], halves[k] + 1.0)
        inner = np.stack(np.meshgrid(side, side), axis=-1)
        template = first.values(at[k] + inner).reshape(len(side), -1)
        there = second.values(rows[k, :2] + inner @ rows[k, 2:6].reshape(2, 2).T).reshape(len(side), -1)
        left = there - rows[k, 6] - rows[k, 7] * template
        if not np.isfinite(left).all():
            continue
        residual += _products(left - left.mean())
        for gradient in np.gradient(template):
            slope += _products(gradient)
        passed.append(_passed(at[k], rows[k, :2], rows[k, 2:6], len(side), rows[k, 7]))
    if not passed or not (residual[0, _LAGS] > 0 and slope[0, _LAGS] > 0):
        return 1.0
    together = (residual / residual[0, _LAGS]) * (slope / slope[0, _LAGS])
    # lags of the first row and below, left to right: each but the zero one stands for its opposite as well
    total = 2.0 * (together[1:].sum() + together[0, _LAGS + 1 :].sum()) + 1.0
    return max(1.0, float(total * np.mean(passed)))


def _products(field: NDArray) -> NDArray:
    """(L + 1, 2 L + 1) mean products of a field with itself, moved down by 0..L and right by -L..L."""
    out, (height, width) = np.empty((_LAGS + 1, 2 * _LAGS + 1)), field.shape
    for down in range(_LAGS + 1):
        for right in range(-_LAGS, _LAGS + 1):
            a = field[: height - down, max(0, -right) : width - max(0, right)]
            b = field[down:, max(0, right) : width - max(0, -right)]
            out[down, _LAGS + right] = (a * b).mean()
    return out


def _passed(at: NDArray, uv: NDArray, maps: NDArray, n: int, gain: float) -> float:
    """Share of the noise's variance that interpolation passes on, which the kernels have made up for already."""
    theirs = spline.window_noise(*uv, *maps, n)
    own = spline.value_noise(at[0] - np.floor(at[0])) * spline.value_noise(at[1] - np.floor(at[1]))
    return float((theirs + gain**2 * own) / (1.0 + gain**2))
