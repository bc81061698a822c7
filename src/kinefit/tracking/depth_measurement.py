"""Depth images and clouds, made ready once, so that every iteration makes their rows quickly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import body_mesh, sample
from kinefit.correspondences import depth_image_rows, free_space_rows, surface_rows
from kinefit.correspondences.depth_image import SurfaceSamples
from kinefit.correspondences.free_space import FreeSpace
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.observations import DepthFrame, PointCloud
from kinefit.rendering import Canvas, scaled
from kinefit.rows import AnyRows
from kinefit.tracking import _kernels_measured as kernels
from kinefit.tracking._depth_view import DepthView, splat, view_of
from kinefit.tracking.background import Background
from kinefit.tracking.evidence import Evidence
from kinefit.tracking.fusion_search import camera_at
from kinefit.tracking.fusion_settings import FusionSettings
from kinefit.tracking.loss import Layers, judge_segments

_AGREES = 3.0  # standard deviations of a measurement that agrees
_LIMB = 0.04  # [m] radius of a forearm
_SHAPE = 0.03  # [m] by which a surface of simple shapes is off
_COLUMNS = 160  # of the image in which the body's own hidden parts are found: a forearm at 3 m is four pixels wide


class Surface:
    """What the tracker needs of a body's surface, made once; it keeps room for drawing, for one tracker at a time.

    Parameters
    ----------
    body : Body with surfaces
    count : int, samples of its surface.

    Raises
    ------
    BodyError
        A body without surfaces.
    """

    def __init__(self, body: Body, count: int) -> None:
        if not body.surfaces:
            raise BodyError(f"body '{body.name}' has no surfaces", remedy="Depth needs some; see the catalogue's bodies.")
        self.body, self.mesh = body, body_mesh(body)
        points, normals, segment = sample(body, count)
        self.samples = SurfaceSamples(segment, points.T, normals.T)
        corners = self.mesh.vertices[self.mesh.faces]
        twice = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        self.areas = 0.5 * np.bincount(self.mesh.face_segment, twice, len(body.tree.segments))  # (S,) [m²]
        self._canvases: dict[tuple[int, int], Canvas] = {}
        self._layers: dict[Camera, Layers] = {}

    def posed(self, state: BodyState) -> NDArray:
        """(V, 3) [m] its mesh in the world."""
        return self.mesh.posed(self.body.tree.forward(state.T_world_root, state.angles)[0])

    def depth(self, vertices_world: NDArray, camera: Camera) -> NDArray:
        """(h, w) [m] its own depth in a camera, small; overwritten by the next call for this size."""
        small = scaled(camera, min(_COLUMNS / camera.size[0], 1.0))
        canvas = self._canvases.setdefault(small.size, Canvas(small.size))
        return canvas.draw_for(small, vertices_world, self.mesh.faces, cull=True).depth

    def layers(self, camera: Camera) -> Layers:
        """Room to draw it segment by segment."""
        if camera not in self._layers:
            self._layers[camera] = Layers(self.body, camera, mesh=self.mesh)
        return self._layers[camera]


class DepthMeasurement:
    """A depth image: measured points towards the surface, and the visible surface towards what was measured.

    Parameters
    ----------
    frame : DepthFrame
    camera : Camera
    surface : Surface of the body
    vertices : (V, 3) [m]
        Its mesh where the body is thought to be: about it, measured points are gathered.
    sigma : float [m] standard deviation of a depth.

    Raises
    ------
    ObservationError
        An image of another size than the camera's.
    """

    def __init__(
        self, frame: DepthFrame, camera: Camera, surface: Surface, vertices: NDArray, sigma: float,
        settings: FusionSettings, background: Background | None = None,
    ) -> None:  # fmt: skip
        if frame.size != camera.size:
            problem = f"depth images of {frame.sensor} are {frame.size} px, its camera has {camera.size}"
            raise ObservationError(problem, remedy="Give the camera of these images, or camera.scaled(size).")
        self.sensor, self.camera, self.raw = frame.sensor, camera, frame.depth
        self.depth = frame.depth if background is None else background.marked(frame.depth)
        self.background = background
        self.surface, self.sigma, self.settings = surface, sigma, settings
        self._shown = surface.depth(vertices, camera)
        self._calls = 0
        patch = settings.patch**2
        per_sample = surface.areas.sum() / (patch * max(len(surface.samples), 1))
        self._sample_sigma = sigma / np.sqrt(min(per_sample, 1.0) / 2.0)
        self.points, share = self._gather(vertices, patch)
        self._space = self._free()
        self._point_sigma = sigma / np.sqrt(share / 2.0)
        # A point that noise has put behind a limb's middle is nearest to its far side and makes no row, so that nearest
        # points draw thin limbs towards the sensor: by 2 to 5 cm with deviations of 3 cm. Pixels do not.
        self._blur = min(_LIMB / (4.0 * sigma), 1.0) ** 2

    def _gather(self, vertices: NDArray, patch: float) -> tuple[NDArray, NDArray]:
        """(3, N) [m] measured points about the body, and (N,) the share of an independent measurement each is."""
        s, camera = self.settings, self.camera
        self.box = low, high = vertices.min(axis=0) - s.reach, vertices.max(axis=0) + s.reach
        corners = np.stack(np.meshgrid(*zip(low, high)), axis=-1).reshape(-1, 3)
        uv, (width, height) = camera.project(corners), camera.size
        if np.isfinite(uv).all():
            first = np.clip(np.floor(uv.min(axis=0)), 0, (width, height)).astype(int)
            last = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, (width, height)).astype(int)
        else:  # part of the box is behind the camera
            first, last = np.zeros(2, int), np.array((width, height))
        drawn = np.isfinite(self._shown).mean() * width * height  # pixels that the body fills, about
        step = max(int(np.sqrt(max(drawn, 1.0) / s.points)), 1)
        out = np.empty((3, -(-int(last[0] - first[0]) // step) * -(-int(last[1] - first[1]) // step)))
        share, K = np.empty(out.shape[1]), camera.matrix
        count = kernels.gated_points(
            self.depth, camera.ray_table, camera.packed, low, high, first[1], last[1], first[0], last[0], step,
            step * step / (K[0, 0] * K[1, 1] * patch), out, share,
        )  # fmt: skip
        return np.ascontiguousarray(out[:, :count]), share[:count]

    def rows(self, state: BodyState, bound: float) -> list[AnyRows]:
        """Rows at a state, softened at half the bound."""
        body, s, bound = self.surface.body, self.settings, max(bound, _AGREES * self.sigma)
        if self._calls and self._calls % s.render_every == 0:
            self._shown = self.surface.depth(self.surface.posed(state), self.camera)
            self._space = self._free()
        self._calls += 1
        eye = self.camera.centre_world
        to_surface = surface_rows(
            body, state, self.points.T, max_distance=bound, sigma=self._point_sigma, viewpoint=eye
        )
        to_data = depth_image_rows(
            body, state, self.surface.samples, self.camera, self.depth, self._shown,
            before=bound, behind=bound, sigma=self._sample_sigma,
        )  # fmt: skip
        for rows in (to_surface, to_data):
            kernels.soften(rows.data, bound / 2.0)
            rows.group[:] = -1
        if bound <= max(s.near, _AGREES * self.sigma):  # near enough: now pixels decide, see `_blur`
            to_surface.data[7] *= self._blur
        if self._space is None:
            return [to_surface, to_data]
        away = free_space_rows(
            body, state, self.surface.samples, self._space, self.camera, tolerance=_AGREES * self.sigma + _SHAPE,
            sigma=s.through * self._space.cell,
        )  # fmt: skip
        away.group[:] = -1
        return [to_surface, to_data, away]

    def view(self) -> DepthView | None:
        """All that was measured about the body and is not background."""
        rays, T = self.camera.ray_table, self.camera.T_world_camera
        x = np.stack([*rays, np.ones_like(rays[0])], axis=-1) * self.depth[..., None] @ T[:3, :3].T + T[:3, 3]
        person = (self.depth > 0) & (x > self.box[0]).all(axis=-1) & (x < self.box[1]).all(axis=-1)
        return view_of(self.raw, person, self.camera) if person.any() else None

    def _free(self) -> FreeSpace | None:
        """Where the body can be, and where some of it is missing, with the body as it is drawn now."""
        if not np.isfinite(self.settings.through):
            return None
        T, (low, high) = self.camera.T_camera_world, self.box
        corners = np.stack(np.meshgrid(*zip(low, high)), axis=-1).reshape(-1, 3)
        back = float((corners @ T[2, :3]).max() + T[2, 3])
        if back <= 0.0:
            return None
        return FreeSpace.of(self.depth, farthest=back, shown=self._shown, tolerance=_AGREES * self.sigma + _SHAPE)

    def learn(self, state: BodyState, sure: bool) -> None:
        """Let the background learn from the raw image, with the body where it was found."""
        if self.background is not None:
            shown = self.surface.depth(self.surface.posed(state), self.camera)
            self.background.learn(self.raw, shown, self.box, sure)

    def evidence(self, state: BodyState) -> Evidence:
        """Pixels for and against each segment; see `judge_segments`."""
        layers, noise = self.surface.layers(self.camera), (self.sigma / 2.0, 0.0)
        return judge_segments(self.surface.body, state, layers, self.depth, self.camera, noise=noise).evidence


class CloudMeasurement:
    """Points on some surface, on the body, or on one segment (P2 2.3), towards the body's surface.

    Parameters
    ----------
    frame : PointCloud
    vertices, sigma, settings : see `DepthMeasurement`
    """

    def __init__(
        self, frame: PointCloud, surface: Surface, vertices: NDArray, sigma: float, settings: FusionSettings
    ) -> None:
        self.sensor, self.surface, self.sigma, self._eye = frame.sensor, surface, sigma, frame.viewpoint
        tree, x = surface.body.tree, frame.points
        self._segment = None if frame.segment is None else np.int64(tree.segment(frame.segment))
        self._certain = frame.on_body or frame.segment is not None
        if not self._certain:
            low, high = vertices.min(axis=0) - settings.reach, vertices.max(axis=0) + settings.reach
            x = x[((x > low) & (x < high)).all(axis=1)]
        every = max(len(x) // settings.points, 1)
        self.points = np.ascontiguousarray(x[::every].T)
        cells = np.unique(np.floor(self.points / settings.patch).astype(np.int64), axis=1).shape[1]
        self._point_sigma = sigma * np.sqrt(max(self.points.shape[1] / max(cells, 1), 1.0))

    def rows(self, state: BodyState, bound: float) -> list[AnyRows]:
        """One row a point; those known to be the body's are sought twice as far."""
        bound = max(2.0 * bound if self._certain else bound, _AGREES * self.sigma)
        rows = surface_rows(
            self.surface.body, state, self.points.T, max_distance=bound, sigma=self._point_sigma, viewpoint=self._eye,
            segment=self._segment,
        )  # fmt: skip
        kernels.soften(rows.data, bound / 2.0)
        rows.group[:] = -1
        return [rows]

    def evidence(self, state: BodyState) -> Evidence:
        """A segment as much for which there are as many points near it as its half that can be seen should have."""
        body, count = self.surface.body, self.points.shape[1]
        reach = _AGREES * self.sigma
        rows = surface_rows(body, state, self.points.T, max_distance=reach, viewpoint=self._eye, segment=self._segment)
        near = np.bincount(rows.segment, minlength=len(body.tree.segments))
        expected = np.maximum(count * self.surface.areas / max(self.surface.areas.sum(), 1e-12), 1.0)
        none = np.zeros(len(near))
        if self._segment is None:
            return Evidence(np.minimum(near / expected, 1.0), none)
        told = Evidence(none, none.copy())
        share = len(rows) / max(count, 1)
        told.agreeing[self._segment], told.contrary[self._segment] = share, (1.0 - share) * bool(count)
        return told

    def view(self) -> DepthView | None:
        """The points as a camera at the sensor would show them."""
        if not self.points.size:
            return None
        coarse, small = splat(self.points.T, camera_at(self.points.T, self._eye))
        return view_of(coarse, coarse > 0, small) if (coarse > 0).any() else None
