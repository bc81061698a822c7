"""Point to pixel: a camera's keypoint, as the exact linearisation of reprojection (P1-2, 3D point - 2D point)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences import _kernels, targets
from kinefit.geometry.camera import Rig
from kinefit.observations import KEYPOINT_SIGMA
from kinefit.rows import Rows


def pixel_rows(
    body: Body,
    state: BodyState,
    points: PointSet,
    rig: Rig,
    camera: ArrayLike,
    uv: ArrayLike,
    *,
    sigma: ArrayLike = KEYPOINT_SIGMA,
) -> Rows:
    """Two rows for each pixel: g = ∂(u or v)/∂x with distortion, n = g/|g|, r = Δpx/|g|, w = |g|²/σ².

    Parameters
    ----------
    points : PointSet of K points on the body, one for each pixel (repeat a point that several cameras see).
    rig : Rig
    camera : (K,) int, or one for all, index of the camera in the rig.
    uv : (K, 2) [px]
        In the calibration's image frame; NaN for none.
    sigma : scalar or (K,) [px]
    """
    target, present = targets.array(uv, 2, len(points), "pixels")
    index = targets.cameras(rig, camera, len(points))
    w = targets.weights(sigma, present, "pixels")
    return targets.fill(_kernels.pixel_rows, 2, body, state, points, rig.packed, index, np.nan_to_num(target), w)
