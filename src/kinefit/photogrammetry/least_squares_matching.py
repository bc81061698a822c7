"""Adaptive least-squares matching: where a window of one image is in another, to hundredths of a pixel.

The window is moved and deformed by an affine map, and its grey values are stretched and shifted, so that the sum of
squared differences is least (A. Gruen, Adaptive least squares correlation, 1985). Every match has its standard
deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.errors import ObservationError
from kinefit.photogrammetry.matching import _kernels_matching as kernels
from kinefit.photogrammetry.matching.noise_correlation import variance_factor
from kinefit.photogrammetry.spline_image import SplineImage, template_share

WINDOW = 13
"""[px] side of the window, as in the paper."""

STEPS = 30
TOLERANCE = 0.001
"""[px] by which no part of the window moves any more: a tenth of the best that matching reaches."""

STATUSES = ("found", "no texture", "outside", "not converged", "not tried")
"""Of a match, by its number."""

_LARGEST = 151  # [px] of a window
_HELPFUL = 0.6  # correlation from which a coarser level's match is a better start than none


_ROWS = ("uv", "deformation", "gain", "offset", "correlation", "covariance", "noise", "iterations", "status")


@dataclass(frozen=True, eq=False)
class Matches:
    """Windows of one image, found in another.

    Parameters
    ----------
    points : (N, 2) [px] centres of the windows in the first image
    uv : (N, 2) [px] where they are in the second; NaN where not found
    deformation : (N, 2, 2) of an offset from the centre in the first image to the second
    gain, offset : (N,) grey value of the second image = gain * that of the first + offset
    correlation : (N,) normalised cross-correlation of the windows
    covariance : (N, 2, 2) [px²] of `uv`, from the residuals and the texture
    noise : (N,) standard deviation of the noise of both images together
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
        """From rows (N, 15) of the kernels; covariances grow where the noise of neighbouring pixels goes together."""
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
        """(N,) whether a window was found."""
        return self.status == kernels.FOUND

    @cached_property
    def std(self) -> NDArray:
        """(N, 2) [px] standard deviations of `uv`."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @cached_property
    def starts(self) -> NDArray:
        """(N, 6) place and deformation, for the kernels."""
        return np.concatenate([self.uv, self.deformation.reshape(-1, 4)], axis=1)

    def or_else(self, other: Matches) -> Matches:
        """These, and those of another try at the same points where these were not found."""
        own = self.found

        def either(a: NDArray, b: NDArray) -> NDArray:
            return np.where(own.reshape(-1, *[1] * (a.ndim - 1)), a, b)

        rows = {name: either(value, getattr(other, name)) for name, value in vars(self).items() if name in _ROWS}
        return replace(self, **rows)

    def only(self, good: NDArray[np.bool_]) -> Matches:
        """Those of `good` (N,); the others as not converged."""
        rows = {
            name: np.where(good.reshape(-1, *[1] * (value.ndim - 1)), value, np.nan)
            for name, value in vars(self).items()
            if name in _ROWS and np.issubdtype(value.dtype, np.floating)
        }
        lost = self.found & ~good
        return replace(self, **rows, status=np.where(lost, kernels.DIVERGED, self.status))


def halves_of(window: int | ArrayLike, count: int) -> NDArray[np.int64]:
    """(N,) half sides of windows, `window` = 2 half + 1 [px] of all or of each; refuses even ones."""
    sides = np.asarray(window)
    if sides.shape not in ((), (count,)) or not np.issubdtype(sides.dtype, np.integer):
        raise ObservationError(f"windows of shape {sides.shape}", remedy=f"Give a whole number of pixels, or {count}.")
    if sides.size and (np.any(sides % 2 == 0) or sides.min() < 5 or sides.max() > _LARGEST):
        problem = f"a window of {sides.min()} to {sides.max()} px"
        raise ObservationError(problem, remedy=f"Take an odd number from 5 to {_LARGEST}.")
    return np.ascontiguousarray(np.broadcast_to(sides // 2, (count,)), dtype=np.int64)


def places(points: ArrayLike) -> NDArray:
    """(N, 2) [px] as the kernels take them."""
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
    """Find windows of one image in another.

    Parameters
    ----------
    first, second : of any sizes
    points : (N, 2) [px] centres of the windows in the first image, between pixels or on them
    starts : (N, 2) [px] where they are sought in the second; default: at the same place. Within about a third of the
        size of the texture's grains, or of `2**levels` times that.
    deformation : (2, 2) or (N, 2, 2) to start with; default: none
    window : odd side [px], of all or of each (`windows_by_texture` chooses them)
    levels : of the pyramid, each of half the size, from which to come down

    Raises
    ------
    ObservationError
        Shapes that do not fit, an even window, a pyramid of more levels than the images have.
    """
    at = places(points)
    halves = halves_of(window, len(at))
    goal = at if starts is None else places(starts)
    maps = np.eye(2) if deformation is None else np.asarray(deformation, float)
    if goal.shape != at.shape or maps.shape not in ((2, 2), (len(at), 2, 2)):
        raise ObservationError(
            f"{len(at)} points, starts of shape {goal.shape}, deformations of shape {maps.shape}",
            remedy="Give a start and a deformation (2, 2) for each point.",
        )
    begin = np.concatenate([goal, np.broadcast_to(maps, (len(at), 2, 2)).reshape(-1, 4)], axis=1)
    if levels:
        begin = _from_above(first, second, at, begin, halves, levels)
    out = np.empty((len(at), kernels.ROW))
    kernels.match_points(
        first.coefficients, second.coefficients, at, begin, halves, STEPS, TOLERANCE, template_share(first, second),
        first.noise**2, out,
    )  # fmt: skip
    return Matches.of(at, out, first, second, halves)


def _from_above(
    first: SplineImage, second: SplineImage, at: NDArray, begin: NDArray, halves: NDArray, levels: int
) -> NDArray:
    """Starts (N, 6) from the levels of a pyramid; a window that is not found on one starts from the nearest."""
    if levels < 0 or min(*first.size, *second.size) >> levels < 32:
        problem = f"a pyramid of {levels} levels over images of {first.size} and {second.size} px"
        raise ObservationError(problem, remedy="Take fewer: the highest must have 32 px a side.")
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
        kernels.match_points(*pair, at * scale, start, halves, STEPS, 0.01, share, one.noise**2, out)
        good = (out[:, kernels.STATUS] == kernels.FOUND) & (out[:, kernels.CORRELATION] >= _HELPFUL)
        if good.any():
            near = np.flatnonzero(good)[_nearest(at, at[good])]
            maps = out[near, 2:6].reshape(-1, 2, 2)
            begin[:, 2:] = out[near, 2:6]
            begin[:, :2] = out[near, :2] / scale + np.einsum("nij,nj->ni", maps, at - at[near])
    return begin


def _nearest(at: NDArray, others: NDArray) -> NDArray[np.int64]:
    """(N,) index of the nearest of others (M, 2) to each place (N, 2)."""
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
    """Side (N,) [px] of the smallest window whose texture promises a standard deviation.

    Parameters
    ----------
    points : (N, 2) [px] in the first image
    std : [px], in the worst direction, at the noise of both images; 0.02 costs little resolution on good texture
    windows : to choose from, odd and growing; the largest where none is enough, also where nothing but noise is there
    """
    at = places(points)
    sides = np.full(len(at), windows[-1], np.int64)
    left = np.ones(len(at), bool)
    variance = first.noise**2 + second.noise**2
    for half, side in zip(halves_of(np.array(windows), len(windows)), windows):
        out = np.empty(left.sum())
        kernels.predict(first.coefficients, at[left], int(half), variance, template_share(first, second), out)
        here = np.flatnonzero(left)[out <= std]
        sides[here], left[here] = side, False
    return sides
