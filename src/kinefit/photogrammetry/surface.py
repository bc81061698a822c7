"""A surface from images of one time: matched, intersected, with standard deviations and a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import CalibrationError, ObservationError
from kinefit.geometry.camera import Rig
from kinefit.photogrammetry.intersection import intersect
from kinefit.photogrammetry.least_squares_matching import WINDOW, Matches, halves_of
from kinefit.photogrammetry.matching.correlation import search_box
from kinefit.photogrammetry.matching.multi_image import match_along_rays
from kinefit.photogrammetry.region_growing import LEAST_CORRELATION, Grid, Seeds, grow
from kinefit.photogrammetry.seeding.unaided import grow_between
from kinefit.photogrammetry.spline_image import SplineImage

_EXACT = 1e-6  # [px²] of the template's own place, which defines the point
_FEWEST = 3  # points of a surface
_REPEATED = 31  # [px] of windows in which a repetition is sought
_ALIKE = 0.95  # of the best correlation; of random texture the runner-up has 0.6 to 0.8 of it
_OUTLYING = 6.0  # robust deviations of the parallax beyond which a match is a wrong one
_ONE_PLACE = 1e-5  # [m] between two cameras: less is a copy
_LEAST_PARALLAX = 0.3  # [px] that is never called wrong: a good calibration leaves as much


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """A measured surface.

    Parameters
    ----------
    grid : of the first camera's image in which the points were chosen
    cameras : names
    x_world : (N, 3) [m], one for each place of the grid; NaN where not measured
    covariance : (N, 3, 3) [m²] by the matches
    uv : (N, C, 2) [px] in each camera; NaN where not matched
    correlation : (N,) the lowest of the matches
    parallax : (N,) [px] by which the rays miss each other in the images
    deformation : (N, C - 1, 2, 2) of an offset in the first image to each other one
    """

    grid: Grid
    cameras: tuple[str, ...]
    x_world: NDArray
    covariance: NDArray
    uv: NDArray
    correlation: NDArray
    parallax: NDArray
    deformation: NDArray

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N,) which points there are."""
        return np.isfinite(self.x_world).all(axis=1)

    @property
    def std(self) -> NDArray:
        """(N, 3) [m] standard deviations along the world's axes."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def triangles(self) -> NDArray[np.int64]:
        """(M, 3) of the mesh, whose front faces the first camera."""
        return self.grid.triangles(self.measured)


def check_images(rig: Rig, images: Sequence[SplineImage]) -> None:
    """Refuse images that are not those of the cameras.

    Raises
    ------
    ObservationError
        Fewer than two, or another number than cameras.
    CalibrationError
        An image of another size than its camera's calibration; a camera that stands where the first one does.
    """
    if len(images) != len(rig) or len(rig) < 2:
        raise ObservationError(f"{len(images)} images for {len(rig)} cameras", remedy="Give one of each, two or more.")
    for camera, image in zip(rig, images):
        if camera.size != image.size:
            has, was = ("x".join(map(str, size)) for size in (image.size, camera.size))
            problem = f"its image has {has} px, its calibration {was}"
            remedy = "Give images as they were calibrated, or calibrate the camera at this size."
            raise CalibrationError(problem, place=f"camera {camera.name}", remedy=remedy)
    centres = np.array([camera.centre_world for camera in rig])
    for camera, centre in zip(rig.cameras[1:], centres[1:]):
        if np.linalg.norm(centre - centres[0]) < _ONE_PLACE:
            problem = f"it stands where camera {rig.names[0]} does: nothing tells a distance"
            remedy = "Put the cameras apart, or check the calibration and its unit."
            raise CalibrationError(problem, place=f"camera {camera.name}", remedy=remedy)


def measure(
    rig: Rig,
    images: Sequence[SplineImage],
    grid: Grid,
    *,
    seeds: Sequence[Seeds] | None = None,
    window: int | ArrayLike = WINDOW,
    least: float = LEAST_CORRELATION,
    constrained: bool | None = None,
) -> MeasuredSurface:
    """Measure a surface that two or more cameras see at one time.

    Parameters
    ----------
    rig, images : C cameras, and the image of each; the first holds the grid
    seeds : from the first image to each other one, C - 1 of them; default: found along the first camera's rays,
        or SIFT features that agree with the cameras (`grow_between`)
    window : odd side [px] of all windows, or of each place of the grid
    least : correlation of a match
    constrained : match all images at once, along the cameras' rays (`match_along_rays`), after each was grown alone.
        Default: with three cameras or more, where it gains; it trusts the calibration to a fraction of a pixel

    Raises
    ------
    ObservationError, CalibrationError
        As `check_images`; no texture, nothing in common; rays that are all but parallel.
    """
    check_images(rig, images)
    first = images[0]
    halves_of(window, len(grid.points))
    if seeds is not None and len(seeds) != len(rig) - 1:
        raise ObservationError(f"seeds of {len(seeds)} cameras", remedy=f"Give those of the other {len(rig) - 1}.")
    found = []
    for k, (camera, image) in enumerate(zip(rig.cameras[1:], images[1:])):
        if seeds is not None:
            found.append(grow(first, image, grid, seeds[k], window=window, least=least))
        else:
            found.append(grow_between(first, image, (rig.cameras[0], camera), grid, window=window, least=least))
        if found[-1].found.sum() < _FEWEST:
            _refuse(first, camera.name)
        if seeds is None:
            refuse_repeated(first, image, found[-1], f"camera {camera.name}")
    surface = from_matches(rig, grid, None, found)
    if constrained if constrained is not None else len(rig) > 2:
        surface = match_rays(rig, images, surface, found, window=window, least=least)
    return surface


def refuse_untextured(first: SplineImage, place: str) -> None:
    """Say so where an image in which nothing was matched has no texture.

    Raises
    ------
    ObservationError
        It has none beyond its noise; `place` is named.
    """
    contrast = float(np.std(first.grey))
    if contrast < 3.0 * first.noise:
        problem = f"no texture coarser than noise: grey values scatter by {contrast:.1f}, noise by {first.noise:.1f}"
        raise ObservationError(problem, place=place, remedy="Put texture on the surface, or light it better.")


def _refuse(first: SplineImage, camera: str) -> None:
    """Say why nothing was matched."""
    refuse_untextured(first, "first camera")
    problem = "nothing of the first image is found in it"
    remedy = "Give seeds by hand, a larger window, or a mask; texture that repeats is found nowhere for sure."
    raise ObservationError(problem, place=f"camera {camera}", remedy=remedy)


def refuse_repeated(first: SplineImage, second: SplineImage, found: Matches, place: str) -> None:
    """Refuse texture that looks the same again nearby, where nobody said which place is meant.

    Windows of 31 px about 20 points are sought about their matches, two windows far. Texture repeats where most are
    found as well elsewhere. Smaller windows would call a random pattern of coarse grains repeated.
    """
    index = np.flatnonzero(found.found)
    index = index[np.linspace(0, len(index) - 1, min(len(index), 20)).astype(int)]
    told = search_box(
        first, second, found.points[index], found.uv[index], reach=2 * _REPEATED, window=_REPEATED
    )
    seen = np.isfinite(told.best)
    if seen.any() and np.mean(told.runner_up[seen] >= _ALIKE * told.best[seen]) > 0.5:
        problem = "texture that repeats: most points are found as well elsewhere, so where they are is not known"
        raise ObservationError(problem, place=place, remedy="Give seeds by hand: they say where; or another texture.")


def from_matches(rig: Rig, grid: Grid, own: Matches | None, others: Sequence[Matches]) -> MeasuredSurface:
    """Intersect matches of a grid; those whose parallax is far from the others' are left out.

    Parameters
    ----------
    own : in the first camera, where the grid is another time's; None: the grid's places themselves
    others : in each other camera
    """
    inside = grid.inside[:, None, None]
    place = np.where(grid.inside[:, None], grid.points, np.nan) if own is None else own.uv
    exact = np.where(inside, _EXACT * np.eye(2), np.nan) if own is None else own.covariance
    uv = np.stack([place, *(m.uv for m in others)], axis=1)
    covariance = np.stack([exact, *(m.covariance for m in others)], axis=1)
    told = intersect(rig, uv, covariance)
    seen = [m.correlation for m in (*others, *([own] if own else []))]
    correlation = np.min([np.where(np.isfinite(c), c, 1.0) for c in seen], axis=0)
    gap = told.parallax
    good = gap <= largest_parallax(gap)
    keep = good[:, None, None]
    return MeasuredSurface(
        grid, rig.names, np.where(keep[..., 0], told.x_world, np.nan), np.where(keep, told.covariance, np.nan),
        np.where(keep, uv, np.nan), np.where(good, correlation, np.nan), np.where(good, gap, np.nan),
        np.stack([m.deformation for m in others], axis=1),
    )  # fmt: skip


def largest_parallax(gaps: NDArray) -> float:
    """[px] by which rays may miss each other, by what most (N,) do: more is a wrong match, not the calibration."""
    told = gaps[np.isfinite(gaps)]
    if not len(told):
        return _LEAST_PARALLAX
    middle = np.median(told)
    return max(_LEAST_PARALLAX, float(middle + _OUTLYING * 1.4826 * np.median(np.abs(told - middle))))


def match_rays(
    rig: Rig,
    images: Sequence[SplineImage],
    surface: MeasuredSurface,
    found: Sequence[Matches],
    *,
    window: int | ArrayLike = WINDOW,
    least: float = LEAST_CORRELATION,
) -> MeasuredSurface:
    """Match all images of a surface at once along the first camera's rays, from where it was measured.

    Parameters
    ----------
    found : matches in the other cameras, whose deformations are the starts
    """
    at = surface.grid.points
    distance = np.linalg.norm(surface.x_world - rig.cameras[0].centre_world, axis=1)
    maps = np.stack([m.deformation for m in found], axis=1)
    told = match_along_rays(rig, images, at, distance, maps, window=window)
    good = told.found & (told.correlation >= least)
    covariance = np.einsum("n,ni,nj->nij", told.variance, told.rays, told.rays)
    across = _across(rig, told.rays, told.distance)
    uv = np.stack([at, *(camera.project(told.x_world) for camera in rig.cameras[1:])], axis=1)
    uv[:, 1:][~told.used] = np.nan
    keep = good[:, None]
    return MeasuredSurface(
        surface.grid, rig.names, np.where(keep, told.x_world, np.nan),
        np.where(keep[..., None], covariance + across, np.nan), np.where(keep[..., None], uv, np.nan),
        np.where(good, told.correlation, np.nan), np.where(good, told.parallax, np.nan), surface.deformation,
    )  # fmt: skip


def _across(rig: Rig, rays: NDArray, distance: NDArray) -> NDArray:
    """(N, 3, 3) [m²] of the template's place across its ray, so that a covariance can be inverted."""
    focal = rig.cameras[0].matrix[0, 0]
    return np.einsum("n,nij->nij", _EXACT * (distance / focal) ** 2, np.eye(3) - np.einsum("ni,nj->nij", rays, rays))
