"""Position of a shape of known size in front of one camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Camera


def placed(camera: Camera, x: NDArray, uv: NDArray) -> NDArray:
    """Place a shape in the world by its pixels: points (N, K, 3) [m]; any leading axes.

    Finds the common shift of all points that minimises the sum of squared distances from their rays. NaN where fewer
    than two points are known.

    Parameters
    ----------
    camera : Camera
    x : (N, K, 3) [m] along the image's u and v and away from the camera, from any origin; NaN if unknown
    uv : (N, K, 2) [px] detections; NaN for none
    """
    rays = camera.ray(uv) @ camera.T_camera_world[:3, :3].T
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    known = np.isfinite(x).all(axis=-1) & np.isfinite(rays).all(axis=-1)
    across = np.where(known[..., None, None], across, 0.0)
    pulled = np.einsum("...kij,...kj->...i", across, np.where(known[..., None], x, 0.0))
    total = across.sum(axis=-3)
    enough = (known.sum(axis=-1) > 1) & (np.linalg.eigvalsh(total)[..., 0] > 1e-9)
    shift = -np.linalg.solve(np.where(enough[..., None, None], total, np.eye(3)), pulled[..., None])[..., 0]
    at = x + np.where(enough[..., None], shift, np.nan)[..., None, :]
    return se3.apply(np.linalg.inv(camera.T_camera_world), at)
