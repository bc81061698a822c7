"""Plane displacement and strain of a flat surface from one camera that faces it, without calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.images.photogrammetry.least_squares_matching import MIN_CORRELATION, WINDOW, Grid, Matches
from kinefit.images.photogrammetry.seeding.unaided import grow_over_time
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface import MeasuredSurface, reject_repeated_texture, reject_untextured

_EXACT_VARIANCE = 1e-6  # [px²] of the points in the first image, which are exact by definition


def measure_flat(
    states: Sequence[SplineImage],
    grid: Grid,
    pixel: float,
    *,
    window: int | ArrayLike = WINDOW,
    least: float = MIN_CORRELATION,
    incremental: bool = False,
) -> list[MeasuredSurface]:
    """Measure points of a flat surface in several states by one camera whose axis is normal to it.

    Distance and lens must not change: a motion towards the camera by a thousandth of the distance gives a strain of
    1e-3. Lens distortion is not corrected.

    Parameters
    ----------
    states : two or more images of one size
    grid : of the first image
    pixel : [m] size of a pixel on the surface
    window : odd side [px] of the matching windows, of all or of each
    least : least correlation, 0 to 1, of a match
    incremental : match each image with the one before, not the first

    Returns
    -------
    list of MeasuredSurface
        x_world (N, 3) [m]: x to the right, y up, z = 0; the origin is the corner of the first image

    Raises
    ------
    ObservationError
        Fewer than two images, different sizes, a pixel that is not positive, no match, or texture that repeats.
    """
    if len(states) < 2 or not 0 < pixel < np.inf:
        problem = f"{len(states)} images, a pixel of {pixel} m"
        raise ObservationError(problem, remedy="Give one image before and one or more after, and a positive length.")
    first, size = states[0], states[0].size
    current_grid, out = grid, [_surface(grid, None, pixel)]
    for k in range(1, len(states)):
        image = states[k]
        if image.size != size:
            problem = f"image {k} has {image.size[0]}x{image.size[1]} px, the first {size[0]}x{size[1]}"
            raise ObservationError(problem, remedy="Give images of one camera.")
        found = grow_over_time(first, image, current_grid, window=window, least=least)
        if not found.found.any():
            reject_untextured(first, "first image")
            remedy = "Use better light, a larger window, or images of states between."
            raise ObservationError(f"no point of the first image is found in image {k}", remedy=remedy)
        reject_repeated_texture(first, image, found, f"image {k}")
        out.append(_surface(grid, found, pixel))
        if incremental:
            first, current_grid = image, replace(grid, points=found.uv)
    return out


def _surface(grid: Grid, found: Matches | None, pixel: float) -> MeasuredSurface:
    """The surface of the first image, or of the matches in a later one."""
    uv: NDArray = grid.points if found is None else found.uv
    exact = np.where(grid.inside[:, None, None], _EXACT_VARIANCE * np.eye(2), np.nan)
    axes = np.diag([pixel, -pixel])
    covariance = np.zeros((len(uv), 3, 3))
    covariance[:, :2, :2] = axes @ (exact if found is None else found.covariance) @ axes
    x = np.column_stack([uv @ axes, np.where(np.isfinite(uv[:, 0]), 0.0, np.nan)])
    correlation = np.where(grid.inside, 1.0, np.nan) if found is None else found.correlation
    return MeasuredSurface(
        grid, ("image",), x, covariance, uv[:, None], correlation, np.where(np.isfinite(correlation), 0.0, np.nan),
        np.zeros((len(uv), 0, 2, 2)),
    )  # fmt: skip
