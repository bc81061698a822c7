"""Measure a surface from images of one time: matching, intersection, standard deviations and a mesh.

Measure a surface in several states of load, each matched with the first state or with the one before.

Plane displacement and strain of a flat surface from one camera that faces it, without calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import CalibrationError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry import least_squares_matching as matching
from kinefit.images.photogrammetry.intersection import intersect
from kinefit.images.photogrammetry.matching.multi_image import match_along_rays, search_box
from kinefit.images.photogrammetry.seeding.unaided import grow_between, grow_over_time, grow_through
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.strain import Strain, grid_step, scatter, strain

_EXACT_VARIANCE = 1e-6  # [px²] of the template's position, which is exact by definition
_MIN_POINTS = 3  # of a surface
_REPEAT_WINDOW_PX = 31  # of the search for repetitions
_MIN_REPEAT_RATIO = 0.95  # of correlations, for repeated texture; random texture has 0.6 to 0.8
_OUTLIER_SIGMAS = 6.0  # robust standard deviations of the parallax of a wrong match
_MIN_BASELINE = 1e-5  # [m] between two cameras
_MIN_OUTLIER_PARALLAX_PX = 0.3  # a good calibration leaves as much


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """A surface measured on a grid of the first camera's image.

    Parameters
    ----------
    grid : grid points in the first camera's image
    cameras : names of the C cameras
    x_world : (N, 3) [m], one for each grid point; NaN where not measured
    covariance : (N, 3, 3) [m²] due to the matches
    uv : (N, C, 2) [px] in each camera; NaN where not matched
    correlation : (N,) lowest correlation of the matches
    parallax : (N,) [px] reprojection error
    deformation : (N, C - 1, 2, 2) maps an offset in the first image to each other image
    """

    grid: matching.Grid
    cameras: tuple[str, ...]
    x_world: NDArray
    covariance: NDArray
    uv: NDArray
    correlation: NDArray
    parallax: NDArray
    deformation: NDArray

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N,) which points are measured."""
        return np.isfinite(self.x_world).all(axis=1)

    @property
    def std(self) -> NDArray:
        """(N, 3) [m] standard deviations along the world's axes."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def triangles(self) -> NDArray[np.int64]:
        """(M, 3) point indices of the mesh, whose front faces the first camera."""
        return self.grid.triangles(self.measured)


def check_images(rig: Rig, images: Sequence[SplineImage], fewest: int = 2) -> None:
    """Check that images belong to the cameras of a rig, `fewest` or more.

    Raises
    ------
    ObservationError
        There are too few images, or not one for each camera.
    CalibrationError
        An image differs in size from its camera's calibration, or a camera stands where the first one does.
    """
    if len(images) != len(rig) or len(rig) < fewest:
        remedy = f"Give one of each, {fewest} or more."
        raise ObservationError(f"{len(images)} images for {len(rig)} cameras", remedy=remedy)
    for camera, image in zip(rig, images):
        if camera.size != image.size:
            has, was = ("x".join(map(str, size)) for size in (image.size, camera.size))
            problem = f"its image has {has} px, its calibration {was}"
            remedy = "Give images of the calibrated size, or calibrate at this size."
            raise CalibrationError(problem, place=f"camera {camera.name}", remedy=remedy)
    centres = np.array([camera.centre_world for camera in rig])
    for camera, centre in zip(rig.cameras[1:], centres[1:]):
        if np.linalg.norm(centre - centres[0]) < _MIN_BASELINE:
            problem = f"it is at the position of camera {rig.names[0]}: distances cannot be measured"
            remedy = "Move the cameras apart, or check the calibration and its unit."
            raise CalibrationError(problem, place=f"camera {camera.name}", remedy=remedy)


def measure(
    rig: Rig,
    images: Sequence[SplineImage],
    grid: matching.Grid,
    *,
    seeds: Sequence[matching.Seeds] | None = None,
    window: int | ArrayLike = matching.WINDOW,
    least: float = matching.MIN_CORRELATION,
    constrained: bool | None = None,
) -> MeasuredSurface:
    """Measure a surface from the images of two or more cameras at one time.

    Parameters
    ----------
    rig, images : C cameras and one image of each
    grid : of the first image
    seeds : C - 1, from the first image to each other one; default: found along the first camera's rays, or from SIFT
        features that agree with the cameras (`grow_between`)
    window : odd side [px] of all windows, or of each grid point
    least : least correlation, 0 to 1, of a match
    constrained : finally match all images jointly along the first camera's rays (`match_along_rays`), which needs a
        calibration right to a fraction of a pixel. Default: with three cameras or more

    Raises
    ------
    ObservationError, CalibrationError
        As `check_images`, or there is no texture or no match, or the rays are nearly parallel.
    """
    check_images(rig, images)
    first = images[0]
    matching.half_sides(window, len(grid.points))
    if seeds is not None and len(seeds) != len(rig) - 1:
        raise ObservationError(f"seeds of {len(seeds)} cameras", remedy=f"Give those of the other {len(rig) - 1}.")
    found = []
    for k, (camera, image) in enumerate(zip(rig.cameras[1:], images[1:])):
        if seeds is not None:
            found.append(matching.grow(first, image, grid, seeds[k], window=window, least=least))
        else:
            found.append(grow_between(first, image, (rig.cameras[0], camera), grid, window=window, least=least))
        if found[-1].found.sum() < _MIN_POINTS:
            _raise_unmatched(first, camera.name)
        if seeds is None:
            reject_repeated_texture(first, image, found[-1], f"camera {camera.name}")
    surface = from_matches(rig, grid, None, found)
    if constrained if constrained is not None else len(rig) > 2:
        surface = match_rays(rig, images, surface, found, window=window, least=least)
    return surface


def reject_untextured(first: SplineImage, place: str) -> None:
    """Raise an error if an image without any match has no texture.

    Raises
    ------
    ObservationError
        The image has no texture beyond its noise; names `place`.
    """
    contrast = float(np.std(first.grey))
    if contrast < 3.0 * first.noise:
        problem = f"no texture coarser than noise: grey values scatter by {contrast:.1f}, noise by {first.noise:.1f}"
        raise ObservationError(problem, place=place, remedy="Put texture on the surface, or improve the light.")


def _raise_unmatched(first: SplineImage, camera: str) -> None:
    """Raise ObservationError with the reason why nothing was matched."""
    reject_untextured(first, "first camera")
    problem = "no point of the first image is found in it"
    remedy = "Give seeds by hand, a larger window, or a mask; repeated texture has no unique match."
    raise ObservationError(problem, place=f"camera {camera}", remedy=remedy)


def reject_repeated_texture(first: SplineImage, second: SplineImage, found: matching.Matches, place: str) -> None:
    """Raise an error if the texture repeats nearby, so that matches are ambiguous.

    Windows of 31 px around 20 points are searched within two windows of their matches. The texture repeats if most of
    them have a second match. With smaller windows a random pattern of coarse grains would seem to repeat.

    Raises
    ------
    ObservationError
        The texture repeats; names `place`.
    """
    index = np.flatnonzero(found.found)
    index = index[np.linspace(0, len(index) - 1, min(len(index), 20)).astype(int)]
    peaks = search_box(
        first, second, found.points[index], found.uv[index], reach=2 * _REPEAT_WINDOW_PX, window=_REPEAT_WINDOW_PX
    )
    finite = np.isfinite(peaks.best)
    if finite.any() and np.mean(peaks.runner_up[finite] >= _MIN_REPEAT_RATIO * peaks.best[finite]) > 0.5:
        problem = "texture that repeats: most points also match elsewhere, so their positions are not known"
        raise ObservationError(problem, place=place, remedy="Give seeds by hand, or use another texture.")


def from_matches(
    rig: Rig, grid: matching.Grid, own: matching.Matches | None, others: Sequence[matching.Matches]
) -> MeasuredSurface:
    """Intersect the matches of a grid and reject those with an outlying parallax.

    Parameters
    ----------
    own : matches in the first camera if the grid is from another time; None: the grid points themselves
    others : matches in each other camera
    """
    inside = grid.inside[:, None, None]
    place = np.where(grid.inside[:, None], grid.points, np.nan) if own is None else own.uv
    exact = np.where(inside, _EXACT_VARIANCE * np.eye(2), np.nan) if own is None else own.covariance
    uv = np.stack([place, *(m.uv for m in others)], axis=1)
    covariance = np.stack([exact, *(m.covariance for m in others)], axis=1)
    points = intersect(rig, uv, covariance)
    correlations = [m.correlation for m in (*others, *([own] if own else []))]
    correlation = np.min([np.where(np.isfinite(c), c, 1.0) for c in correlations], axis=0)
    gap = points.parallax
    good = gap <= max_parallax(gap)
    keep = good[:, None, None]
    return MeasuredSurface(
        grid, rig.names, np.where(keep[..., 0], points.x_world, np.nan), np.where(keep, points.covariance, np.nan),
        np.where(keep, uv, np.nan), np.where(good, correlation, np.nan), np.where(good, gap, np.nan),
        np.stack([m.deformation for m in others], axis=1),
    )  # fmt: skip


def max_parallax(gaps: NDArray) -> float:
    """Largest parallax [px] of a correct match: a robust bound on the parallaxes `gaps` (N,) [px]."""
    finite = gaps[np.isfinite(gaps)]
    if not len(finite):
        return _MIN_OUTLIER_PARALLAX_PX
    middle = np.median(finite)
    return max(_MIN_OUTLIER_PARALLAX_PX, float(middle + _OUTLIER_SIGMAS * 1.4826 * np.median(np.abs(finite - middle))))


def match_rays(
    rig: Rig,
    images: Sequence[SplineImage],
    surface: MeasuredSurface,
    found: Sequence[matching.Matches],
    *,
    window: int | ArrayLike = matching.WINDOW,
    least: float = matching.MIN_CORRELATION,
) -> MeasuredSurface:
    """Match all images of a surface jointly along the first camera's rays, starting at the measured points.

    Parameters
    ----------
    found : matches in the other cameras, whose deformations (N, 2, 2) are the initial ones
    window : odd side [px], of all or of each
    least : least correlation, 0 to 1, of a match
    """
    at = surface.grid.points
    distance = np.linalg.norm(surface.x_world - rig.cameras[0].centre_world, axis=1)
    maps = np.stack([m.deformation for m in found], axis=1)
    matches = match_along_rays(rig, images, at, distance, maps, window=window)
    good = matches.found & (matches.correlation >= least)
    covariance = np.einsum("n,ni,nj->nij", matches.variance, matches.rays, matches.rays)
    across = _lateral_covariance(rig, matches.rays, matches.distance)
    uv = np.stack([at, *(camera.project(matches.x_world) for camera in rig.cameras[1:])], axis=1)
    uv[:, 1:][~matches.used] = np.nan
    keep = good[:, None]
    return MeasuredSurface(
        surface.grid, rig.names, np.where(keep, matches.x_world, np.nan),
        np.where(keep[..., None], covariance + across, np.nan), np.where(keep[..., None], uv, np.nan),
        np.where(good, matches.correlation, np.nan), np.where(good, matches.parallax, np.nan), surface.deformation,
    )  # fmt: skip


def _lateral_covariance(rig: Rig, rays: NDArray, distance: NDArray) -> NDArray:
    """(N, 3, 3) [m²] covariance across the ray due to the template's position, which keeps the total invertible."""
    focal = rig.cameras[0].matrix[0, 0]
    lateral = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    return np.einsum("n,nij->nij", _EXACT_VARIANCE * (distance / focal) ** 2, lateral)


Progress = Callable[[str, int, int], None]


def measure_states(
    rig: Rig,
    states: Sequence[Sequence[SplineImage]],
    grid: matching.Grid,
    *,
    seeds: Sequence[matching.Seeds] | None = None,
    window: int | ArrayLike = matching.WINDOW,
    least: float = matching.MIN_CORRELATION,
    incremental: bool = False,
    progress: Progress | None = None,
) -> list[MeasuredSurface]:
    """Measure the same points of a surface in each of several states.

    Parameters
    ----------
    states : for each state the images of all cameras, in the rig's order; accessed once each, in order
    grid, seeds, window [px], least : as in `measure`, for the first state
    incremental : False: match every image with the first one of the first camera, so that errors do not accumulate.
        True: match with the state before, for motions that change the image too much
    progress : (what, done, total) -> None

    Returns
    -------
    list of MeasuredSurface
        Rows (N,) are the same material points in all states; NaN where one is lost.

    Raises
    ------
    ObservationError, CalibrationError
        There is no state; or as `measure`.
    """
    if not len(states):
        raise ObservationError("no state", remedy="Give the images of one time, or more.")
    first = states[0]
    check_images(rig, first)
    out = [measure(rig, first, grid, seeds=seeds, window=window, least=least)]
    template, places = first[0], grid
    for k in range(1, len(states)):
        if progress is not None:
            progress("states", k, len(states))
        images = states[k]
        check_images(rig, images)
        own_matches = grow_over_time(template, images[0], places, window=window, least=least)
        current_grid, others = replace(places, points=own_matches.uv), list[matching.Matches]()
        for image, camera in zip(images[1:], rig.cameras[1:]):
            pair = rig.cameras[0], camera
            if incremental:
                others.append(grow_between(images[0], image, pair, current_grid, window=window, least=least))
            else:
                other = grow_through(template, images[0], image, pair, places, own_matches, window=window, least=least)
                others.append(other)
        out.append(from_matches(rig, grid, own_matches, others))
        if incremental:
            template, places = images[0], current_grid
    if progress is not None:
        progress("states", len(states), len(states))
    return out


def surface_strain(reference: MeasuredSurface, state: MeasuredSurface, gauge: float, window: int = 0) -> Strain:
    """Green-Lagrange strain between two states of a surface.

    Parameters
    ----------
    gauge : [m] gauge length
    window : [px] side of the matching windows
    """
    displacement = state.x_world - reference.x_world
    return strain(reference.x_world, displacement, reference.grid.columns, gauge=gauge, window=_side(reference, window))


def displacement_std(reference: MeasuredSurface, state: MeasuredSurface, window: int) -> NDArray:
    """(N, 3) [m] standard deviations of displacements, estimated from their scatter among neighbours.

    With too few neighbours, they follow from the matches of both states. `window`: [px] side of the matching windows.
    """
    spread = scatter(
        reference.x_world, state.x_world - reference.x_world, reference.grid.columns, window=_side(reference, window)
    )  # fmt: skip
    return np.where(np.isfinite(spread), spread, np.hypot(reference.std, state.std))


def _side(surface: MeasuredSurface, window: int) -> float:
    """[m] approximate side of a matching window of `window` [px]."""
    step = grid_step(surface.x_world, surface.grid.columns)
    return window * step / surface.grid.step if np.isfinite(step) else 0.0


def rigid_motion(reference: NDArray, state: NDArray) -> tuple[NDArray, NDArray]:
    """Least-squares rigid motion from points `reference` (N, 3) [m] to `state` (N, 3) [m], and the residuals.

    Returns
    -------
    T_state_reference : (4, 4)
    residual : (N, 3) [m]; NaN where a point is missing

    Raises
    ------
    ObservationError
        Fewer than three points are in both states.
    """
    common = np.isfinite(reference).all(axis=1) & np.isfinite(state).all(axis=1)
    if common.sum() < 3:
        raise ObservationError(f"{common.sum()} points in both states", remedy="Three are needed.")
    T = se3.aligned(reference[common], state[common])
    return T, state - se3.apply(T, reference)


def measure_flat(
    states: Sequence[SplineImage],
    grid: matching.Grid,
    pixel: float,
    *,
    window: int | ArrayLike = matching.WINDOW,
    least: float = matching.MIN_CORRELATION,
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


def _surface(grid: matching.Grid, found: matching.Matches | None, pixel: float) -> MeasuredSurface:
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
