"""Point to image line and line to image line (P1 2.3: 3D point - 2D line, 3D line - 2D line)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import _kernels, targets
from kinefit.geometry.camera import Rig
from kinefit.rows import Rows


def image_line_rows(
    body: Body,
    state: BodyState,
    points: PointSet,
    rig: Rig,
    camera: ArrayLike,
    lines: ArrayLike,
    *,
    sigma: ArrayLike = 2.0,
) -> Rows:
    """One row for each point, whose pixel should lie on an image line; linearised with distortion, as `pixel_rows`.

    Parameters
    ----------
    points : PointSet of K points on the body.
    camera : (K,) int, or one for all, index in the rig.
    lines : (K, 3)
        a u + b v + c = 0 in the calibration's image frame, of any scale; NaN for none. Distortion bends a straight edge
        of the world: then give the tangent near the point.
    sigma : scalar or (K,) [px]
    """
    line, present = targets.array(lines, 3, len(points), "image lines")
    present &= np.hypot(np.nan_to_num(line[:, 0]), np.nan_to_num(line[:, 1])) > 0
    index = targets.cameras(rig, camera, len(points))
    w = targets.weights(sigma, present, "image lines")
    return targets.fill(_kernels.image_line_rows, 1, body, state, points, rig.packed, index, np.nan_to_num(line), w)


def edge_rows(
    body: Body,
    state: BodyState,
    starts: PointSet,
    ends: PointSet,
    rig: Rig,
    camera: ArrayLike,
    lines: ArrayLike,
    *,
    sigma: ArrayLike = 2.0,
) -> Rows:
    """Two rows for each edge of the body: both ends should project onto an image line (3D line - 2D line).

    A line lies in a plane when two of its points do, so P1's line-plane constraint is two point-plane ones.

    Parameters
    ----------
    starts, ends : PointSet of K points each.
    camera : (K,) int, or one for all, index in the rig.
    lines : (K, 3)
        a u + b v + c = 0, as for `image_line_rows`.
    sigma : scalar or (K,) [px]
    """
    a = image_line_rows(body, state, starts, rig, camera, lines, sigma=sigma)
    b = image_line_rows(body, state, ends, rig, camera, lines, sigma=sigma)
    both = Rows.concat(a, b)
    group = np.concatenate([a.group, b.group])  # the two ends of one edge share its robust weight
    order = np.argsort(group, kind="stable")
    return Rows(np.ascontiguousarray(both.data[:, order]), both.segment[order], group[order])
