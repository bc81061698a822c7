"""Normalised cross-correlation in a search box: start values for least-squares matching, to the pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.photogrammetry.least_squares_matching import WINDOW, as_points, half_sides
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
