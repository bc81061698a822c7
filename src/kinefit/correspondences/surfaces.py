"""Point to surface: a measured point should lie on the body, anywhere or on one segment (P2 2.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import shaped
from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces.closest.nearest import nearest_lines
from kinefit.correspondences import _kernels, targets
from kinefit.correspondences._kernels_surface import surface_rows as fill
from kinefit.rows import Rows


def surface_rows(
    body: Body,
    state: BodyState,
    x_world: ArrayLike,
    *,
    max_distance: float = 0.1,
    sigma: ArrayLike = 0.01,
    segment: ArrayLike | None = None,
    viewpoint: ArrayLike | None = None,
    exact: bool = False,
    frames: NDArray | None = None,
) -> Rows:
    """One row a point: the surface's nearest point p = x − d n should lie further along its normal n by d.

    The nearest point may slide on the surface, which costs nothing: point to plane along the model's normal.

    Parameters
    ----------
    x_world : (N, 3) [m]
        Measured points; NaN for none. The rows' `group` is the index of the point.
    max_distance : float [m], beyond which a point makes no row.
    sigma : scalar or (N,) [m]
    segment : (N,) int, or one for all, optional
        Segment that each point is known to belong to, -1 for any.
    viewpoint : (3,) [m], optional
        Where the sensor was: points whose nearest surface faces away from it make no row.
    exact : bool
        See `nearest`.
    frames : (S, 12), optional, of a body whose joints move with its angles.

    Raises
    ------
    ObservationError
        As `nearest`; a viewpoint that is no point.
    """
    x = shaped(x_world, ("N", 3), "points on surfaces")
    present = np.isfinite(x).all(axis=1)
    weight = targets.weights(sigma, present, "points on surfaces")
    eye, least = np.zeros(3), -np.inf
    if viewpoint is not None:
        eye, least = shaped(viewpoint, (3,), "a viewpoint", finite=True), 0.0
    frames = targets.of_segments(body, state, frames)
    lines = targets.lines(x)
    distance, normal, owner = nearest_lines(body, frames, lines, max_distance, segment, exact=exact)
    data, owners, group = _kernels.buffers(len(x))
    count = fill(lines, distance, normal, owner, weight, eye, least, data, owners, group)
    return Rows(np.ascontiguousarray(data[:, :count]), owners[:count], group[:count])
