"""Depth images: range gate, flying pixels and speckles, noise, world points, normals, fewer points."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images import _kernels_depth as kernels

GRAZING = math.radians(85.0)  # between line of sight and normal: beyond it depth is not measurable, it is an edge
_MIN_STEP = 0.01  # [m] below which a step of depth is noise, whatever the slope


def _image(depth: NDArray, camera: Camera | None = None) -> NDArray:
    depth = np.ascontiguousarray(depth, np.float32)
    if depth.ndim != 2 or not depth.size or (camera is not None and depth.shape != camera.size[::-1]):
        wanted = f"{camera.size[::-1]}, as camera {camera.name} has" if camera else "(height, width)"
        raise ObservationError(
            f"a depth image of shape {depth.shape}", remedy=f"Give {wanted}, or use `camera.scaled(size)`."
        )
    return depth


def slope_of(camera: Camera, grazing: float = GRAZING) -> float:
    """Largest depth step between neighbouring pixels, as a share of the depth, on a surface seen at `grazing` [rad].

    The footprint of a pixel is z / f. A plane whose normal leans by θ from the line of sight recedes by z tan θ / f.
    """
    return math.tan(grazing) / min(camera.matrix[0, 0], camera.matrix[1, 1])


def clean(
    depth: NDArray,
    camera: Camera | None = None,
    *,
    near: float = 0.0,
    far: float = math.inf,
    noise: float = _MIN_STEP,
    grazing: float = GRAZING,
) -> NDArray:
    """Remove flying pixels and depths out of range from a depth image.

    A flying pixel mixes the depths in front of and behind an edge, so that it lies between its neighbours and far from
    both. A pixel is removed if two opposite neighbours (left and right, or above and below) are missing or differ by
    more than the noise and by more than a surface seen at `grazing` allows. Pixels adjacent to an edge are kept,
    because the neighbour on the other side supports them. NaN counts as not measured.

    Parameters
    ----------
    depth : (H, W) [m] along the optical axis
    camera : Camera, optional
        Of the sensor, for the angular size of its pixels. Without it only the range is gated.
    near, far : float [m]
        Depths outside of this range are removed.
    noise : float [m]
        Step between neighbours that noise alone explains: three standard deviations.
    grazing : float [rad]
        Largest angle between line of sight and normal of a surface that is kept.

    Returns
    -------
    (H, W) float32 [m], 0 where not measured or removed

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """
    depth = _image(depth, camera)
    out = np.empty_like(depth)
    kernels.drop_flying(depth, near, far, noise, slope_of(camera, grazing) if camera else 0.0, out)
    return out


def to_points(
    depth: NDArray,
    camera: Camera,
    *,
    step: int = 1,
    mask: NDArray | None = None,
    near: float = 0.0,
    far: float = math.inf,
) -> NDArray:
    """World points of a depth image, with lens distortion removed.

    Parameters
    ----------
    depth : (H, W) [m] along the optical axis
    camera : Camera
    step : int [px]
        Every step-th pixel of every step-th row.
    mask : (H, W) bool, optional
        Pixels that are used; default all.
    near, far : float [m]
        Range of depths that are used.

    Returns
    -------
    (N, 3) [m] in the world, row by row of the image

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """
    depth = _image(depth, camera)
    if mask is not None:
        depth = np.where(mask, depth, np.float32(0.0))
    T, step = camera.T_world_camera, max(int(step), 1)
    out = np.empty((-(-depth.shape[0] // step) * -(-depth.shape[1] // step), 3))
    n = kernels.points(depth, camera.ray_table, T[:3, :3].copy(), T[:3, 3].copy(), step, near, far, out)
    return out[:n]


def normals(
    depth: NDArray, camera: Camera, *, step: int = 1, reach: int = 2, noise: float = _MIN_STEP, grazing: float = GRAZING
) -> NDArray:
    """Unit normals (N, 3) in the world, pointing to the sensor, of the points that `to_points` gives for this image.

    Each is the cross product of the chords between the pixels `reach` [px] away on both sides. It is zero at edges and
    holes, and on surfaces seen at more than `grazing` [rad].
    """
    depth = _image(depth, camera)
    step = max(int(step), 1)
    out = np.empty((-(-depth.shape[0] // step) * -(-depth.shape[1] // step), 3))
    R = camera.T_world_camera[:3, :3].copy()
    n = kernels.normals(depth, camera.ray_table, R, step, int(reach), noise, slope_of(camera, grazing), out)
    return out[:n]


def downsample(points: NDArray, *, factor: float = 1.0, minimum: int = 0, maximum: int | None = None) -> NDArray:
    """Keep one of `factor` points, but at least `minimum` and at most `maximum` of them (P2 3.2).

    Parameters
    ----------
    points : (N, ...)
        In the order of the image. Every n/m-th is kept, so that the sample stays even over the image.
    factor : float >= 1
    minimum, maximum : int, numbers of points; default no bounds

    Raises
    ------
    ObservationError
        A factor below 1, or a minimum above the maximum.
    """
    n = len(points)
    if not factor >= 1.0 or minimum < 0 or (maximum is not None and maximum < max(minimum, 1)):
        raise ObservationError(
            f"points by factor {factor:g}, at least {minimum}, at most {maximum}",
            remedy="Give a factor of 1 or more, and minimum <= maximum.",
        )
    wanted = max(math.ceil(n / factor), minimum)
    wanted = min(wanted, n, n if maximum is None else maximum)
    if wanted == n:
        return points
    return points[((np.arange(wanted) + 0.5) * (n / wanted)).astype(np.intp)]


_BLOCK_PX = 8  # a block has about a hundred second differences: their median is right to a tenth
_WINDOW_PX = 2  # half a window of 5 x 5: narrower than a forearm four metres from a camera of 160 x 124 pixels
_MAX_DIFFERENCE_SIGMAS = 3.0 * np.sqrt(2.0)  # between two pixels of one surface: three of the difference
_MIN_SIGMA = 0.002  # [m] less noise does not matter: the cylinders of a body are good to a centimetre
_MIN_SUPPORT = 2 * _WINDOW_PX + 2  # pixels of one surface in the window: a line of flying pixels has one less
_MAX_STEP = 0.03  # [m] between pixels of one surface: noise of 7 mm explains it, and stronger noise rarely
_MAX_SLANT = math.radians(75.0)  # across a surface; along it, depth changes less on a more slanted one
_MIN_NEIGHBOURS = 2  # on one surface: 0.3 % of random pixels with density 20 % have two by chance, 7 % have one
_MIN_FILL_NEIGHBOURS = 5  # on one surface about a removed pixel: a straight edge has three on either side
_NO_FILL = 9  # more than the eight neighbours: removed pixels stay empty


def without_speckles(depth: NDArray, camera: Camera, sigma: float = 0.0, *, closed: bool = False) -> NDArray:
    """Remove isolated pixels from a depth image: those that share a surface with fewer than two of their neighbours.

    Neighbours are the eight pixels around. Mismatches, interference and transmission errors lie anywhere along their
    rays, pixel by pixel, so they are removed; a limb two pixels wide is kept. An image in which most pixels have no
    neighbours is returned unchanged.

    Parameters
    ----------
    depth : (H, W) [m] along the optical axis, 0 where nothing was measured
    camera : Camera of the sensor, for the size of its pixels
    sigma : float [m]
        Standard deviation of a pixel's depth, if known to be more than a centimetre.
    closed : bool
        Whether removed pixels inside a surface are filled with the mean of their neighbours.

    Returns
    -------
    (H, W) float32 [m], 0 where not measured or removed

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """
    depth = _image(depth, camera)
    if depth.shape[1] < 2:
        return depth
    out = np.empty_like(depth)
    noise, min_fill = max(_MAX_STEP, _MAX_DIFFERENCE_SIGMAS * sigma), _MIN_FILL_NEIGHBOURS if closed else _NO_FILL
    measured, kept = kernels.drop_speckles(depth, noise, slope_of(camera, _MAX_SLANT), _MIN_NEIGHBOURS, min_fill, out)
    return out if 2 * kept >= measured else depth


def noise_of(depth: NDArray) -> NDArray:
    """Estimate the standard deviation of each pixel's depth: (H, W) float32 [m].

    The median of second differences along rows and columns, in blocks of 8 x 8 pixels: surfaces are nearly plane over
    three pixels, and edges are few. White noise is estimated with its growth over distance and slant. Noise that is
    correlated between neighbours is not.

    Parameters
    ----------
    depth : (H, W) [m], 0 where nothing was measured

    Raises
    ------
    ObservationError
        No depth image.
    """
    depth = _image(depth)
    rows, columns = (-(-n // _BLOCK_PX) for n in depth.shape)
    whole = np.full((rows * _BLOCK_PX, columns * _BLOCK_PX), np.nan, np.float32)
    whole[: depth.shape[0], : depth.shape[1]] = np.where((depth > 0.0) & (depth < np.inf), depth, np.nan)
    second = np.full((2, *whole.shape), np.nan, np.float32)
    second[0, 1:-1] = whole[2:] - 2.0 * whole[1:-1] + whole[:-2]
    second[1, :, 1:-1] = whole[:, 2:] - 2.0 * whole[:, 1:-1] + whole[:, :-2]
    blocks = np.abs(second).reshape(2, rows, _BLOCK_PX, columns, _BLOCK_PX).transpose(1, 3, 0, 2, 4)
    blocks = blocks.reshape(rows, columns, -1)
    blocks.sort(axis=-1)  # NaN last
    count = np.isfinite(blocks).sum(axis=-1)
    middle = np.take_along_axis(blocks, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    known = count >= _BLOCK_PX
    default = float(np.median(middle[known])) if known.any() else 0.0
    # second differences have sqrt(1 + 4 + 1) times the deviation, its median is 0.6745 of that
    sigma = np.where(known, middle, default).astype(np.float32) / np.float32(0.6745 * np.sqrt(6.0))
    sigma = cv2.medianBlur(sigma, 3)  # a block full of edges is like those around
    return np.repeat(np.repeat(sigma, _BLOCK_PX, 0), _BLOCK_PX, 1)[: depth.shape[0], : depth.shape[1]]


def denoised(depth: NDArray, camera: Camera, sigma: NDArray | None = None) -> NDArray:
    """Denoise a depth image and remove its flying pixels: the sigma filter (Lee, CVGIP 24, 1983).

    `clean` removes flying pixels first. Then each pixel becomes the mean of those pixels of its 5 x 5 window that
    differ from it by no more than noise explains, so that surfaces do not mix. A pixel is removed if too few pixels of
    the window lie on its surface. An image with less noise than 2 mm is returned unchanged, and so is one in which most
    pixels have no neighbours.

    Parameters
    ----------
    depth : (H, W) [m], 0 where nothing was measured
    camera : Camera of the sensor, for the size of its pixels
    sigma : (H, W) [m], optional
        Standard deviations; default `noise_of`.

    Returns
    -------
    (H, W) [m], 0 where not measured or removed; not rounded to float32 if returned unchanged

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """
    original, depth = np.asarray(depth), _image(depth, camera)
    measured = (depth > 0.0) & (depth < np.inf)
    raw, depth = np.where(measured, original, 0.0), np.where(measured, depth, np.float32(0.0))
    sigma = noise_of(depth) if sigma is None else np.asarray(sigma, np.float32)
    noise = np.float32(_MAX_DIFFERENCE_SIGMAS) * sigma
    if not measured.any() or float(np.median(sigma[measured])) < _MIN_SIGMA:
        return raw
    depth = clean(depth, camera, noise=max(float(np.median(noise[measured])), _MIN_STEP))
    if 2 * np.count_nonzero(depth) < np.count_nonzero(measured):
        return raw
    surface = np.maximum(noise, np.float32(slope_of(camera)) * depth)
    total, alike, support = np.zeros_like(depth), np.zeros_like(depth), np.zeros(depth.shape, np.uint8)
    h, w = depth.shape
    padded = np.pad(depth, _WINDOW_PX)
    for i in range(2 * _WINDOW_PX + 1):
        for j in range(2 * _WINDOW_PX + 1):
            other = padded[i : i + h, j : j + w]
            step = np.where(other > 0.0, np.abs(other - depth), np.float32(np.inf))
            near = step <= noise
            total += other * near
            alike += near
            support += step <= surface
    return np.where((depth > 0.0) & (support >= _MIN_SUPPORT), total / np.maximum(alike, 1.0), np.float32(0.0))
