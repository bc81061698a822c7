"""Measure a surface in several states of load, each matched with the first state or with the one before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.least_squares_matching import MIN_CORRELATION, WINDOW, Grid, Matches, Seeds
from kinefit.images.photogrammetry.seeding.unaided import grow_between, grow_over_time, grow_through
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.strain import Strain, grid_step, scatter, strain
from kinefit.images.photogrammetry.surface import MeasuredSurface, check_images, from_matches, measure

Progress = Callable[[str, int, int], None]


def measure_states(
    rig: Rig,
    states: Sequence[Sequence[SplineImage]],
    grid: Grid,
    *,
    seeds: Sequence[Seeds] | None = None,
    window: int | ArrayLike = WINDOW,
    least: float = MIN_CORRELATION,
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
        current_grid, others = replace(places, points=own_matches.uv), list[Matches]()
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
