"""Densities of colours in CIELab, tabulated in cells: Parzen estimates, and mixtures of Gaussians (P3 2.4.1)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera

_CELL_WIDTH = 4.0  # [units of Lab] of the histogram
_GRID_SHAPE = (26, 65, 65)  # cells along L, a and b
COLOURS = int(np.prod(_GRID_SHAPE))
_MIN_DENSITY = 1e-8  # of every colour: a hundredth, spread over 1e6 units³ of Lab
_PARZEN_SIGMA = 4.0  # [units of Lab]
_GAUSSIANS = 5  # of a mixture
_EM_ITERATIONS = 20


def colour_cells(image: ArrayLike, camera: Camera) -> NDArray:
    """Cell (H W,) in CIELab of each pixel of an image (H, W, 3) uint8 RGB.

    Raises
    ------
    ObservationError
        An image of another type, or of another size than the camera's.
    """
    rgb = np.asarray(image)
    if rgb.shape != (*camera.size[::-1], 3) or rgb.dtype != np.uint8:
        problem = f"an image of shape {rgb.shape} and {rgb.dtype} of {camera.name}, whose size is {camera.size}"
        raise ObservationError(problem, remedy="Give (H, W, 3) uint8 RGB in the size of the calibration.")
    lab = cv2.cvtColor(rgb.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2Lab).reshape(-1, 3) + (0, 128, 128)
    return np.ravel_multi_index(tuple((lab / _CELL_WIDTH).astype(np.int64).T), _GRID_SHAPE, mode="clip")


def parzen_density(count: NDArray) -> NDArray:
    """Logarithm (N,) of the Parzen density estimate from pixel counts (N,) in the cells of CIELab."""
    density = gaussian_filter(count.reshape(_GRID_SHAPE), _PARZEN_SIGMA / _CELL_WIDTH, mode="constant").ravel()
    return np.asarray(np.log(density / max(count.sum(), 1.0) / _CELL_WIDTH**3 + _MIN_DENSITY))


def mixture_density(count: NDArray) -> NDArray:
    """Logarithm (N,) of a Gaussian mixture density, fitted by EM to pixel counts (N,) in the cells of CIELab."""
    every = (np.indices(_GRID_SHAPE).reshape(3, -1).T + 0.5) * _CELL_WIDTH
    used = np.flatnonzero(count)
    x, n, share = every[used], count[used][:, None], np.zeros((len(used), _GAUSSIANS))
    of = np.minimum(np.cumsum(n) / max(n.sum(), 1.0), 0.999) * _GAUSSIANS  # initial classes of equal size by lightness
    share[np.arange(len(used)), of.astype(np.int64)] = 1.0
    for _ in range(_EM_ITERATIONS):
        weight = (n * share).sum(axis=0) + 1e-9
        mean = (n * share).T @ x / weight[:, None]
        off = x[:, None] - mean
        C = np.einsum("nk,nki,nkj->kij", n * share, off, off) / weight[:, None, None] + _CELL_WIDTH**2 / 12 * np.eye(3)
        log = _gaussians(x, weight, mean, C)
        share = np.exp(log - np.logaddexp.reduce(log, axis=1, keepdims=True))
    return np.logaddexp(np.logaddexp.reduce(_gaussians(every, weight, mean, C), axis=1), np.log(_MIN_DENSITY))


def _gaussians(x: NDArray, weight: NDArray, mean: NDArray, C: NDArray) -> NDArray:
    """Logarithms (N, K) of each Gaussian's contribution to the density at x (N, 3)."""
    L = np.linalg.cholesky(np.linalg.inv(C))
    square = np.stack([np.square((x - m) @ l).sum(axis=1) for m, l in zip(mean, L)], axis=1)
    return np.asarray(np.log(weight / weight.sum()) - 0.5 * (square + np.linalg.slogdet(2.0 * np.pi * C)[1]))


DENSITIES = {"parzen": parzen_density, "mixture": mixture_density}
