"""Normalised cross-correlation in a search box: a first guess for least-squares matching, to the pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.photogrammetry.least_squares_matching import WINDOW, halves_of, places
from kinefit.photogrammetry.matching import _kernels_correlation as kernels
from kinefit.photogrammetry.spline_image import SplineImage


@dataclass(frozen=True, eq=False)
class Correlations:
    """Where windows look most alike.

    Parameters
    ----------
    uv : (N, 2) [px] of the highest correlation, whole pixels from the window's centre; NaN where box or window leave
    best : (N,) correlation there
    runner_up : (N,) highest correlation more than half a window away: near `best` where texture repeats
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
    """Scan a box of the second image for windows of the first.

    Parameters
    ----------
    points : (N, 2) [px] centres of the windows in the first image
    centres : (N, 2) [px] of the boxes in the second, where they are expected; default: the same places
    reach : [px] from the centre to the box's sides
    window : odd side [px]
    """
    at = places(points)
    boxes = at if centres is None else places(centres)
    half = int(halves_of(window, len(at))[0]) if len(at) else 0
    uv, best, runner_up = np.empty((len(at), 2)), np.empty(len(at)), np.empty(len(at))
    kernels.search_boxes(first.grey, second.grey, at, boxes, half, int(reach), uv, best, runner_up)
    return Correlations(uv, best, runner_up)
