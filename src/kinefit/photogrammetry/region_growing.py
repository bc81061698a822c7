"""Dense matching of a grid, grown from a few seeds: the best neighbour first (Otto and Chau, 1989)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.photogrammetry import _kernels_growing
from kinefit.photogrammetry.least_squares_matching import STEPS, TOLERANCE, WINDOW, Matches, halves_of, places
from kinefit.photogrammetry.matching import _kernels_matching
from kinefit.photogrammetry.spline_image import SplineImage, template_share

LEAST_CORRELATION = 0.8
"""Of a match: at 0.8 a third of the variance of the grey values is unexplained; wrong matches of 169 random pixels stay
below 0.5."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Places of the first image, in rows and columns.

    Parameters
    ----------
    points : (R * C, 2) [px], row by row; NaN where the grid has none
    columns : C
    step : [px] from one to the next
    """

    points: NDArray
    columns: int
    step: float

    @classmethod
    def of(cls, size: tuple[int, int], step: int, *, margin: int = 0, mask: ArrayLike | None = None) -> Grid:
        """Grid over an image of a size (width, height) [px], `margin` from its edges, where a mask (H, W) is true.

        Raises
        ------
        ObservationError
            A step below 1, a mask of another size, or no place left.
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
            raise ObservationError(f"no point on an image of {size} px", remedy="Take a smaller step or a larger mask.")
        return cls(points, u.shape[1], float(step))

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(N,) where the grid has a place."""
        return np.isfinite(self.points).all(axis=1)

    def triangles(self, good: NDArray[np.bool_]) -> NDArray[np.int64]:
        """(M, 3) triangles between neighbours that are all `good` (N,), the same way round as rows and columns."""
        index = np.arange(len(self.points)).reshape(-1, self.columns)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
        corners = np.stack([a, c, b, b, c, d], axis=-1).reshape(-1, 3)
        return corners[good[corners].all(axis=1)]


@dataclass(frozen=True, eq=False)
class Seeds:
    """Points known in both images: by hand, from keypoints or from SIFT.

    Parameters
    ----------
    first, second : (S, 2) [px]
    deformation : (S, 2, 2) of the surroundings, first to second; `Seeds.of` estimates it
    """

    first: NDArray
    second: NDArray
    deformation: NDArray

    @classmethod
    def of(cls, first: ArrayLike, second: ArrayLike) -> Seeds:
        """From points alone, those with a NaN left out. Of three or more, one affine map gives the deformation.

        Raises
        ------
        ObservationError
            No pair of points, or other shapes.
        """
        one, two = places(first), places(second)
        if one.shape != two.shape:
            raise ObservationError(f"{len(one)} and {len(two)} seeds", remedy="Give each point in both images.")
        seen = np.isfinite(one).all(axis=1) & np.isfinite(two).all(axis=1)
        one, two = one[seen], two[seen]
        if not len(one):
            raise ObservationError("no seed", remedy="Give one point, or more, in both images.")
        deformation = np.eye(2)
        gap = one - one.mean(axis=0)
        if len(one) >= 3 and np.linalg.matrix_rank(gap, tol=1e-3 * np.abs(gap).max()) == 2:
            deformation = np.linalg.lstsq(gap, two - two.mean(axis=0), rcond=None)[0].T
        return cls(one, two, np.tile(deformation, (len(one), 1, 1)))

    def on(self, grid: Grid) -> tuple[NDArray[np.int64], NDArray]:
        """Nearest place of a grid (S,) to each seed, and the start there (S, 6)."""
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
    least: float = LEAST_CORRELATION,
) -> Matches:
    """Match a grid of the first image in the second, from seeds outwards.

    A match may be off its neighbour's map by half of the grid's step, so that no two neighbours can change places.

    Parameters
    ----------
    window : odd side [px], of all or of each place of the grid
    least : correlation of a match

    Returns
    -------
    Matches
        One for each place of the grid.
    """
    index, starts = seeds.on(grid)
    halves = halves_of(window, len(grid.points))
    out = np.empty((len(grid.points), _kernels_matching.ROW))
    _kernels_growing.grow(
        first.coefficients, second.coefficients, grid.points, grid.columns, index, starts, halves, STEPS, TOLERANCE,
        template_share(first, second), first.noise**2, least, grid.step / 2, out,
    )  # fmt: skip
    return Matches.of(grid.points, out, first, second, halves)
