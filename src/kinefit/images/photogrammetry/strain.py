"""Green-Lagrange strain of a measured surface or image over a given gauge length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError

_MIN_FILLED_SHARE = 0.5  # of a gauge's points; with fewer, derivatives would be one-sided
_MIN_POINTS = 6
_MIN_DETERMINANT = 1e-6  # of the moments of a gauge's indices, over their product: points on a line


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
    missing = ~(np.isfinite(x).all(axis=1) & np.isfinite(d).all(axis=1))
    x, d = np.where(missing[:, None], np.nan, x), np.where(missing[:, None], np.nan, d)
    slope, around = _overlap(window / step, 2 * reach + 1)
    planes = _Planes.of(x, d, columns, reach)
    (xx, yy, xy), variance, gradient = planes.strains(slope / around)
    mean, radius, std = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy), np.sqrt(variance)
    turn = np.arctan2(gradient[:, 1, 0] - gradient[:, 0, 1], 2.0 + gradient[:, 0, 0] + gradient[:, 1, 1])
    return Strain(
        xx, yy, xy, std[0], std[1], std[2], mean + radius, mean - radius, 0.5 * np.arctan2(2 * xy, xx - yy), turn,
        gradient, 2 * reach * step, unit,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Planes:
    """Planes over the indices i, j of a grid, fitted about every point to positions and displacements.

    Parameters
    ----------
    x, d : (N, 2, 3) slopes of positions and displacements along i and j; NaN where too few points are present
    precision : (N, 2, 2) of slopes per variance of one point
    scatter : (N, 3, 3) covariance of displacements about their planes
    """

    x: NDArray
    d: NDArray
    precision: NDArray
    scatter: NDArray

    @classmethod
    def of(cls, x: NDArray, d: NDArray, columns: int, reach: int) -> _Planes:
        """Planes over 2 reach + 1 rows and columns; points with NaN are excluded."""
        from scipy.ndimage import correlate1d  # a third of a second, for measured surfaces alone

        line = np.arange(-reach, reach + 1.0)

        def sums(values: NDArray, powers: tuple[int, int] = (0, 0)) -> NDArray:
            """(N, k) sums over windows about each point of values (N, k) times powers of i and j."""
            grid = values.reshape(-1, columns, values.shape[1])
            for axis, power in zip((1, 0), powers):
                grid = correlate1d(grid, line**power, axis=axis, mode="constant")
            return grid.reshape(values.shape)

        known = np.isfinite(x[:, 0]) & np.isfinite(d[:, 0])
        x, d = (np.where(known[:, None], v - np.nanmean(v, axis=0), 0.0) for v in (x, d))
        one, both = known[:, None].astype(float), np.einsum("na,nb->nab", d, d)
        count, first = sums(one), np.concatenate([sums(one, (1, 0)), sums(one, (0, 1))], axis=1)
        moments = np.concatenate([sums(one, p) for p in ((2, 0), (1, 1), (1, 1), (0, 2))], axis=1).reshape(-1, 2, 2)
        full = known & (count[:, 0] >= max(_MIN_FILLED_SHARE * len(line) ** 2, _MIN_POINTS))
        count = np.where(full[:, None], count, np.nan)
        moments = np.where(full[:, None, None], moments - first[:, :, None] * first[:, None] / count[..., None], 0.0)
        full &= np.linalg.det(moments) > _MIN_DETERMINANT * moments[:, 0, 0] * moments[:, 1, 1]
        precision = np.linalg.inv(np.where(full[:, None, None], moments, np.eye(2)))
        precision[~full] = np.nan
        means, centred = [], []
        for v in (x, d):
            means.append(sums(v) / count)
            along = np.stack([sums(v, (1, 0)), sums(v, (0, 1))], axis=1)
            centred.append(along - first[:, :, None] * means[-1][:, None])
        slopes = [precision @ c for c in centred]
        scatter = sums(both.reshape(-1, 9)).reshape(-1, 3, 3)
        scatter -= count[..., None] * means[1][:, :, None] * means[1][:, None]
        scatter -= np.swapaxes(centred[1], 1, 2) @ slopes[1]
        return cls(slopes[0], slopes[1], precision, scatter / (count[..., None] - 3.0))

    def strains(self, overlap: float) -> tuple[NDArray, NDArray, NDArray]:
        """E_xx, E_yy, E_xy (3, N), their variances (3, N) and the displacement's gradient (N, 2, 2).

        In the tangent frame whose first axis runs along the row; `overlap` multiplies the slopes' variance.
        """
        Q, R = np.linalg.qr(np.nan_to_num(np.swapaxes(self.x, 1, 2)))  # the tangent frame (N, 3, 2), x = Q R
        sign = np.where(np.diagonal(R, axis1=1, axis2=2) < 0.0, -1.0, 1.0)
        Q, R = Q * sign[:, None], R * sign[..., None]
        size = np.abs(np.diagonal(R, axis1=1, axis2=2))
        flat = (size[:, 0] > 0.0) & (size[:, 1] > _MIN_DETERMINANT * size[:, 0])
        inverse = np.linalg.inv(np.where(flat[:, None, None], R, np.eye(2)))
        inverse[~flat] = np.nan
        moved = np.swapaxes(self.d, 1, 2) @ inverse  # derivatives (N, 3, 2) along the tangent axes
        gradient = np.swapaxes(Q, 1, 2) @ moved
        axes = Q + moved
        E = 0.5 * (np.swapaxes(axes, 1, 2) @ axes - np.eye(2))
        v = overlap * np.swapaxes(inverse, 1, 2) @ self.precision @ inverse
        s = np.swapaxes(axes, 1, 2) @ self.scatter @ axes
        (v11, v12), (_, v22) = np.moveaxis(v, 0, 2)
        (s11, s12), (_, s22) = np.moveaxis(s, 0, 2)
        variance = np.array([s11 * v11, s22 * v22, 0.25 * (s22 * v11 + s11 * v22 + 2.0 * s12 * v12)])
        return np.array([E[:, 0, 0], E[:, 1, 1], E[:, 0, 1]]), np.maximum(variance, 0.0), gradient


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
    step = grid_step(reference, columns)
    if not np.isfinite(step):
        return np.full(reference.shape, np.nan)
    reach = max(2, int(np.ceil(window / step)))
    planes = _Planes.of(reference, displacement, columns, reach)
    variance = np.maximum(np.diagonal(planes.scatter, axis1=1, axis2=2), 0.0)
    return np.sqrt(variance / _overlap(window / step, 2 * reach + 1)[1])


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
