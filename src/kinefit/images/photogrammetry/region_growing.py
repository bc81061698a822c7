"""Dense matching of a grid by region growing from a few seeds, the best neighbour first (Otto and Chau, 1989)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.images.photogrammetry import _kernels_growing
from kinefit.images.photogrammetry.least_squares_matching import (
    MAX_STEPS,
    TOLERANCE,
    WINDOW,
    Matches,
    as_points,
    half_sides,
)
from kinefit.images.photogrammetry.matching import _kernels_matching
from kinefit.images.photogrammetry.spline_image import SplineImage, template_share

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
    out = np.empty((len(grid.points), _kernels_matching.ROW))
    _kernels_growing.grow(
        first.coefficients, second.coefficients, grid.points, grid.columns, index, starts, halves, MAX_STEPS,
        TOLERANCE, template_share(first, second), first.noise**2, least, grid.step / 2, out,
    )  # fmt: skip
    return Matches.of(grid.points, out, first, second, halves)
