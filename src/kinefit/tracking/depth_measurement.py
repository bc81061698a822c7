"""Depth images and clouds, made ready once, so that every iteration makes their rows quickly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import body_mesh, sample
from kinefit.correspondences import depth_image_rows, surface_rows
from kinefit.correspondences.depth_image import SurfaceSamples
from kinefit.geometry.camera import Camera
from kinefit.observations import DepthFrame, PointCloud
from kinefit.rendering import rasterise
from kinefit.rows import Rows
from kinefit.tracking import _kernels_measured as kernels
from kinefit.tracking.fusion_settings import FusionSettings


class Surface:
    """What the tracker needs of a body's surface, made once.

    Parameters
    ----------
    body : Body
    count : int, samples of its surface.
    """

    def __init__(self, body: Body, count: int) -> None:
        self.body, self.mesh = body, body_mesh(body)
        points, normals, segment = sample(body, count)
        self.samples = SurfaceSamples(segment, points.T, normals.T)

    def box(self, state: BodyState, reach: float) -> tuple[NDArray, NDArray]:
        """Corners (3,), (3,) [m] of the box about the body in the world, enlarged by `reach`."""
        frames, _ = self.body.tree.forward(state.T_world_root, state.angles)
        x = self.mesh.posed(frames)
        return x.min(axis=0) - reach, x.max(axis=0) + reach

    def depth(self, state: BodyState, camera: Camera, size: tuple[int, int]) -> NDArray:
        """(h, w) [m] the body's own depth in a camera."""
        frames, _ = self.body.tree.forward(state.T_world_root, state.angles)
        T = camera.T_camera_world
        x = self.mesh.posed(frames) @ T[:3, :3].T + T[:3, 3]
        K = camera.scaled(size).matrix
        return rasterise(x, self.mesh.faces, K[0, 0], K[1, 1], K[0, 2], K[1, 2], size).depth


class DepthMeasurement:
    """A depth image: measured points towards the surface, visible surface towards what was measured, and free space.

    Parameters
    ----------
    frame : DepthFrame
    camera : Camera
    surface : Surface of the body
    predicted : BodyState, about which measured points are gathered.
    sigma : float [m] standard deviation of a depth.
    """

    def __init__(
        self, frame: DepthFrame, camera: Camera, surface: Surface, predicted: BodyState, sigma: float,
        settings: FusionSettings,
    ) -> None:  # fmt: skip
        self.camera, self.depth, self.surface, self.sigma, self.settings = camera, frame.depth, surface, sigma, settings
        self._small = max(camera.size[0] // 4, 80), max(camera.size[1] // 4, 60)
        self._calls = 0
        self._shown: NDArray = np.empty((0, 0))
        self.points = self._gather(predicted)

    def _gather(self, predicted: BodyState) -> NDArray:
        """(3, N) [m] measured points about the predicted body."""
        low, high = self.surface.box(predicted, self.settings.reach)
        corners = np.stack(np.meshgrid(*zip(low, high)), axis=-1).reshape(-1, 3)
        uv = self.camera.project(corners)
        width, height = self.camera.size
        if np.isfinite(uv).all():
            first = np.clip(np.floor(uv.min(axis=0)), 0, (width, height)).astype(int)
            last = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, (width, height)).astype(int)
        else:  # part of the box is behind the camera
            first, last = np.zeros(2, int), np.array((width, height))
        step = max(int(np.sqrt(max(np.prod(last - first), 1) / (4.0 * self.settings.points))), 1)
        out = np.empty((3, self.settings.points * 4))
        count = kernels.gated_points(
            self.depth, self.camera.ray_table, self.camera.packed, low, high, first[1], last[1], first[0], last[0],
            step, out,
        )  # fmt: skip
        return np.ascontiguousarray(out[:, : min(count, out.shape[1])])

    def rows(self, state: BodyState, bound: float) -> list[Rows]:
        """Rows at a state; see `Measurement`."""
        body, s = self.surface.body, self.settings
        if self._calls % s.render_every == 0:
            self._shown = self.surface.depth(state, self.camera, self._small)
        self._calls += 1
        to_surface = surface_rows(
            body, state, self.points.T, max_distance=bound, sigma=self.sigma, viewpoint=self.camera.centre_world
        )
        to_data = depth_image_rows(
            body, state, self.surface.samples, self.camera, self.depth, self._shown,
            before=bound, behind=bound, sigma=self.sigma,
        )  # fmt: skip
        for rows in (to_surface, to_data):
            kernels.soften(rows.data, max(bound / 2.0, 2.0 * self.sigma))
            rows.group[:] = -1
        return [to_surface, to_data]
