"""A shape of known size before one camera: where it stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Camera


def placed(camera: Camera, x: NDArray, uv: NDArray) -> NDArray:
    """Points of a shape in the world, where they are seen: (..., K, 3) [m].

    Only one shift of all points is sought: that with which their distances from their rays, squared, add up to the
    least. NaN where fewer than two points are known.

    Parameters
    ----------
    x : (..., K, 3) [m] along the image's u and v and away from the camera, from any origin; NaN where unknown
    uv : (..., K, 2) [px] where they are seen; NaN where they are not
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
