"""Point to point: a marker, a triangulated joint, a manually annotated 3D point."""

from __future__ import annotations

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
