"""The noise of a depth image, told from the image itself, and the image without most of it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.images import _kernels_depth as kernels
from kinefit.images.depth import _NOISE, _image, clean, slope_of

_BLOCK = 8  # [px] noise is told from about a hundred second differences: their median is right to a tenth
_REACH = 2  # [px] window of 5 x 5: narrower than a forearm four metres from a camera of 160 x 124 pixels
_ALIKE = 3.0 * np.sqrt(2.0)  # [standard deviations] the difference of two pixels of one surface that noise explains
_FINE = 0.002  # [m] noise that no model of a person feels: cylinders are good to a centimetre
_SUPPORT = 2 * _REACH + 2  # alike in the window, at least: a line of flying pixels along an edge has one less
_STEP = 0.03  # [m] between pixels of one surface: noise of 7 mm explains it, and more of it is seldom alone in it
_SLANT = math.radians(75.0)  # from pixel to pixel across a surface; along it, depth is alike on a flatter one too
_ALONE = 2  # neighbours on the same surface, at least: of 20 % random pixels 0.3 % have them by chance, with 1 7 %
_AROUND = 5  # of a surface about a pixel that went, at least: beside a straight edge there are three on either side
_NEVER = 9  # of eight neighbours


def without_speckles(depth: NDArray, camera: Camera, sigma: float = 0.0, *, closed: bool = False) -> NDArray:
    """A depth image without pixels that stand alone: those of which fewer than two neighbours are on one surface.

    Neighbours are the eight about a pixel. Pixels that a sensor mismatches, that interfere or that a transmission
    spoils lie anywhere along their rays, one by one; a limb that is two pixels wide stays. An image of scattered
    pixels, most of them without neighbours, stays as it is.

    Parameters
    ----------
    depth : (H, W) [m] along the optical axis, 0 where nothing was measured
    camera : Camera of the sensor, for the size of its pixels
    sigma : float [m]
        Standard deviation of a pixel, where it is known to be more than the usual centimetre.
    closed : bool
        Within a surface, the mean of its neighbours takes the place of what goes.

    Returns
    -------
    (H, W) float32 [m], 0 where there is nothing

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """
    depth = _image(depth, camera)
    if depth.shape[1] < 2:
        return depth
    out = np.empty_like(depth)
    noise, slope, around = max(_STEP, _ALIKE * sigma), slope_of(camera, _SLANT), _AROUND if closed else _NEVER
    seen, kept = kernels.drop_speckles(depth, noise, slope, _ALONE, around, out)
    return out if 2 * kept >= seen else depth


def noise_of(depth: NDArray) -> NDArray:
    """(H, W) float32 [m] standard deviation of a pixel's depth, from the second differences around it.

    Along rows and columns, in blocks, by the median: surfaces are about plane over three pixels, and edges are few.
    White noise is found as it is, growing with distance and slant; noise that neighbours share is not.

    Parameters
    ----------
    depth : (H, W) [m], 0 where nothing was measured
    """
    depth = _image(depth)
    rows, columns = (-(-n // _BLOCK) for n in depth.shape)
    whole = np.full((rows * _BLOCK, columns * _BLOCK), np.nan, np.float32)
    whole[: depth.shape[0], : depth.shape[1]] = np.where((depth > 0.0) & (depth < np.inf), depth, np.nan)
    second = np.full((2, *whole.shape), np.nan, np.float32)
    second[0, 1:-1] = whole[2:] - 2.0 * whole[1:-1] + whole[:-2]
    second[1, :, 1:-1] = whole[:, 2:] - 2.0 * whole[:, 1:-1] + whole[:, :-2]
    blocks = np.abs(second).reshape(2, rows, _BLOCK, columns, _BLOCK).transpose(1, 3, 0, 2, 4)
    blocks = blocks.reshape(rows, columns, -1)
    blocks.sort(axis=-1)  # NaN last
    count = np.isfinite(blocks).sum(axis=-1)
    middle = np.take_along_axis(blocks, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    known = count >= _BLOCK
    usual = float(np.median(middle[known])) if known.any() else 0.0
    # second differences have sqrt(1 + 4 + 1) times the deviation, its median is 0.6745 of that
    sigma = np.where(known, middle, usual).astype(np.float32) / np.float32(0.6745 * np.sqrt(6.0))
    sigma = cv2.medianBlur(sigma, 3)  # a block full of edges is like those around
    return np.repeat(np.repeat(sigma, _BLOCK, 0), _BLOCK, 1)[: depth.shape[0], : depth.shape[1]]


def denoised(depth: NDArray, camera: Camera, sigma: NDArray | None = None) -> NDArray:
    """A depth image with most of its noise and without flying pixels: the sigma filter (Lee, CVGIP 24, 1983).

    What `clean` finds to be flying goes first. Then a pixel becomes the mean of those of its window that differ from it
    by no more than noise explains; surfaces do not mix. One that few others are like, noise and slant allowed for, is
    on no surface and goes too. An image with next to no noise stays as it is, and so does one of scattered pixels, most
    of them without neighbours.

    Parameters
    ----------
    depth : (H, W) [m], 0 where nothing was measured
    camera : Camera of the sensor, for the size of its pixels
    sigma : (H, W) [m], optional
        Standard deviations; default `noise_of`.

    Returns
    -------
    (H, W) [m], 0 where there is nothing; not rounded to float32 where it stays as it is
    """
    given, depth = np.asarray(depth), _image(depth, camera)
    seen = (depth > 0.0) & (depth < np.inf)
    raw, depth = np.where(seen, given, 0.0), np.where(seen, depth, np.float32(0.0))
    sigma = noise_of(depth) if sigma is None else np.asarray(sigma, np.float32)
    noise = np.float32(_ALIKE) * sigma
    if not seen.any() or float(np.median(sigma[seen])) < _FINE:
        return raw
    depth = clean(depth, camera, noise=max(float(np.median(noise[seen])), _NOISE))
    if 2 * np.count_nonzero(depth) < np.count_nonzero(seen):
        return raw
    surface = np.maximum(noise, np.float32(slope_of(camera)) * depth)
    total, alike, support = np.zeros_like(depth), np.zeros_like(depth), np.zeros(depth.shape, np.uint8)
    h, w = depth.shape
    padded = np.pad(depth, _REACH)
    for i in range(2 * _REACH + 1):
        for j in range(2 * _REACH + 1):
            other = padded[i : i + h, j : j + w]
            step = np.where(other > 0.0, np.abs(other - depth), np.float32(np.inf))
            near = step <= noise
            total += other * near
            alike += near
            support += step <= surface
    return np.where((depth > 0.0) & (support >= _SUPPORT), total / np.maximum(alike, 1.0), np.float32(0.0))
