"""Depth images to points: range gate, flying pixels, world points, normals, fewer points."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images import _kernels_depth as kernels

GRAZING = math.radians(85.0)  # a surface seen flatter than this has no measurable depth: it is an edge
_NOISE = 0.01  # [m] below which a step of depth is noise, whatever the slope


def _image(depth: NDArray, camera: Camera | None = None) -> NDArray:
    depth = np.ascontiguousarray(depth, np.float32)
    if depth.ndim != 2 or not depth.size or (camera is not None and depth.shape != camera.size[::-1]):
        wanted = f"{camera.size[::-1]}, as camera {camera.name}" if camera else "(height, width)"
        raise ObservationError(
            f"a depth image of shape {depth.shape}", remedy=f"Give {wanted}; `camera.scaled(size)` is one of its size."
        )
    return depth


def slope_of(camera: Camera, grazing: float = GRAZING) -> float:
    """Largest step of depth from pixel to pixel, as share of the depth, on a surface seen at an angle `grazing` [rad].

    The footprint of a pixel is z / f; a plane whose normal leans by θ from the line of sight recedes by z tan θ / f.
    """
    return math.tan(grazing) / min(camera.matrix[0, 0], camera.matrix[1, 1])


def clean(
    depth: NDArray,
    camera: Camera | None = None,
    *,
    near: float = 0.0,
    far: float = math.inf,
    noise: float = _NOISE,
    grazing: float = GRAZING,
) -> NDArray:
    """Range gate and flying pixels: what is no surface becomes 0.

    A pixel at an edge mixes the depths in front and behind; it stands between its neighbours across the edge and far
    from both. Where two opposite neighbours (left and right, or above and below) both differ by more than the noise
    and by more than a surface seen at `grazing` would, or are missing, it goes. Pixels beside an edge keep the support
    of the other side. NaN counts as not measured.

    Parameters
    ----------
    depth : (H, W) [m] along the optical axis
    camera : Camera, optional
        Of the sensor, for the size of its pixels; without it only the range is gated.
    near, far : float [m]
    noise : float [m]
        Step between neighbours that noise alone explains: three deviations.
    grazing : float [rad]

    Returns
    -------
    (H, W) float32 [m], 0 where there is nothing
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
    """World points of a depth image, with the lens's distortion undone.

    Parameters
    ----------
    depth : (H, W) [m] along the optical axis
    camera : Camera
    step : int [px]
        Every step-th pixel of every step-th row.
    mask : (H, W) bool, optional
    near, far : float [m]

    Returns
    -------
    (N, 3) [m], row by row of the image
    """
    depth = _image(depth, camera)
    if mask is not None:
        depth = np.where(mask, depth, np.float32(0.0))
    T, step = camera.T_world_camera, max(int(step), 1)
    out = np.empty((-(-depth.shape[0] // step) * -(-depth.shape[1] // step), 3))
    n = kernels.points(depth, camera.ray_table, T[:3, :3].copy(), T[:3, 3].copy(), step, near, far, out)
    return out[:n]


def normals(
    depth: NDArray, camera: Camera, *, step: int = 1, reach: int = 2, noise: float = _NOISE, grazing: float = GRAZING
) -> NDArray:
    """Unit normals (N, 3) in the world, turned to the sensor, of the points that `to_points` makes of the same image.

    From the chords between the pixels `reach` away on both sides; zero at edges, at holes and on what is seen flatter
    than `grazing` [rad].
    """
    depth = _image(depth, camera)
    step = max(int(step), 1)
    out = np.empty((-(-depth.shape[0] // step) * -(-depth.shape[1] // step), 3))
    R = camera.T_world_camera[:3, :3].copy()
    n = kernels.normals(depth, camera.ray_table, R, step, int(reach), noise, slope_of(camera, grazing), out)
    return out[:n]


def downsample(points: NDArray, *, factor: float = 1.0, minimum: int = 0, maximum: int | None = None) -> NDArray:
    """Evenly fewer points (P2 3.2): one of `factor`, but not below `minimum` nor above `maximum` of them.

    Parameters
    ----------
    points : (N, ...)
        Anything in an order; every n/m-th is kept, so that what was even over the image stays so.
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
