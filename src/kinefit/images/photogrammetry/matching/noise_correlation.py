"""Correct the variances of matches for noise that is correlated between pixels (colour filters, JPEG).

A least-squares fit assumes independent noise. With correlated noise the standard deviations are too small by the root
of the sum over lags of rho_r(lag) rho_g(lag): the autocorrelations of the residuals and of the template's gradients.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.images.photogrammetry.matching import _kernels_matching as spline
from kinefit.images.photogrammetry.spline_image import SplineImage

_MAX_LAG_PX = 3  # covers most of a colour filter's interpolation and JPEG's ringing
_SAMPLE_SIZE = 100  # windows: gives autocorrelations to a hundredth
_MIN_MATCHES = 20


def variance_factor(first: SplineImage, second: SplineImage, at: NDArray, rows: NDArray, halves: NDArray) -> float:
    """Factor on the variances of matches due to correlated noise, at least 1; 1 for fewer than 20 matches.

    Parameters
    ----------
    at : (N, 2) [px] centres of windows in the first image
    rows : (N, 8 or more) rows of the kernels: position in the second image, map, offset, gain
    halves : (N,) half sides [px] of the windows
    """
    if len(at) < _MIN_MATCHES:
        return 1.0
    chosen = np.linspace(0, len(at) - 1, min(len(at), _SAMPLE_SIZE)).astype(int)
    at, rows = at[chosen], rows[chosen]
    half = int(halves[chosen].min())
    side = np.arange(-half, half + 1.0)
    inner = np.stack(np.meshgrid(side, side), axis=-1)
    template = first.values(at[:, None, None] + inner).reshape(len(at), len(side), -1)
    moved = np.einsum("nij,xyj->nxyi", rows[:, 2:6].reshape(-1, 2, 2), inner) + rows[:, None, None, :2]
    sampled = second.values(moved).reshape(template.shape)
    residuals = sampled - rows[:, 6, None, None] - rows[:, 7, None, None] * template
    finite = np.isfinite(residuals).all(axis=(1, 2))
    if not finite.any():
        return 1.0
    residuals, template = residuals[finite], template[finite]
    residual = _autocovariance(residuals - residuals.mean(axis=(1, 2), keepdims=True))
    slope = _autocovariance(np.gradient(template, axis=1)) + _autocovariance(np.gradient(template, axis=2))
    if not (residual[0, _MAX_LAG_PX] > 0 and slope[0, _MAX_LAG_PX] > 0):
        return 1.0
    product = (residual / residual[0, _MAX_LAG_PX]) * (slope / slope[0, _MAX_LAG_PX])
    # each lag but zero counts twice, for its opposite
    total = 2.0 * (product[1:].sum() + product[0, _MAX_LAG_PX + 1 :].sum()) + 1.0
    shares = [_interpolation_share(a, row[:2], row[2:6], len(side), row[7]) for a, row in zip(at[finite], rows[finite])]
    return max(1.0, float(total * np.mean(shares)))


def _autocovariance(field: NDArray) -> NDArray:
    """(L + 1, 2 L + 1) autocovariance of fields (K, n, n) at lags 0..L down and -L..L to the right."""
    out, (_, height, width) = np.empty((_MAX_LAG_PX + 1, 2 * _MAX_LAG_PX + 1)), field.shape
    for down in range(_MAX_LAG_PX + 1):
        for right in range(-_MAX_LAG_PX, _MAX_LAG_PX + 1):
            a = field[:, : height - down, max(0, -right) : width - max(0, right)]
            b = field[:, down:, max(0, right) : width - max(0, -right)]
            out[down, _MAX_LAG_PX + right] = (a * b).mean()
    return out


def _interpolation_share(at: NDArray, uv: NDArray, maps: NDArray, n: int, gain: float) -> float:
    """Share of the noise's variance that remains after interpolation, for which the kernels correct already."""
    second_noise = spline.window_noise(*uv, *maps, n)
    first_noise = spline.value_noise(at[0] - np.floor(at[0])) * spline.value_noise(at[1] - np.floor(at[1]))
    return float((second_noise + gain**2 * first_noise) / (1.0 + gain**2))
