"""A surface in several states, before and after a load: matched against the first, or one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.photogrammetry.least_squares_matching import WINDOW, Matches
from kinefit.photogrammetry.region_growing import LEAST_CORRELATION, Grid, Seeds
from kinefit.photogrammetry.seeding.unaided import grow_between, grow_over_time, grow_through
from kinefit.photogrammetry.spline_image import SplineImage
from kinefit.photogrammetry.strain import Strain, grid_step, scatter, strain
from kinefit.photogrammetry.surface import MeasuredSurface, check_images, from_matches, measure

Progress = Callable[[str, int, int], None]


def measure_states(
    rig: Rig,
    states: Sequence[Sequence[SplineImage]],
    grid: Grid,
    *,
    seeds: Sequence[Seeds] | None = None,
    window: int | ArrayLike = WINDOW,
    least: float = LEAST_CORRELATION,
    incremental: bool = False,
    progress: Progress | None = None,
) -> list[MeasuredSurface]:
    """Measure the same points of a surface in each of several states.

    Parameters
    ----------
    states : of each the images of all cameras, in the rig's order; asked for one by one, in this order
    grid, seeds, window, least : as in `measure`, of the first state
    incremental : False: every image is matched with the first one of the first camera, so that errors do not add up.
        True: with the state before, for motions so large that the first image is not recognised any more
    progress : called with what is done, and how many states of how many

    Returns
    -------
    list of Surface
        Points of one row are the same material points; NaN where one is lost.
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
        own = grow_over_time(template, images[0], places, window=window, least=least)
        here, others = replace(places, points=own.uv), list[Matches]()
        for image, camera in zip(images[1:], rig.cameras[1:]):
            pair = rig.cameras[0], camera
            if incremental:
                others.append(grow_between(images[0], image, pair, here, window=window, least=least))
            else:
                told = grow_through(template, images[0], image, pair, places, own, window=window, least=least)
                others.append(told)
        out.append(from_matches(rig, grid, own, others))
        if incremental:
            template, places = images[0], here
    if progress is not None:
        progress("states", len(states), len(states))
    return out


def surface_strain(reference: MeasuredSurface, state: MeasuredSurface, gauge: float, window: int = 0) -> Strain:
    """Strain from one state of a surface to another.

    Parameters
    ----------
    gauge : [m] length over which it is taken
    window : [px] side of the matching windows
    """
    moved = state.x_world - reference.x_world
    return strain(reference.x_world, moved, reference.grid.columns, gauge=gauge, window=_side(reference, window))


def displacement_std(reference: MeasuredSurface, state: MeasuredSurface, window: int) -> NDArray:
    """(N, 3) [m] standard deviations of how far each point moved, by how displacements of neighbours differ.

    By the matches of both states where too few neighbours are measured.
    """
    spread = scatter(
        reference.x_world, state.x_world - reference.x_world, reference.grid.columns, window=_side(reference, window)
    )  # fmt: skip
    return np.where(np.isfinite(spread), spread, np.hypot(reference.std, state.std))


def _side(surface: MeasuredSurface, window: int) -> float:
    """[m] of a matching window of so many pixels, about."""
    step = grid_step(surface.x_world, surface.grid.columns)
    return window * step / surface.grid.step if np.isfinite(step) else 0.0


def rigid_motion(reference: NDArray, state: NDArray) -> tuple[NDArray, NDArray]:
    """Rigid motion of points (N, 3) [m] by least squares, and what it leaves over.

    Returns
    -------
    T_state_reference : (4, 4)
    residual : (N, 3) [m]; NaN where a point is missing
    """
    seen = np.isfinite(reference).all(axis=1) & np.isfinite(state).all(axis=1)
    if seen.sum() < 3:
        raise ObservationError(f"{seen.sum()} points in both states", remedy="Three are needed.")
    T = se3.aligned(reference[seen], state[seen])
    return T, state - se3.apply(T, reference)
