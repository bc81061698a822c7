"""Green-Lagrange strain of a measured surface or image over a given gauge length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.photogrammetry import _kernels_strain as kernels

_MIN_FILLED_SHARE = 0.5  # of a gauge's points; with fewer, derivatives would be one-sided


@dataclass(frozen=True, eq=False)
class Strain:
    """Green-Lagrange strain on a grid, in tangent planes whose first axis runs along the grid's rows.

    Parameters
    ----------
    xx, yy, xy : (N,) E = (F'F - 1) / 2, without unit; NaN where less than half of the gauge is measured
    std_xx, std_yy, std_xy : (N,) standard deviations, from the scatter of displacements about the fitted planes
    first, second : (N,) principal strains, first >= second
    angle : (N,) [rad] from the grid's rows to the first principal direction
    rotation : (N,) [rad] in the tangent plane
    gradient : (N, 2, 2) of the displacement in the tangent plane, F - 1
    gauge : gauge length in `unit`, from the first to the last point of a row
    unit : "m" or "px"
    """

    xx: NDArray
    yy: NDArray
    xy: NDArray
    std_xx: NDArray
    std_yy: NDArray
    std_xy: NDArray
    first: NDArray
    second: NDArray
    angle: NDArray
    rotation: NDArray
    gradient: NDArray
    gauge: float
    unit: str

    def rms(self) -> dict[str, float]:
        """Root mean square of the components (numbers without unit): the noise floor if nothing moved."""
        return {name: float(np.sqrt(np.nanmean(getattr(self, name) ** 2))) for name in ("xx", "yy", "xy")}


def strain(
    reference: ArrayLike, displacement: ArrayLike, columns: int, *, gauge: float, window: float = 0.0, unit: str = "m"
) -> Strain:
    """Green-Lagrange strain of a grid of displaced points.

    Parameters
    ----------
    reference : (N, 2) [px] or (N, 3) [m], grid points of the reference state
    displacement : (N, 2) [px] or (N, 3) [m]
    columns : number of points per row
    gauge : gauge length in the unit of `reference`: planes are fitted to the points within half of it on either side
    window : side of the matching windows in the same unit. If it exceeds the grid's step, neighbours share pixels and
        have correlated errors, which increases the standard deviations
    unit : "m" or "px"

    Raises
    ------
    ObservationError
        Shapes disagree, or the gauge is shorter than two steps of the grid.
    """
    x, d = np.asarray(reference, float), np.asarray(displacement, float)
    if x.ndim != 2 or x.shape != d.shape or x.shape[1] not in (2, 3) or columns < 2 or len(x) % columns:
        problem = f"points {x.shape}, displacements {d.shape}, {columns} a row"
        raise ObservationError(problem, remedy="Give a whole grid, (N, 2) or (N, 3), and as many displacements.")
    if x.shape[1] == 2:
        x, d = (np.concatenate([a, np.zeros((len(a), 1))], axis=1) for a in (x, d))
        d[~np.isfinite(d).all(axis=1)] = np.nan
    step = grid_step(x, columns)
    reach = int(gauge / (2 * step) + 1e-6)
    if not (np.isfinite(step) and reach >= 1):
        problem = f"a gauge of {gauge:g} {unit} on a grid of step {step:g} {unit}"
        raise ObservationError(problem, remedy="Use a gauge of two steps or more, or a finer grid.")
    out = np.empty((len(x), kernels.COLUMNS))
    missing = ~(np.isfinite(x).all(axis=1) & np.isfinite(d).all(axis=1))
    x, d = np.where(missing[:, None], np.nan, x), np.where(missing[:, None], np.nan, d)
    slope, around = _overlap(window / step, 2 * reach + 1)
    kernels.strains(x, d, columns, reach, slope / around, _MIN_FILLED_SHARE, out)
    xx, yy, xy = out[:, 0], out[:, 1], out[:, 2]
    mean, radius = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    std = np.sqrt(out[:, 3:6])
    return Strain(
        xx, yy, xy, std[:, 0], std[:, 1], std[:, 2], mean + radius, mean - radius, 0.5 * np.arctan2(2 * xy, xx - yy),
        out[:, 10], out[:, 6:10].reshape(-1, 2, 2), 2 * reach * step, unit,
    )  # fmt: skip


def grid_step(points: NDArray, columns: int) -> float:
    """Median distance of neighbours on a grid of points (N, 3) [m]; NaN without neighbours."""
    grid = points.reshape(-1, columns, points.shape[1])
    gaps = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)])
    gaps = gaps[np.isfinite(gaps)]
    return float(np.median(gaps)) if len(gaps) else np.nan


def scatter(reference: NDArray, displacement: NDArray, columns: int, *, window: float) -> NDArray:
    """(N, 3) [m] standard deviations of displacements from their scatter about planes over two windows; NaN if too few.

    Errors that are equal in all states, such as those of a window's texture, cancel in a displacement.

    Parameters
    ----------
    reference, displacement : (N, 3) [m], grids of `columns` points a row; NaN where a point is missing
    window : [m] side of the matching windows
    """
    out, step = np.full((len(reference), kernels.COLUMNS), np.nan), grid_step(reference, columns)
    if np.isfinite(step):
        reach = max(2, int(np.ceil(window / step)))
        kernels.strains(reference, displacement, columns, reach, 1.0, _MIN_FILLED_SHARE, out)
        out[:, 12:] /= _overlap(window / step, 2 * reach + 1)[1]
    return np.sqrt(out[:, 12:])


def _overlap(ratio: float, n: int) -> tuple[float, float]:
    """Factors of the slopes' variance and of the mean square residual of planes over n x n points with shared pixels.

    Windows are `ratio` times as long as the grid's step; errors of neighbours correlate by their share of pixels.
    """
    line = np.arange(n)
    correlation = np.maximum(0.0, 1.0 - np.abs(line[:, None] - line) / max(ratio, 1.0))
    centred = line - (n - 1) / 2
    mean, slope = correlation.sum() / n, centred @ correlation @ centred / (centred @ centred)
    residual_freedom = max(n * n - mean**2 - 2.0 * mean * slope, 1.0)  # n² - 3 without correlation
    return float(mean * slope), float(residual_freedom / (n * n - 3))
