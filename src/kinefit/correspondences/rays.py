"""Point to ray: a point of the body should lie on a line in space (P3 eqs. 4-7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import _kernels, targets
from kinefit.rows import Rows


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
