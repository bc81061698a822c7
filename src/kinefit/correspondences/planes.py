"""Point to plane: a point of the body should lie in a plane (a depth point's tangent plane, the floor)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import _kernels, targets
from kinefit.rows import Rows


def plane_rows(
    body: Body, state: BodyState, points: PointSet, x_world: ArrayLike, normal: ArrayLike, *, sigma: ArrayLike = 0.01
) -> Rows:
    """One row for each point, along the plane's normal: r = n·(target − x) (P1 2.3, point-plane).

    Parameters
    ----------
    points : PointSet of K points on the body.
    x_world : (K, 3) [m]
        A point of each plane; NaN for none.
    normal : (K, 3)
        Unit normals.
    sigma : scalar or (K,) [m]
    """
    x, present = targets.array(x_world, 3, len(points), "points of planes")
    n, directed = targets.array(normal, 3, len(points), "normals")
    targets.unit(n, directed, "normals of planes")
    w = targets.weights(sigma, present & directed, "planes")
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    order = np.argsort(points.segments, kind="stable")
    data, segment, group = _kernels.buffers(len(points))
    _kernels.plane_rows(
        frames, points.segments[order], *(targets.lines(v[order]) for v in (body.points_rest(points), x, n)), w[order],
        0, data, segment, group, 0,
    )  # fmt: skip
    kept = data[7] > 0
    return Rows(np.ascontiguousarray(data[:, kept]), segment[kept], order[group[kept]])  # group: index of the point
