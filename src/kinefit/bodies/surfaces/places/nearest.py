"""Surfaces of a body packed for kernels, and their nearest points to measured points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies.body import Body
from kinefit.bodies.surfaces.closest._kernels_cylinder import nearest_on_cylinders, nearest_on_cylinders_exact
from kinefit.bodies.surfaces.closest._kernels_grid import nearest_on_grids
from kinefit.bodies.surfaces.closest._kernels_metaballs import nearest_on_metaballs
from kinefit.bodies.tree import BodyState
from kinefit.errors import ObservationError


class Nearest(NamedTuple):
    """Nearest points of a body's surface.

    Parameters
    ----------
    distance : (N,) [m] positive outside, negative inside; `max_distance` if no surface is as near.
    point : (N, 3) [m] in the world, on the surface; x itself if no surface is as near.
    normal : (N, 3) unit, outward at that point, in the world; zero if no surface is as near.
    segment : (N,) int, -1 if no surface is as near.
    """

    distance: NDArray
    point: NDArray
    normal: NDArray
    segment: NDArray


def nearest(
    body: Body,
    state: BodyState,
    x_world: ArrayLike,
    *,
    max_distance: float,
    only: ArrayLike | None = None,
    exact: bool = False,
) -> Nearest:
    """Find the nearest points of all surfaces of a body (P2 2.3).

    Parameters
    ----------
    body : Body
    state : BodyState
    x_world : (N, 3) [m]
    max_distance : float [m], radius of the search.
    only : (N,) int, or one for all, optional
        Segment that each point may belong to, -1 for any.
    exact : bool
        Whether closest points of cylinders are found to 1e-4 mm instead of a fraction of a millimetre, in three times
        the time.

    Raises
    ------
    ObservationError
        Points of the wrong shape or not finite, a radius that is not positive, a segment out of range.
    """
    x = shaped(x_world, ("N", 3), "points")
    lines = np.ascontiguousarray(x.T)
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    distance, normal, segment = nearest_lines(body, frames, lines, max_distance, only, exact=exact)
    point = lines - np.where(segment >= 0, distance, 0.0) * normal
    return Nearest(distance, point.T, normal.T, segment)


def nearest_lines(
    body: Body, frames: NDArray, x: NDArray, max_distance: float, only: ArrayLike | None = None, *, exact: bool = False
) -> tuple[NDArray, NDArray, NDArray]:
    """Distance (N,) [m], normal (3, N) and segment (N,) for points x (3, N) [m] and frames (S, 12); see `nearest`.

    Raises
    ------
    ObservationError
        As `nearest`.
    """
    count = x.shape[1]
    if not abs(float(x.sum())) < np.inf:
        raise ObservationError("points are not finite", remedy="Remove points without a measurement.")
    if not 0.0 < max_distance < np.inf:
        raise ObservationError(f"the largest distance is {max_distance} m", remedy="Give a positive distance.")
    wanted = np.full(count, -1) if only is None else np.asarray(only)
    if wanted.shape not in ((), (count,)) or wanted.dtype.kind not in "iu":
        raise ObservationError(f"segments have shape {wanted.shape}", remedy=f"Give ({count},) integers, or one.")
    if wanted.size and not -1 <= wanted.min() <= wanted.max() < len(body.tree.segments):
        problem = f"a segment lies outside 0 to {len(body.tree.segments) - 1}"
        raise ObservationError(problem, remedy="Give -1 for any.")
    wanted = np.array(np.broadcast_to(wanted, count), np.int64)
    distance, normal, segment = np.full(count, float(max_distance)), np.zeros((3, count)), np.full(count, -1)
    tables = body.surface_tables
    if len(tables.cylinders):
        search = nearest_on_cylinders_exact if exact else nearest_on_cylinders
        search(x, frames, tables.cylinders, wanted, distance, normal, segment)
    if tables.grids is not None:
        nearest_on_grids(x, frames, *tables.grids, wanted, distance, normal, segment)
    if tables.balls is not None:
        nearest_on_metaballs(np.ascontiguousarray(x), frames, *tables.balls, wanted, distance, normal, segment)
    return distance, normal, segment
