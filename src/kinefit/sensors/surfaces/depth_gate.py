"""Select the pixels of a depth image that may show the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces import _kernels_depth_image as kernels
from kinefit.sensors.surfaces.depth_view import DepthView, view_of


def window_of(camera: Camera, low: NDArray, high: NDArray) -> tuple[tuple[int, int], tuple[int, int], float]:
    """First and last (row, column) of the image that a box low..high (3,) [m] fills, and its largest depth [m]."""
    corners = np.stack(np.meshgrid(*zip(low, high)), axis=-1).reshape(-1, 3)
    z = corners @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    uv, (width, height) = camera.project(corners), camera.size
    if not (z > 0.0).all() or not np.isfinite(uv).all():  # part of the box is behind the camera
        return (0, 0), (height, width), max(float(z.max()), 1e-3)
    first = np.clip(np.floor(uv.min(axis=0)), 0, (width, height)).astype(int)
    last = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, (width, height)).astype(int)
    return (int(first[1]), int(first[0])), (int(last[1]), int(last[0])), float(z.max())


def gathered(
    depth: NDArray, camera: Camera, box: tuple[NDArray, NDArray], window: tuple[tuple[int, int], tuple[int, int]],
    shown: NDArray, settings: TrackSettings,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """(3, N) [m] measured points in a box, and (N,) in 0..1 the independent measurements that each counts for.

    Parameters
    ----------
    depth : (H, W) [m], 0 or less where nothing of the body was measured.
    box : (3,), (3,) [m] corners; window : first and last row and column that it fills, see `window_of`.
    shown : (h, w) [m] the body's rendered depth, inf outside: the image is thinned in proportion to its area.
    """
    (first, last), K = window, camera.matrix
    drawn = np.isfinite(shown).mean() * camera.size[0] * camera.size[1]  # pixels that the body fills, about
    step = max(int(np.sqrt(max(drawn, 1.0) / settings.points)), 1)
    rows, columns = (-(-(b - a) // step) for a, b in zip(first, last))
    out, share = np.empty((3, rows * columns)), np.empty(rows * columns)
    count = kernels.gated_points(
        depth, camera.ray_table, camera.packed, *box, first[0], last[0], first[1], last[1],
        step, step * step / (K[0, 0] * K[1, 1] * settings.patch**2), out, share,
    )  # fmt: skip
    return np.ascontiguousarray(out[:, :count]), share[:count]


def person_view(depth: NDArray, camera: Camera, box: tuple[NDArray, NDArray]) -> DepthView | None:
    """The view in which a body is searched for: all points in a box (3,), (3,) [m] that are not background.

    None if there are none. depth (H, W) [m] is negative where it shows the background.
    """
    rays, T = camera.ray_table, camera.T_world_camera
    x = np.stack([*rays, np.ones_like(rays[0])], axis=-1) * depth[..., None] @ T[:3, :3].T + T[:3, 3]
    person = (depth > 0) & (x > box[0]).all(axis=-1) & (x < box[1]).all(axis=-1)
    return view_of(np.abs(depth), person, camera) if person.any() else None
