"""A flat surface before one camera that faces it: plane displacement and strain without a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.photogrammetry.least_squares_matching import WINDOW, Matches
from kinefit.photogrammetry.region_growing import LEAST_CORRELATION, Grid
from kinefit.photogrammetry.seeding.unaided import grow_over_time
from kinefit.photogrammetry.spline_image import SplineImage
from kinefit.photogrammetry.surface import MeasuredSurface, refuse_repeated, refuse_untextured

_EXACT = 1e-6  # [px²] of the places in the first image, which define the points


def measure_flat(
    states: Sequence[SplineImage],
    grid: Grid,
    pixel: float,
    *,
    window: int | ArrayLike = WINDOW,
    least: float = LEAST_CORRELATION,
    incremental: bool = False,
) -> list[MeasuredSurface]:
    """Places of a flat surface's points in several states, from one camera whose axis is at right angles to it.

    Distance and lens must stay as they are: a motion towards the camera by a thousandth of the distance looks like a
    strain of 1e-3, and what the lens distorts is not put right.

    Parameters
    ----------
    states : its images, two or more of one size
    grid : of the first image
    pixel : [m] of the surface that a pixel shows
    window, least : as in `measure`
    incremental : match each image with the one before, not the first

    Returns
    -------
    list of Surface
        x to the right, y up, z towards the camera, zero; the origin at the first image's corner.

    Raises
    ------
    ObservationError
        Fewer than two images, other sizes, a pixel that is not positive; nothing found again; texture that
        repeats.
    """
    if len(states) < 2 or not 0 < pixel < np.inf:
        problem = f"{len(states)} images, a pixel of {pixel} m"
        raise ObservationError(problem, remedy="Give one image before and one or more after, and a positive length.")
    first, size = states[0], states[0].size
    here, out = grid, [_surface(grid, None, pixel)]
    for k in range(1, len(states)):
        image = states[k]
        if image.size != size:
            problem = f"image {k} has {image.size[0]}x{image.size[1]} px, the first {size[0]}x{size[1]}"
            raise ObservationError(problem, remedy="Give images of one camera.")
        found = grow_over_time(first, image, here, window=window, least=least)
        if not found.found.any():
            refuse_untextured(first, "first image")
            remedy = "Light it better, take a larger window, or images of states between."
            raise ObservationError(f"nothing of the first image is found in image {k}", remedy=remedy)
        refuse_repeated(first, image, found, f"image {k}")
        out.append(_surface(grid, found, pixel))
        if incremental:
            first, here = image, replace(grid, points=found.uv)
    return out


def _surface(grid: Grid, found: Matches | None, pixel: float) -> MeasuredSurface:
    """Of the first image, or of the matches in a later one."""
    uv: NDArray = grid.points if found is None else found.uv
    exact = np.where(grid.inside[:, None, None], _EXACT * np.eye(2), np.nan)
    turned = np.diag([pixel, -pixel])
    covariance = np.zeros((len(uv), 3, 3))
    covariance[:, :2, :2] = turned @ (exact if found is None else found.covariance) @ turned
    x = np.column_stack([uv @ turned, np.where(np.isfinite(uv[:, 0]), 0.0, np.nan)])
    correlation = np.where(grid.inside, 1.0, np.nan) if found is None else found.correlation
    return MeasuredSurface(
        grid, ("image",), x, covariance, uv[:, None], correlation, np.where(np.isfinite(correlation), 0.0, np.nan),
        np.zeros((len(uv), 0, 2, 2)),
    )  # fmt: skip
