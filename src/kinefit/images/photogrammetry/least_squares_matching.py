"""Adaptive least-squares matching: find a window of one image in another with sub-pixel precision.

The window is moved and deformed by an affine map, and its grey values are stretched and shifted, so that the sum of
squared differences is least (A. Gruen, Adaptive least squares correlation, 1985). Every match has its standard
deviation, corrected for noise that is correlated between pixels (colour filters, JPEG).

Dense matching of a grid by region growing from a few seeds, the best neighbour first (Otto and Chau, 1989).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.errors import ObservationError
from kinefit.images.photogrammetry import _kernels_growing
from kinefit.images.photogrammetry.matching import _kernels_matching as kernels
from kinefit.images.photogrammetry.spline_image import SplineImage, template_share

WINDOW = 13
"""[px] side of the window, as in the paper."""

MAX_STEPS = 30
TOLERANCE = 0.001
"""[px] largest motion of the window's corners at convergence: a tenth of the best precision of matching."""

STATUSES = ("found", "no texture", "outside", "not converged", "not tried")
"""Names of a match's status numbers."""

_MAX_WINDOW_PX = 151  # side of a window
_MIN_LEVEL_CORRELATION = 0.6  # a match of a coarser level is a start only above it


_ROWS = ("uv", "deformation", "gain", "offset", "correlation", "covariance", "noise", "iterations", "status")


@dataclass(frozen=True, eq=False)
class Matches:
    """Windows of one image matched in another.

    Parameters
    ----------
    points : (N, 2) [px] centres of the windows in the first image
    uv : (N, 2) [px] their centres in the second image; NaN where not found
    deformation : (N, 2, 2) maps an offset from the centre in the first image to the second
    gain, offset : (N,) grey value of the second image = gain * that of the first + offset
    correlation : (N,) normalised cross-correlation of the windows
    covariance : (N, 2, 2) [px²] of `uv`, from the residuals and the texture
    noise : (N,) combined standard deviation of both images' noise, in grey values
    iterations : (N,) int
    status : (N,) int, into `STATUSES`
    """

    points: NDArray
    uv: NDArray
    deformation: NDArray
    gain: NDArray
    offset: NDArray
    correlation: NDArray
    covariance: NDArray
    noise: NDArray
    iterations: NDArray
    status: NDArray

    @classmethod
    def of(
        cls, points: NDArray, rows: NDArray, first: SplineImage, second: SplineImage, halves: NDArray[np.int64]
    ) -> Matches:
        """Make matches from rows (N, 15) of the kernels; covariances are scaled up for correlated noise."""
        status = rows[:, kernels.STATUS].astype(np.int64)
        found = status == kernels.FOUND
        out = np.where(found[:, None], rows, np.nan)
        factor = variance_factor(first, second, points[found], rows[found], halves[found])
        covariance = factor * out[:, [kernels.VAR_U, kernels.COV, kernels.COV, kernels.VAR_V]].reshape(-1, 2, 2)
        return cls(
            points, out[:, : kernels.A], out[:, kernels.A : kernels.A + 4].reshape(-1, 2, 2), out[:, kernels.GAIN],
            out[:, kernels.OFFSET], out[:, kernels.CORRELATION], covariance, out[:, kernels.NOISE],
            np.nan_to_num(rows[:, kernels.ITERATIONS]).astype(np.int64), status,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.points)

    @property
    def found(self) -> NDArray[np.bool_]:
        """(N,) whether each window was found."""
        return self.status == kernels.FOUND

    @cached_property
    def std(self) -> NDArray:
        """(N, 2) [px] standard deviations of `uv`."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @cached_property
    def starts(self) -> NDArray:
        """(N, 6) position [px] and deformation, as start values of the kernels."""
        return np.concatenate([self.uv, self.deformation.reshape(-1, 4)], axis=1)

    def or_else(self, other: Matches) -> Matches:
        """These matches, completed by another attempt at the same points where these were not found."""
        is_found = self.found

        def either(a: NDArray, b: NDArray) -> NDArray:
            return np.where(is_found.reshape(-1, *[1] * (a.ndim - 1)), a, b)

        rows = {name: either(value, getattr(other, name)) for name, value in vars(self).items() if name in _ROWS}
        return replace(self, **rows)

    def only(self, good: NDArray[np.bool_]) -> Matches:
        """Mark all matches but those of `good` (N,) as not converged."""
        rows = {
            name: np.where(good.reshape(-1, *[1] * (value.ndim - 1)), value, np.nan)
            for name, value in vars(self).items()
            if name in _ROWS and np.issubdtype(value.dtype, np.floating)
        }
        rejected = self.found & ~good
        return replace(self, **rows, status=np.where(rejected, kernels.DIVERGED, self.status))


def half_sides(window: int | ArrayLike, count: int) -> NDArray[np.int64]:
    """(N,) half sides of windows of `window` = 2 half + 1 [px], one for all or for each.

    Raises
    ------
    ObservationError
        A window is even, outside of 5 to 151 px, or their number is wrong.
    """
    sides = np.asarray(window)
    if sides.shape not in ((), (count,)) or not np.issubdtype(sides.dtype, np.integer):
        raise ObservationError(f"windows of shape {sides.shape}", remedy=f"Give a whole number of pixels, or {count}.")
    if sides.size and (np.any(sides % 2 == 0) or sides.min() < 5 or sides.max() > _MAX_WINDOW_PX):
        problem = f"a window of {sides.min()} to {sides.max()} px"
        raise ObservationError(problem, remedy=f"Give an odd number from 5 to {_MAX_WINDOW_PX}.")
    return np.ascontiguousarray(np.broadcast_to(sides // 2, (count,)), dtype=np.int64)


def as_points(points: ArrayLike) -> NDArray:
    """(N, 2) [px] as a contiguous array for the kernels; raises ObservationError for other shapes."""
    return np.array(shaped(points, ("N", 2), "points"))


def match(
    first: SplineImage,
    second: SplineImage,
    points: ArrayLike,
    starts: ArrayLike | None = None,
    *,
    deformation: ArrayLike | None = None,
    window: int | ArrayLike = WINDOW,
    levels: int = 0,
) -> Matches:
    """Match windows of one image in another by least squares.

    Parameters
    ----------
    first, second : images of any sizes
    points : (N, 2) [px] centres of the windows in the first image, also between pixels
    starts : (N, 2) [px] initial centres in the second image, right to about a third of the texture's grain size, or
        `2**levels` times that; default: `points`
    deformation : (2, 2) or (N, 2, 2) initial map; default: identity
    window : odd side [px], of all or of each; see `windows_by_texture`
    levels : number of coarser pyramid levels, each of half the size, that give the starts

    Raises
    ------
    ObservationError
        Shapes disagree, a window is even, or the images are too small for the pyramid.
    """
    at = as_points(points)
    halves = half_sides(window, len(at))
    goal = at if starts is None else as_points(starts)
    maps = np.eye(2) if deformation is None else np.asarray(deformation, float)
    if goal.shape != at.shape or maps.shape not in ((2, 2), (len(at), 2, 2)):
        raise ObservationError(
            f"{len(at)} points, starts of shape {goal.shape}, deformations of shape {maps.shape}",
            remedy="Give a start and a deformation (2, 2) for each point.",
        )
    begin = np.concatenate([goal, np.broadcast_to(maps, (len(at), 2, 2)).reshape(-1, 4)], axis=1)
    if levels:
        begin = _coarse_starts(first, second, at, begin, halves, levels)
    out = np.empty((len(at), kernels.ROW))
    kernels.match_points(
        first.coefficients, second.coefficients, at, begin, halves, MAX_STEPS, TOLERANCE,
        template_share(first, second), first.noise**2, out,
    )  # fmt: skip
    return Matches.of(at, out, first, second, halves)


def _coarse_starts(
    first: SplineImage, second: SplineImage, at: NDArray, begin: NDArray, halves: NDArray, levels: int
) -> NDArray:
    """Starts (N, 6) from coarser pyramid levels; windows not found there start from the nearest match."""
    if levels < 0 or min(*first.size, *second.size) >> levels < 32:
        problem = f"a pyramid of {levels} levels over images of {first.size} and {second.size} px"
        raise ObservationError(problem, remedy="Use fewer: the highest must have 32 px a side.")
    pairs = [(first.grey, second.grey)]
    for _ in range(levels):
        pairs.append((cv2.pyrDown(pairs[-1][0]), cv2.pyrDown(pairs[-1][1])))
    for level in range(levels, 0, -1):
        scale = 0.5**level  # pyrDown keeps pixel (0, 0) where it is
        one, two = (SplineImage.of(image) for image in pairs[level])
        start, out = begin.copy(), np.empty((len(at), kernels.ROW))
        start[:, :2] *= scale
        share = template_share(one, two)
        pair = one.coefficients, two.coefficients
        kernels.match_points(*pair, at * scale, start, halves, MAX_STEPS, 0.01, share, one.noise**2, out)
        good = (out[:, kernels.STATUS] == kernels.FOUND) & (out[:, kernels.CORRELATION] >= _MIN_LEVEL_CORRELATION)
        if good.any():
            near = np.flatnonzero(good)[nearest(at, at[good])]
            maps = out[near, 2:6].reshape(-1, 2, 2)
            begin[:, 2:] = out[near, 2:6]
            begin[:, :2] = out[near, :2] / scale + np.einsum("nij,nj->ni", maps, at - at[near])
    return begin


def nearest(at: NDArray, others: NDArray) -> NDArray[np.int64]:
    """(N,) index of the nearest of `others` (M, 2) to each point (N, 2)."""
    out = np.empty(len(at), np.int64)
    for k in range(0, len(at), 1000):  # rows of a table of distances
        gaps = at[k : k + 1000, None] - others[None]
        out[k : k + 1000] = np.argmin((gaps**2).sum(axis=2), axis=1)
    return out


def windows_by_texture(
    first: SplineImage,
    second: SplineImage,
    points: ArrayLike,
    *,
    std: float = 0.02,
    windows: tuple[int, ...] = (9, 13, 17, 21, 27, 35, 45),
) -> NDArray[np.int64]:
    """(N,) side [px] of the smallest window whose texture predicts a standard deviation.

    Parameters
    ----------
    points : (N, 2) [px] in the first image
    std : [px] in the worst direction, given the noise of both images; 0.02 costs little resolution on good texture
    windows : odd sides [px] in increasing order; the largest is taken if none suffices
    """
    at = as_points(points)
    sides = np.full(len(at), windows[-1], np.int64)
    undecided = np.ones(len(at), bool)
    variance = first.noise**2 + second.noise**2
    for half, side in zip(half_sides(np.array(windows), len(windows)), windows):
        out = np.empty(undecided.sum())
        kernels.predict(first.coefficients, at[undecided], int(half), variance, template_share(first, second), out)
        sufficient = np.flatnonzero(undecided)[out <= std]
        sides[sufficient], undecided[sufficient] = side, False
    return sides


MIN_CORRELATION = 0.8
"""Least correlation of a match: at 0.8 a third of the grey values' variance is unexplained; wrong matches of 169 random
pixels stay below 0.5."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Grid points of the first image, in rows and columns.

    Parameters
    ----------
    points : (R * C, 2) [px], row by row; NaN outside of the mask
    columns : C
    step : [px] between neighbours
    """

    points: NDArray
    columns: int
    step: float

    @classmethod
    def of(cls, size: tuple[int, int], step: int, *, margin: int = 0, mask: ArrayLike | None = None) -> Grid:
        """Make a grid over an image.

        Parameters
        ----------
        size : (width, height) [px]
        step, margin : [px] between points, and from the image's edges
        mask : (H, W) bool; points outside are NaN

        Raises
        ------
        ObservationError
            The step is below 1, the mask has another size, or no point is left.
        """
        width, height = size
        if step < 1:
            raise ObservationError(f"a grid of step {step} px", remedy="Give 1 or more.")
        u, v = np.meshgrid(
            np.arange(margin, width - margin, step, dtype=float), np.arange(margin, height - margin, step, dtype=float)
        )
        points = np.stack([u, v], axis=-1).reshape(-1, 2)
        if mask is not None:
            inside = np.asarray(mask, bool)
            if inside.shape != (height, width):
                problem = f"a mask of {inside.shape[::-1]} px for an image of {size} px"
                raise ObservationError(problem, remedy="Draw it on the first image.")
            points[~inside[points[:, 1].astype(int), points[:, 0].astype(int)]] = np.nan
        if not np.isfinite(points).any():
            raise ObservationError(f"no point on an image of {size} px", remedy="Use a smaller step or a larger mask.")
        return cls(points, u.shape[1], float(step))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(N,) which points are inside the mask."""
        return np.isfinite(self.points).all(axis=1)

    def triangles(self, good: NDArray[np.bool_]) -> NDArray[np.int64]:
        """(M, 3) indices of triangles between neighbours that are all `good` (N,), oriented like rows and columns."""
        index = np.arange(len(self.points)).reshape(-1, self.columns)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
        corners = np.stack([a, c, b, b, c, d], axis=-1).reshape(-1, 3)
        return corners[good[corners].all(axis=1)]


@dataclass(frozen=True, eq=False)
class Seeds:
    """Corresponding points of two images: annotated manually, from keypoints or from SIFT.

    Parameters
    ----------
    first, second : (S, 2) [px]
    deformation : (S, 2, 2) local map from first to second; `Seeds.of` estimates it
    """

    first: NDArray
    second: NDArray
    deformation: NDArray

    @classmethod
    def of(cls, first: ArrayLike, second: ArrayLike) -> Seeds:
        """Make seeds from corresponding points (S, 2) [px]; those with a NaN are excluded.

        Three or more points give the deformation by one affine map; fewer, the identity.

        Raises
        ------
        ObservationError
            There is no pair of points, or shapes disagree.
        """
        one, two = as_points(first), as_points(second)
        if one.shape != two.shape:
            raise ObservationError(f"{len(one)} and {len(two)} seeds", remedy="Give each point in both images.")
        finite = np.isfinite(one).all(axis=1) & np.isfinite(two).all(axis=1)
        one, two = one[finite], two[finite]
        if not len(one):
            raise ObservationError("no seed", remedy="Give one point, or more, in both images.")
        deformation = np.eye(2)
        gap = one - one.mean(axis=0)
        if len(one) >= 3 and np.linalg.matrix_rank(gap, tol=1e-3 * np.abs(gap).max()) == 2:
            deformation = np.linalg.lstsq(gap, two - two.mean(axis=0), rcond=None)[0].T
        return cls(one, two, np.tile(deformation, (len(one), 1, 1)))

    def on(self, grid: Grid) -> tuple[NDArray[np.int64], NDArray]:
        """Index (S,) of the grid point nearest to each seed, and the start values there (S, 6)."""
        points = np.where(grid.inside[:, None], grid.points, np.inf)
        near = np.array([np.argmin(((points - seed) ** 2).sum(axis=1)) for seed in self.first], np.int64)
        goal = self.second + np.einsum("sij,sj->si", self.deformation, grid.points[near] - self.first)
        return near, np.concatenate([goal, self.deformation.reshape(-1, 4)], axis=1)


def grow(
    first: SplineImage,
    second: SplineImage,
    grid: Grid,
    seeds: Seeds,
    *,
    window: int | ArrayLike = WINDOW,
    least: float = MIN_CORRELATION,
) -> Matches:
    """Match a grid of the first image in the second by region growing from seeds.

    A match may deviate from its neighbour's map by half of the grid's step, so that neighbours cannot swap.

    Parameters
    ----------
    window : odd side [px], of all or of each grid point
    least : least correlation, 0 to 1, of a match

    Returns
    -------
    Matches
        (N,) one for each grid point.
    """
    index, starts = seeds.on(grid)
    halves = half_sides(window, len(grid.points))
    out = np.empty((len(grid.points), kernels.ROW))
    _kernels_growing.grow(
        first.coefficients, second.coefficients, grid.points, grid.columns, index, starts, halves, MAX_STEPS,
        TOLERANCE, template_share(first, second), first.noise**2, least, grid.step / 2, out,
    )  # fmt: skip
    return Matches.of(grid.points, out, first, second, halves)


_MAX_LAG_PX = 3  # covers most of a colour filter's interpolation and JPEG's ringing
_SAMPLE_SIZE = 100  # windows: gives autocorrelations to a hundredth
_MIN_MATCHES = 20


def variance_factor(first: SplineImage, second: SplineImage, at: NDArray, rows: NDArray, halves: NDArray) -> float:
    """Factor on the variances of matches due to correlated noise, at least 1; 1 for fewer than 20 matches.

    A least-squares fit assumes independent noise. With correlated noise the standard deviations are too small by the
    root of the sum over lags of rho_r(lag) rho_g(lag): the autocorrelations of the residuals and of the template's
    gradients.

    Parameters
    ----------
    at : (N, 2) [px] centres of windows in the first image
    rows : (N, 8 or more) rows of the kernels: position in the second image, map, offset, gain
    halves : (N,) half sides [px] of the windows
    """
    if len(at) < _MIN_MATCHES:
        return 1.0
    chosen = np.linspace(0, len(at) - 1, min(len(at), _SAMPLE_SIZE)).astype(int)
    at, rows = at[chosen], rows[chosen]
    half = int(halves[chosen].min())
    side = np.arange(-half, half + 1.0)
    inner = np.stack(np.meshgrid(side, side), axis=-1)
    template = first.values(at[:, None, None] + inner).reshape(len(at), len(side), -1)
    moved = np.einsum("nij,xyj->nxyi", rows[:, 2:6].reshape(-1, 2, 2), inner) + rows[:, None, None, :2]
    sampled = second.values(moved).reshape(template.shape)
    residuals = sampled - rows[:, 6, None, None] - rows[:, 7, None, None] * template
    finite = np.isfinite(residuals).all(axis=(1, 2))
    if not finite.any():
        return 1.0
    residuals, template = residuals[finite], template[finite]
    residual = _autocovariance(residuals - residuals.mean(axis=(1, 2), keepdims=True))
    slope = _autocovariance(np.gradient(template, axis=1)) + _autocovariance(np.gradient(template, axis=2))
    if not (residual[0, _MAX_LAG_PX] > 0 and slope[0, _MAX_LAG_PX] > 0):
        return 1.0
    product = (residual / residual[0, _MAX_LAG_PX]) * (slope / slope[0, _MAX_LAG_PX])
    # each lag but zero counts twice, for its opposite
    total = 2.0 * (product[1:].sum() + product[0, _MAX_LAG_PX + 1 :].sum()) + 1.0
    shares = [_interpolation_share(a, row[:2], row[2:6], len(side), row[7]) for a, row in zip(at[finite], rows[finite])]
    return max(1.0, float(total * np.mean(shares)))


def _autocovariance(field: NDArray) -> NDArray:
    """(L + 1, 2 L + 1) autocovariance of fields (K, n, n) at lags 0..L down and -L..L to the right."""
    out, (_, height, width) = np.empty((_MAX_LAG_PX + 1, 2 * _MAX_LAG_PX + 1)), field.shape
    for down in range(_MAX_LAG_PX + 1):
        for right in range(-_MAX_LAG_PX, _MAX_LAG_PX + 1):
            a = field[:, : height - down, max(0, -right) : width - max(0, right)]
            b = field[:, down:, max(0, right) : width - max(0, -right)]
            out[down, _MAX_LAG_PX + right] = (a * b).mean()
    return out


def _interpolation_share(at: NDArray, uv: NDArray, maps: NDArray, n: int, gain: float) -> float:
    """Share of the noise's variance that remains after interpolation, for which the kernels correct already."""
    second_noise = kernels.window_noise(*uv, *maps, n)
    first_noise = kernels.value_noise(at[0] - np.floor(at[0])) * kernels.value_noise(at[1] - np.floor(at[1]))
    return float((second_noise + gain**2 * first_noise) / (1.0 + gain**2))
