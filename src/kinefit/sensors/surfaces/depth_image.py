"""Depth cameras: measured points, visible surface and free space of a depth image as rows."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images.depth import without_speckles
from kinefit.observations import DepthFrame
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces import _kernels_depth_view as kernels
from kinefit.sensors.surfaces.depth_view import Background, DepthSeen, DepthView, view_of
from kinefit.sensors.surfaces.point_cloud import FreePairs, SurfacePairs, along
from kinefit.sensors.visibility.occlusion import drawn_together, of_others
from kinefit.sensors.visibility.visibility import judge_segments
from kinefit.solving.correspondences import depth_image_rows, surface_rows
from kinefit.solving.correspondences.occupancy.free_space import FreeSpace
from kinefit.solving.rows import AnyRows


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


_SHAPE_ERROR = 0.03  # [m] of a surface of simple shapes
_FOREARM_RADIUS = 0.04  # [m]
_MAX_KEPT_PIXELS = 25_000  # of a compact measurement: 100 kB
_MAX_KEPT_POINTS = 5_000  # of a compact measurement: 80 kB


class DepthImageSensor(Sensor):
    """A depth camera. Rows pull measured points and visible surface together, and surface out of free space.

    Parameters
    ----------
    name : as its frames are named
    camera : Camera
    sigma : float [m] standard deviation of a depth.
    settings : TrackSettings
    background : Background of this camera; None if it moves, or shows only the body.
    """

    shows_person = True

    def __init__(
        self, name: str, camera: Camera, sigma: float, settings: TrackSettings, background: Background | None
    ) -> None:
        self.name, self.camera, self.sigma, self.settings, self.background = name, camera, sigma, settings, background
        self._coarse: dict[int, Camera] = {1: camera}

    def prepare(self, frame: DepthFrame, scene: Scene) -> DepthImageMeasurement:
        """The measurement of one image: its part near the body.

        Raises
        ------
        ObservationError
            An image of another size than the camera's.
        BodyError
            A body without surfaces.
        """
        return DepthImageMeasurement(self, frame, scene)

    def learn(self, measurement: DepthImageMeasurement, scene: Scene, sure: bool) -> None:
        """Let the background learn from a whole image, with the body at its fitted state."""
        if self.background is None or measurement.is_compact:
            return
        shown = measurement.drawn_alone(scene)
        self.background.learn(np.abs(measurement.depth), shown, measurement.box, sure)

    def coarse(self, step: int) -> Camera:
        """The camera of an image of every `step`-th row and column, starting in the middle of the first `step`."""
        if step not in self._coarse:
            (width, height), first = self.camera.size, (step - 1) // 2
            S = np.array([[1.0 / step, 0.0, -first / step], [0.0, 1.0 / step, -first / step], [0.0, 0.0, 1.0]])
            size = len(range(first, width, step)), len(range(first, height, step))
            self._coarse[step] = replace(self.camera, size=size, matrix=S @ self.camera.matrix)
        return self._coarse[step]


class DepthImageMeasurement(Measurement):
    """A depth image of one time.

    Parameters
    ----------
    of : DepthImageSensor
    frame : DepthFrame
    scene : Scene with the body at its prediction: measured points near it count.

    Attributes
    ----------
    sigma : float [m] standard deviation of a depth
    box : (3,), (3,) [m] corners of the region near the body
    is_compact : bool, whether only the part near the body is kept.
    """

    settled = False

    def __init__(self, of: DepthImageSensor, frame: DepthFrame, scene: Scene) -> None:
        camera, s, surface = of.camera, of.settings, scene.surface
        if frame.size != camera.size:
            problem = f"depth images of {frame.sensor} have {frame.size} px, its camera {camera.size}"
            raise ObservationError(problem, remedy="Give the camera of these images, or camera.scaled(size).")
        self.sensor, self.time, self.of, self.sigma, self._step = of.name, frame.time, of, of.sigma, 1
        vertices, corners = surface.posed(scene.state), np.empty((2, 3))
        kernels.box(vertices, corners)
        self.box = corners[0] - s.reach, corners[1] + s.reach
        first, last, self._farthest = window_of(camera, *self.box)
        self._window, self._at = (first, last), (0, 0)
        depth = without_speckles(frame.depth, camera, self.sigma)
        self._kept = depth if of.background is None else of.background.marked(depth, first, last)
        self._shown: NDArray | None = surface.depth(vertices, camera).copy()
        if scene.others:
            other_people = of_others(self._kept, self._shown, drawn_together(scene.others, camera), camera)
            self._kept = np.where(other_people, -self._kept, self._kept)
        self._space = self._free(self._shown)
        self._matches, self.is_compact = 0, False
        self._judged: tuple[BodyState, NDArray] | None = None
        self._doubtful: NDArray | None = None
        self._points, self._share = gathered(self._kept, camera, self.box, (first, last), self._shown, s)
        patches = surface.areas.sum() / (s.patch**2 * max(len(surface.samples), 1))
        self._sample_sigma = self.sigma / np.sqrt(min(patches, 1.0) / 2.0)  # halved: a patch is measured by both

    @property
    def camera(self) -> Camera:
        """Camera of `depth`."""
        return self.of.coarse(self._step)

    @property
    def depth(self) -> NDArray:
        """(H, W) float32 [m] of its camera: 0 where unmeasured or discarded, negative for background."""
        width, height = self.camera.size
        if self._kept.shape == (height, width):
            return self._kept
        out, (row, column) = np.zeros((height, width), np.float32), self._at
        out[row : row + self._kept.shape[0], column : column + self._kept.shape[1]] = self._kept
        return out

    def _free(self, shown: NDArray) -> FreeSpace | None:
        """Free space of the image, given the body's rendered depth (h, w) [m]; None if it is disabled."""
        if not np.isfinite(self.of.settings.through):
            return None
        return FreeSpace.of(self.depth, farthest=self._farthest, shown=shown, tolerance=self._contradiction_distance)

    @property
    def _contradiction_distance(self) -> float:
        """[m] behind the surface from which a measurement contradicts it."""
        return AGREEMENT_SIGMAS * self.sigma + _SHAPE_ERROR

    def _drawn(self, scene: Scene) -> tuple[NDArray, FreeSpace | None]:
        """The body's rendered depth (h, w) [m] and free space, updated after every `render_every` matches."""
        due = self._shown is None or (self._matches > 0 and self._matches % self.of.settings.render_every == 0)
        self._matches += 1
        if not due and self._shown is not None:
            return self._shown, self._space
        shown = scene.surface.depth(scene.surface.posed(scene.state), scene.placed(self.camera)).copy()
        space = self._free(shown)
        if not self.is_compact:
            self._shown, self._space = shown, space
        return shown, space

    def match(self, scene: Scene, reach: float) -> DepthImageMatched:
        """Match points to the nearest surface, visible samples to pixels, and samples in free space to targets.

        `reach` is the correspondence distance [m].
        """
        samples, s, sigma = scene.surface.samples, self.of.settings, self.sigma
        bound, depth, camera = max(reach, AGREEMENT_SIGMAS * sigma), self.depth, scene.placed(self.camera)
        shown, space = self._drawn(scene)
        measured = along(np.ascontiguousarray(self._points.T, float), self.camera, scene)
        points = surface_rows(
            scene.body, scene.state, measured, max_distance=bound, sigma=sigma / np.sqrt(self._share / 2.0),
            viewpoint=camera.centre_world, frames=scene.frames,
        )  # fmt: skip
        pixels = depth_image_rows(
            scene.frames, samples, camera, depth, shown, reach=bound, sigma=self._sample_sigma
        )
        # A point that noise moves behind a limb's axis is nearest to its far side and makes no row. So nearest points
        # pull thin limbs towards the sensor, by 2 to 5 cm with a sigma of 3 cm. Pixels do not.
        blur = min(_FOREARM_RADIUS / (4.0 * sigma), 1.0) ** 2 if bound <= max(s.near, AGREEMENT_SIGMAS * sigma) else 1.0
        free = None
        if space is not None:
            sigma = s.through * space.cell
            free = FreePairs.found(
                scene, samples, space, camera, tolerance=self._contradiction_distance, sigma=sigma, seen=pixels.group
            )  # fmt: skip
        return DepthImageMatched(
            self, SurfacePairs.nearest(points, measured, scene, bound / 2.0, blur, camera),
            SurfacePairs.seen(pixels, samples, scene, bound / 2.0, camera), free,
        )  # fmt: skip

    def evidence(self, scene: Scene) -> Evidence:
        """Pixels that support or contradict each segment; see `judge_segments`."""
        camera, vertices = scene.placed(self.camera), scene.surface.posed(scene.state)
        layers = scene.surface.layers(camera)
        verdict = judge_segments(vertices, layers, self.depth, camera, noise=(self.sigma / 2.0, 0.0))
        self._judged = None if self.is_compact else (scene.state, layers.front.copy())
        if self._doubtful is None:
            return verdict.evidence
        orphaned, of = np.zeros(len(verdict.unseen), bool), layers.limbs.jointed
        orphaned[of] = ~verdict.holds[scene.body.tree.parents[of]]
        return replace(verdict.evidence, unplaced=verdict.unseen | orphaned | self._doubtful)

    def doubt(self, segments: NDArray) -> None:
        """Mark segments (S,) bool that an unexplained object in the image may be, without help from earlier images.

        So the parent of a limb's segment must be visible, too.
        """
        self._doubtful = segments

    def drawn_alone(self, scene: Scene) -> NDArray:
        """(h, w) [m] the body's rendered depth at a scene's state, downsampled; reuses the rendering of `evidence`."""
        if self._judged is not None and self._judged[0] is scene.state:
            return self._judged[1]
        return scene.surface.depth(scene.surface.posed(scene.state), scene.placed(self.camera))

    def depth_image(self) -> DepthSeen:
        """The image for occlusion tests of other sensors, background included."""
        return DepthSeen(np.abs(self.depth), self.camera, self.sigma)

    def hints(self, scene: Scene) -> Hints:
        """A view of all points near the body that are not background."""
        return Hints(view=person_view(self.depth, self.camera, self.box))

    def compact(self) -> DepthImageMeasurement:
        """A copy with the part near the body only, every n-th row and column, and its points: at most 200 kB."""
        if self.is_compact:
            return self
        out = copy(self)
        thin = max(-(-self._share.size // _MAX_KEPT_POINTS), 1)
        out._points = np.ascontiguousarray(self._points[:, ::thin], np.float32)
        out._share = np.minimum(thin * self._share[::thin], 1.0).astype(np.float32)
        (top, left), (bottom, right) = self._window
        step = max(int(np.ceil(np.sqrt((bottom - top) * (right - left) / _MAX_KEPT_PIXELS))), 1)
        out._step, first = step, (step - 1) // 2
        out._at = max(-((first - top) // step), 0), max(-((first - left) // step), 0)
        end = -((first - bottom) // step), -((first - right) // step)
        out._kept = self._kept[first::step, first::step][out._at[0] : end[0], out._at[1] : end[1]].copy()
        out._shown = out._space = out._judged = None
        out._matches, out.is_compact = 0, True
        return out


@dataclass(frozen=True, eq=False)
class DepthImageMatched(Matched):
    """A depth image with its correspondences.

    Parameters
    ----------
    measurement : DepthImageMeasurement
    points : SurfacePairs of measured points and the nearest ones of the surface
    samples : SurfacePairs of visible samples of the surface
    free : FreePairs of samples in observed free space; None if it is disabled.
    """

    measurement: DepthImageMeasurement
    points: SurfacePairs
    samples: SurfacePairs
    free: FreePairs | None
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a measured point, one a visible sample, one a sample in free space."""
        return [pairs.rows(scene) for pairs in (self.points, self.samples, self.free) if pairs is not None]

    def evidence(self, scene: Scene) -> Evidence:
        """Pixels that support or contradict each segment; see `judge_segments`."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [m] of measured points from the surface, by segments."""
        both = [pairs.on_segments(scene) for pairs in (self.points, self.samples)]
        residual, segment = (np.concatenate([getattr(r, name) for r in both]) for name in ("residual", "segment"))
        return [by_segments(self.sensor, scene.body, residual, segment, "m")]
