"""Normalised cross-correlation in a search box: start values for least-squares matching, to the pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.photogrammetry.least_squares_matching import WINDOW, as_points, half_sides
from kinefit.photogrammetry.matching import _kernels_correlation as kernels
from kinefit.photogrammetry.spline_image import SplineImage


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
    kernels.search_boxes(first.grey, second.grey, at, boxes, half, int(reach), uv, best, runner_up)
    return Correlations(uv, best, runner_up)
