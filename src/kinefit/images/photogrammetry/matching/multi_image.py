"""Joint matching in several images along the rays of the first camera (geometrically constrained).

A. Gruen and E. Baltsavias, Geometrically constrained multiphoto matching (1988). The unknowns of a point are its
distance along the template's ray, and an affine map, a gain and an offset for each other image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.least_squares_matching import MAX_STEPS, TOLERANCE, WINDOW, as_points, half_sides
from kinefit.images.photogrammetry.matching import _kernels_matching as matching
from kinefit.images.photogrammetry.matching import _kernels_multi_image as kernels
from kinefit.images.photogrammetry.spline_image import SplineImage


@dataclass(frozen=True, eq=False)
class RayMatches:
    """Windows of the first camera's image matched along their rays.

    Parameters
    ----------
    x_world : (N, 3) [m]
    rays : (N, 3) unit directions in the world
    distance : (N,) [m] along the ray, from the first camera's centre
    variance : (N,) [m²] of the distance
    correlation : (N,) mean over the images
    parallax : (N,) [px] RMS shift away from the rays that the images alone would choose
    used : (N, C - 1) bool, which images were used
    iterations, status : (N,) int, as in `Matches`
    """

    x_world: NDArray
    rays: NDArray
    distance: NDArray
    variance: NDArray
    correlation: NDArray
    parallax: NDArray
    used: NDArray
    iterations: NDArray
    status: NDArray

    @property
    def found(self) -> NDArray[np.bool_]:
        """(N,) bool, which points were found."""
        return self.status == matching.FOUND


def match_along_rays(
    rig: Rig,
    images: Sequence[SplineImage],
    points: ArrayLike,
    distance: ArrayLike,
    deformation: ArrayLike,
    *,
    window: int | ArrayLike = WINDOW,
) -> RayMatches:
    """Match windows of the first camera's image jointly in all others.

    Parameters
    ----------
    rig, images : C cameras, and one image of each in the calibrated size
    points : (N, 2) [px] centres of the windows in the first image
    distance : (N,) [m] initial distance along the rays, right to about two pixels; NaN excludes a point
    deformation : (N, C - 1, 2, 2) initial map of the window into each other image; NaN excludes that image
    window : odd side [px], of all windows or of each

    Raises
    ------
    ObservationError
        Shapes disagree.
    """
    at, start = as_points(points), np.array(distance, float)
    maps = np.array(deformation, float)
    count = len(rig) - 1
    if start.shape != (len(at),) or maps.shape != (len(at), count, 2, 2) or count < 1 or len(images) != count + 1:
        problem = f"{len(at)} points, distances {start.shape}, deformations {maps.shape}, {len(images)} images"
        raise ObservationError(problem, remedy="Give (N,), (N, C - 1, 2, 2) and C images.")
    halves = half_sides(window, len(at))
    height, width = (max(image.size[k] for image in images[1:]) for k in (1, 0))
    stack, sizes = np.zeros((count, height, width), np.float32), np.zeros((count, 2), np.int64)
    for k, image in enumerate(images[1:]):
        sizes[k] = image.size[::-1]
        stack[k, : sizes[k, 0], : sizes[k, 1]] = image.coefficients
    first = rig.cameras[0]
    rays, origin = np.ascontiguousarray(first.ray(at)), np.ascontiguousarray(first.centre_world)
    out, image_rows = np.empty((len(at), kernels.COLUMNS)), np.empty((len(at), count, matching.ROW))
    starts = np.concatenate([start[:, None], maps.reshape(len(at), -1)], axis=1)
    noise = np.mean([image.noise**2 for image in images[1:]])
    kernels.match_rays(
        images[0].coefficients, stack, sizes, rig.packed[1:].copy(), at, origin, rays, starts, halves, MAX_STEPS,
        TOLERANCE, float(images[0].noise**2 / (images[0].noise**2 + noise)), float(images[0].noise**2), out, image_rows,
    )  # fmt: skip
    status = out[:, kernels.STATE].astype(np.int64)
    good = status == matching.FOUND
    rows = np.where(good[:, None], out, np.nan)
    return RayMatches(
        origin + rows[:, :1] * rays, rays, rows[:, kernels.DISTANCE], rows[:, kernels.VARIANCE],
        rows[:, kernels.SIMILARITY], rows[:, kernels.PARALLAX], image_rows[:, :, matching.STATUS] == matching.FOUND,
        np.nan_to_num(out[:, kernels.STEPS]).astype(np.int64), status,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Correlations:
    """Peaks of the correlation of windows.

    Parameters
    ----------
    uv : (N, 2) [px] position of the highest correlation, whole pixels from the window's centre; NaN outside the image
    best : (N,) correlation there
    runner_up : (N,) highest correlation more than half a window away; near `best` if the texture repeats
    """

    uv: NDArray
    best: NDArray
    runner_up: NDArray


def search_box(
    first: SplineImage,
    second: SplineImage,
    points: ArrayLike,
    centres: ArrayLike | None = None,
    *,
    reach: int,
    window: int = WINDOW,
) -> Correlations:
    """Search boxes of the second image for windows of the first.

    Parameters
    ----------
    points : (N, 2) [px] centres of the windows in the first image
    centres : (N, 2) [px] centres of the boxes in the second image; default: `points`
    reach : [px] half side of the boxes
    window : odd side [px]
    """
    at = as_points(points)
    boxes = at if centres is None else as_points(centres)
    half = int(half_sides(window, len(at))[0]) if len(at) else 0
    uv, best, runner_up = np.empty((len(at), 2)), np.empty(len(at)), np.empty(len(at))
    uv[:], best[:], runner_up[:] = np.nan, np.nan, np.nan
    known = np.isfinite(at).all(axis=1) & np.isfinite(boxes).all(axis=1)
    part = np.where(known[:, None], at - np.floor(at + 0.5), 0.0)
    pixel = np.where(known[:, None], at - part + 0.5, -1.0).astype(int)
    low = np.where(known[:, None], np.floor(boxes - part + 0.5), -1.0).astype(int) - int(reach) - half
    side, shape = 2 * half + 1, np.array(first.size)
    for k in np.flatnonzero(((pixel >= half) & (pixel + half < shape)).all(axis=1)):
        (i, j), (left, top) = pixel[k] - half, np.maximum(low[k], 0)
        right, bottom = np.maximum(low[k] + side + 2 * int(reach), 0)
        template, box = first.grey[j : j + side, i : i + side], second.grey[top:bottom, left:right]
        if min(box.shape) < side or template.min() == template.max():
            continue
        score = cv2.matchTemplate(box, template, cv2.TM_CCOEFF_NORMED)
        y, x = divmod(int(score.argmax()), score.shape[1])
        uv[k], best[k] = (left + half + x + part[k, 0], top + half + y + part[k, 1]), score[y, x]
        score[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1] = -1.0
        runner_up[k] = score.max()
    return Correlations(uv, best, runner_up)
