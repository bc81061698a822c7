"""Depth images to points: range gate, flying pixels, world points, normals, fewer points."""

from __future__ import annotations

import math

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
