"""A depth image of one time, made ready once, so that every iteration makes its rows quickly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.correspondences import depth_image_rows, free_space_rows, surface_rows
from kinefit.correspondences.free_space import FreeSpace
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.observations import DepthFrame
from kinefit.rows import Rows
from kinefit.sensors import _kernels_depth_image as kernels
from kinefit.sensors.background import Background
from kinefit.sensors.depth_view import DepthView, view_of
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surface import Surface
from kinefit.sensors.visibility import judge_segments

AGREES = 3.0  # standard deviations of a measurement that agrees
_SHAPE = 0.03  # [m] by which a surface of simple shapes is off
_LIMB = 0.04  # [m] radius of a forearm


class DepthMeasurement:
    """A depth image: measured points towards the surface, the visible surface towards what was measured, free space.

    Parameters
    ----------
    frame : DepthFrame
    camera : Camera
    surface : Surface of the body
    vertices : (V, 3) [m]
        Its mesh where the body is thought to be: about it, measured points are gathered.
    sigma : float [m] standard deviation of a depth.
    background : Background of this camera, None where it moves.

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """

    def __init__(
        self, frame: DepthFrame, camera: Camera, surface: Surface, vertices: NDArray, sigma: float,
        settings: TrackSettings, background: Background | None = None,
    ) -> None:  # fmt: skip
        if frame.size != camera.size:
            problem = f"depth images of {frame.sensor} are {frame.size} px, its camera has {camera.size}"
            raise ObservationError(problem, remedy="Give the camera of these images, or camera.scaled(size).")
        self.sensor, self.camera, self.surface, self.sigma, self._settings = (
            frame.sensor, camera, surface, sigma, settings,
        )  # fmt: skip
        self._raw, self._background = frame.depth, background
        box = np.empty((2, 3))
        kernels.box(vertices, box)
        self._low, self._high = box[0] - settings.reach, box[1] + settings.reach
        first, last, self._back = self._window()
        self._depth = frame.depth if background is None else background.marked(frame.depth, first, last)
        self._shown = surface.depth(vertices, camera)
        self._space = self._free()
        self._calls = 0
        patch = settings.patch**2
        self._points, share = self._gather(first, last, patch)
        self._point_sigma = sigma / np.sqrt(share / 2.0)  # halved: a patch is told of by its points and by its samples
        per_sample = min(surface.areas.sum() / (patch * max(len(surface.samples), 1)), 1.0)
        self._sample_sigma = sigma / np.sqrt(per_sample / 2.0)
        # A point that noise has put behind a limb's middle is nearest to its far side and makes no row, so that nearest
        # points draw thin limbs towards the sensor: by 2 to 5 cm with deviations of 3 cm. Pixels do not.
        self._blur = min(_LIMB / (4.0 * sigma), 1.0) ** 2

    def _window(self) -> tuple[tuple[int, int], tuple[int, int], float]:
        """First and last row and column of the image that the body may be in, and its largest depth [m] there."""
        corners = np.stack(np.meshgrid(*zip(self._low, self._high)), axis=-1).reshape(-1, 3)
        z = corners @ self.camera.T_camera_world[2, :3] + self.camera.T_camera_world[2, 3]
        uv, (width, height) = self.camera.project(corners), self.camera.size
        if not (z > 0.0).all() or not np.isfinite(uv).all():  # part of the box is behind the camera
            return (0, 0), (height, width), max(float(z.max()), 1e-3)
        low = np.clip(np.floor(uv.min(axis=0)), 0, (width, height)).astype(int)
        high = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, (width, height)).astype(int)
        return (int(low[1]), int(low[0])), (int(high[1]), int(high[0])), float(z.max())

    def _gather(self, first: tuple[int, int], last: tuple[int, int], patch: float) -> tuple[NDArray, NDArray]:
        """(3, N) [m] measured points about the body, and (N,) the share of an independent measurement each is."""
        camera, K = self.camera, self.camera.matrix
        drawn = np.isfinite(self._shown).mean() * camera.size[0] * camera.size[1]  # pixels that the body fills, about
        step = max(int(np.sqrt(max(drawn, 1.0) / self._settings.points)), 1)
        rows, columns = (-(-(b - a) // step) for a, b in zip(first, last))
        out, share = np.empty((3, rows * columns)), np.empty(rows * columns)
        count = kernels.gated_points(
            self._depth, camera.ray_table, camera.packed, self._low, self._high, first[0], last[0], first[1], last[1],
            step, step * step / (K[0, 0] * K[1, 1] * patch), out, share,
        )  # fmt: skip
        return np.ascontiguousarray(out[:, :count]), share[:count]

    def _free(self) -> FreeSpace | None:
        """Where the body can be, and where some of it is missing, with the body as it is drawn now."""
        if not np.isfinite(self._settings.through):
            return None
        reach = AGREES * self.sigma + _SHAPE
        return FreeSpace.of(self._depth, farthest=self._back, shown=self._shown, tolerance=reach)

    def rows(self, state: BodyState, bound: float) -> list[Rows]:
        """Rows at a state, softened at half the bound."""
        body, samples, s = self.surface.body, self.surface.samples, self._settings
        bound = max(bound, AGREES * self.sigma)
        if self._calls and self._calls % s.render_every == 0:
            self._shown = self.surface.depth(self.surface.posed(state), self.camera)
            self._space = self._free()
        self._calls += 1
        points = surface_rows(
            body, state, self._points.T, max_distance=bound, sigma=self._point_sigma,
            viewpoint=self.camera.centre_world,
        )  # fmt: skip
        pixels = depth_image_rows(
            body, state, samples, self.camera, self._depth, self._shown, before=bound, behind=bound,
            sigma=self._sample_sigma,
        )  # fmt: skip
        for rows in (points, pixels):
            kernels.soften(rows.data, bound / 2.0)
        if bound <= max(s.near, AGREES * self.sigma):
            points.data[7] *= self._blur
        out = [points, pixels]
        if self._space is not None:
            reach, sigma = AGREES * self.sigma + _SHAPE, s.through * self._space.cell
            out.append(free_space_rows(body, state, samples, self._space, self.camera, tolerance=reach, sigma=sigma))
        for rows in out:
            rows.group[:] = -1  # softened already
        return out

    def evidence(self, state: BodyState) -> Evidence:
        """Pixels for and against each segment; see `judge_segments`."""
        layers, vertices = self.surface.layers(self.camera), self.surface.posed(state)
        self.surface.judged = state
        return judge_segments(vertices, layers, self._depth, self.camera, noise=(self.sigma / 2.0, 0.0)).evidence

    def view(self) -> DepthView | None:
        """All that was measured about the body and is not background."""
        rays, T = self.camera.ray_table, self.camera.T_world_camera
        x = np.stack([*rays, np.ones_like(rays[0])], axis=-1) * self._depth[..., None] @ T[:3, :3].T + T[:3, 3]
        person = (self._depth > 0) & (x > self._low).all(axis=-1) & (x < self._high).all(axis=-1)
        return view_of(self._raw, person, self.camera) if person.any() else None

    def learn(self, state: BodyState, sure: bool) -> None:
        """Let the background learn from the image, with the body where it was found."""
        if self._background is not None:
            if self.surface.judged is state:  # drawn already
                shown = self.surface.layers(self.camera).front
            else:
                shown = self.surface.depth(self.surface.posed(state), self.camera)
            self._background.learn(self._raw, shown, (self._low, self._high), sure)
