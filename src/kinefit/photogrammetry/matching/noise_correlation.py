"""Noise of neighbouring pixels that goes together, as a colour filter or JPEG leaves it: what it does to precision.

A least-squares fit takes the noise of each pixel for new. Where it is not, the standard deviations are too small, by
the root of sum over lags of rho_r(lag) rho_g(lag): the autocorrelations of the residuals and of the template's
gradients.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.photogrammetry.matching import _kernels_spline as spline
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
    at, rows = at[chosen], rows[chosen]
    half = int(halves[chosen].min())
    side = np.arange(-half, half + 1.0)
    inner = np.stack(np.meshgrid(side, side), axis=-1)
    template = first.values(at[:, None, None] + inner).reshape(len(at), len(side), -1)
    moved = np.einsum("nij,xyj->nxyi", rows[:, 2:6].reshape(-1, 2, 2), inner) + rows[:, None, None, :2]
    there = second.values(moved).reshape(template.shape)
    left = there - rows[:, 6, None, None] - rows[:, 7, None, None] * template
    seen = np.isfinite(left).all(axis=(1, 2))
    if not seen.any():
        return 1.0
    left, template = left[seen], template[seen]
    residual = _products(left - left.mean(axis=(1, 2), keepdims=True))
    slope = _products(np.gradient(template, axis=1)) + _products(np.gradient(template, axis=2))
    if not (residual[0, _LAGS] > 0 and slope[0, _LAGS] > 0):
        return 1.0
    together = (residual / residual[0, _LAGS]) * (slope / slope[0, _LAGS])
    # lags of the first row and below, left to right: each but the zero one stands for its opposite as well
    total = 2.0 * (together[1:].sum() + together[0, _LAGS + 1 :].sum()) + 1.0
    passed = [_passed(a, row[:2], row[2:6], len(side), row[7]) for a, row in zip(at[seen], rows[seen])]
    return max(1.0, float(total * np.mean(passed)))


def _products(field: NDArray) -> NDArray:
    """(L + 1, 2 L + 1) mean products of fields (K, n, n) with themselves, moved down by 0..L and right by -L..L."""
    out, (_, height, width) = np.empty((_LAGS + 1, 2 * _LAGS + 1)), field.shape
    for down in range(_LAGS + 1):
        for right in range(-_LAGS, _LAGS + 1):
            a = field[:, : height - down, max(0, -right) : width - max(0, right)]
            b = field[:, down:, max(0, right) : width - max(0, -right)]
            out[down, _LAGS + right] = (a * b).mean()
    return out


def _passed(at: NDArray, uv: NDArray, maps: NDArray, n: int, gain: float) -> float:
    """Share of the noise's variance that interpolation passes on, which the kernels have made up for already."""
    theirs = spline.window_noise(*uv, *maps, n)
    own = spline.value_noise(at[0] - np.floor(at[0])) * spline.value_noise(at[1] - np.floor(at[1]))
    return float((theirs + gain**2 * own) / (1.0 + gain**2))
