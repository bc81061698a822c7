"""Point to point: a marker, a triangulated joint, a manually annotated 3D point."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import _kernels, targets
from kinefit.rows import Rows


def point_rows(body: Body, state: BodyState, points: PointSet, x_world: ArrayLike, *, sigma: ArrayLike = 0.01) -> Rows:
    """Three rows for each point: n = the world's axes, r = target − x (P2 3.2, "3D point to point").

    Parameters
    ----------
    points : PointSet of K points on the body.
    x_world : (K, 3) [m]
        Measured positions; NaN for none.
    sigma : scalar or (K,) [m]
        Standard deviation along each axis.
    """
    x, present = targets.array(x_world, 3, len(points), "measured points")
    return targets.fill(_kernels.point_rows, 3, body, state, points, x, targets.weights(sigma, present, "points"))


def ray_rows(body: Body, state: BodyState, points: PointSet, lines: ArrayLike, *, sigma: ArrayLike = 0.01) -> Rows:
    """Two rows for each point: its offset from the line along two directions normal to it (x × n − m, P3 eq. 4).

    Parameters
    ----------
    points : PointSet of K points on the body.
    lines : (K, 6)
        Plücker lines (n, m) in the world, see `geometry.lines`; NaN for none.
    sigma : scalar or (K,) [m]
        Standard deviation of the distance. For pixels use `pixel_rows`, whose weights account for the depth.
    """
    line, present = targets.array(lines, 6, len(points), "lines")
    targets.unit(line[:, :3], present, "directions of lines")
    w = targets.weights(sigma, present, "rays")
    return targets.fill(_kernels.ray_rows, 2, body, state, points, np.nan_to_num(line), w)
