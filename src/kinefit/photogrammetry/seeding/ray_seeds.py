"""Seeds found along lines of sight: where on its ray a point of one image is seen in another, by cross-correlation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.geometry.camera import Camera
from kinefit.photogrammetry.least_squares_matching import places
from kinefit.photogrammetry.region_growing import Seeds
from kinefit.photogrammetry.seeding import _kernels_rays as kernels
from kinefit.photogrammetry.spline_image import SplineImage

WINDOW = 17  # [px] of windows that are sought: narrower ones look alike somewhere on a line of a thousand pixels
_CORNERS = 48  # of a line, evenly spaced in 1 / distance
_NEAREST, _FARTHEST = 0.5, 200.0  # distances between the cameras, between which a point is
_LEAST = 0.6  # correlation: pixels are read to the nearest, and a surface may be inclined to both cameras
_UNIQUE = 0.85  # of the best correlation, below which the runner-up on the line is
TEXTURE = 3.0  # deviations of the noise, above which grey values of a window scatter
_STRAIGHT = 1e-3  # [rad] by which the ray of an image may miss its point: a lens model that folds back


def ray_seeds(
    first: SplineImage, second: SplineImage, cameras: tuple[Camera, Camera], points: ArrayLike
) -> tuple[Seeds, NDArray[np.int64]]:
    """Points of the first image that are found, and found once, on their lines of sight in the second.

    The surface is taken to face the middle of both cameras, which gives the window's turn and shear at every distance.

    Parameters
    ----------
    cameras : of the two images
    points : (S, 2) [px] in the first image; they are taken to the nearest pixel

    Returns
    -------
    Seeds
        Of those that were found.
    index : (K,) of them among the points
    """
    at = np.rint(places(points))
    lines, maps = _lines(cameras, at)
    uv, found = np.empty_like(at), np.empty((len(at), 4))
    best, runner_up = np.empty(len(at)), np.empty(len(at))
    least = (TEXTURE * first.noise) ** 2
    kernels.search_lines(first.grey, second.grey, at, lines, maps, WINDOW // 2, least, uv, found, best, runner_up)
    good = np.flatnonzero((best >= _LEAST) & (runner_up < _UNIQUE * best))
    return Seeds(at[good], uv[good], found[good].reshape(-1, 2, 2)), good


def _lines(cameras: tuple[Camera, Camera], at: NDArray) -> tuple[NDArray, NDArray]:
    """Places (S, K, 2) [px] in the second image of points on the rays of the first, and maps (S, K, 4)."""
    one, two = cameras
    base = float(np.linalg.norm(one.centre_world - two.centre_world))
    distance = base / np.linspace(1.0 / _NEAREST, 1.0 / _FARTHEST, _CORNERS)
    ray = one.ray(at)
    beside = [one.ray(at + step) - ray for step in np.eye(2)]
    x = one.centre_world + distance[:, None] * ray[:, None]
    uv, J = two.project_with_jacobian(x)
    back = x - two.centre_world
    back /= np.linalg.norm(back, axis=2, keepdims=True)
    normal = ray[:, None] + back
    inclined = np.einsum("ski,si->sk", normal, ray)
    out = np.empty((*uv.shape, 2))
    for k, step in enumerate(beside):
        across = step[:, None] - ray[:, None] * (np.einsum("ski,si->sk", normal, step) / inclined)[..., None]
        out[..., k] = np.einsum("skij,skj->ski", J, distance[:, None] * across)
    inside = ((uv > 0) & (uv < np.array(two.size))).all(axis=2, keepdims=True)
    uv = np.where(inside, uv, np.nan)
    bent = np.linalg.norm(two.ray(uv) - back, axis=2, keepdims=True)
    uv = np.where(bent < _STRAIGHT, uv, np.nan)
    return np.ascontiguousarray(uv), np.ascontiguousarray(out.reshape(*uv.shape[:2], 4))
