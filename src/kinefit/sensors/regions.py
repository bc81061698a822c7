"""A body's contour in a colour image, by the colours inside and outside of it (P3 2.4): no masks, no background plate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.correspondences import _kernels, _kernels_outlines
from kinefit.correspondences.morphed import morphed_outline_rows
from kinefit.correspondences.rims import Rim
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.images import _kernels_regions as kernels
from kinefit.images.regions import RegionColours, RegionSettings, colour_bins, normalised
from kinefit.losses import Loss, geman_mcclure
from kinefit.observations import ColourFrame
from kinefit.rendering import NEAR
from kinefit.rows import AnyRows, Rows
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.region_search import Seeker, SearchSettings, lens_of, moved, seek
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solvers.equations import inverse

_ANYWHERE = 1e4  # [px]
_FEW = 16  # one vertex in so many tells how far a body has moved
_GUARD = 4.0  # [px] about a contour in which a line always tells: the body as drawn is that coarse
_TELLS = 3.0  # by so much (in logarithms) a place must explain a line better than none
_NEAR = 3.0  # [px] within which the best place of a contour is where it is thought to be
_WORSE = 4.0  # by so much (in logarithms) the place where it is thought may be worse than the best


class RegionSensor(Sensor):
    """The colours inside and outside of a body's contour in one camera.

    Parameters
    ----------
    camera : Camera, whose name frames bear; the sensor's own is "region CAMERA".
    sigma : float [px] standard deviation of the contour, shape of the body included, in the camera's image.
    settings : TrackSettings
    """

    def __init__(self, camera: Camera, sigma: float, settings: TrackSettings) -> None:
        self.name, self.camera, self.sigma = f"region {camera.name}", camera, sigma
        self.settings, self.regions = settings, settings.regions
        self.bins, self.count = colour_bins(self.regions.space, self.regions.levels)
        self.colours: RegionColours | None = None
        self.ratios: tuple[NDArray, NDArray] | None = None
        self.reach = _ANYWHERE  # [px] how far from where it is expected the contour may be
        self._anchors: NDArray | None = None
        self.search, self._seeker = SearchSettings(), None

    def anchors(self, scene: Scene) -> NDArray:
        """(V,) the anchor of every vertex of the body's skin."""
        if self._anchors is None:
            self._anchors = spread_anchors(scene.surface.morphing.mesh.vertices, max(self.regions.anchors, 1))
        return self._anchors

    def seeker(self, scene: Scene) -> Seeker:
        """What draws a coarse mesh of the body."""
        if self._seeker is None:
            mesh = scene.surface.morphing.mesh
            self._seeker = Seeker(mesh.vertices, mesh.faces)
        return self._seeker

    def prepare(self, frame: ColourFrame, scene: Scene) -> RegionMeasurement:
        """The image with what is known of colours; before anything is known they are those at the scene's state.

        Raises
        ------
        ObservationError
            An image of another size than the camera's.
        BodyError
            A body without surfaces.
        """
        if frame.size != self.camera.size:
            problem = f"images of {frame.sensor} are {frame.size} px, its camera has {self.camera.size}"
            raise ObservationError(problem, remedy="Give images in the size of those that were calibrated.")
        m = RegionMeasurement(self, frame, scene)
        if self.colours is None:
            self.colours = m.counted(scene)
            self.ratios = self.colours.ratios(self.regions)
        m.ratios = self.ratios
        return m

    def learn(self, measurement: Measurement, scene: Scene, sure: bool) -> None:
        """Blend in the colours of a step in which the body was found."""
        if not isinstance(measurement, RegionMeasurement) or self.colours is None:
            return
        off = measurement.off(scene)
        self.reach = 2.0 * off if self.reach >= _ANYWHERE else max(2.0 * off, 0.7 * self.reach)
        if not sure:
            self.reach = _ANYWHERE
            return
        self.colours = self.colours.blended(measurement.counted(scene), self.regions)
        self.ratios = self.colours.ratios(self.regions)


class RegionMeasurement(Measurement):
    """A colour image of one time, with the statistics of colours that it is compared with.

    Parameters
    ----------
    of : RegionSensor
    frame : ColourFrame
    scene : Scene with the body where it is expected.
    """

    settled = False

    def __init__(self, of: RegionSensor, frame: ColourFrame, scene: Scene) -> None:
        self.sensor, self.time, self.of, self.image = of.name, frame.time, of, frame.image
        self.ratios: Any = None
        self.reach, self._spacing = of.reach, 1.0
        self.expected = scene.placed(of.camera).project(scene.pose.vertices[::_FEW])
        self._last: tuple[NDArray, Camera, Rim] | None = None

    def rim(self, scene: Scene, stale: float = 1.0) -> Rim:
        """The occluding contour at a scene's state, without its inner points; kept for the state asked for last."""
        vertices, camera = scene.pose.vertices, scene.placed(self.of.camera)
        if self._last is None or self._last[0] is not vertices or self._last[1] is not camera:
            finder = scene.surface.rims(camera)
            rim = finder.find(
                vertices, camera, spacing=self._spacing, inner=False, stale=stale, close=self.of.settings.outline
            )
            if self._spacing == 1.0:  # of the first look alone
                self._spacing = max(len(rim) / self.of.regions.lines, 1.0 + 1e-9)
                rim = rim.chosen(slice(None, None, max(int(self._spacing), 1)))
            self._last = vertices, camera, rim
        return self._last[2]

    def off(self, scene: Scene) -> float:
        """[px] how far the body is from where it was expected, at most."""
        camera = scene.placed(self.of.camera)
        return float(np.nanmax(np.abs(camera.project(scene.pose.vertices[::_FEW]) - self.expected), initial=0.0))

    def drawn(self, scene: Scene) -> tuple[NDArray, int, int, float]:
        """The body as it was drawn last: its faces, and where they are in the image; see `kernels.count`."""
        finder = scene.surface.rims(scene.placed(self.of.camera))
        w = finder.window
        return finder.face, w.left, w.top, w.scale

    def counted(self, scene: Scene) -> RegionColours:
        """The colours of this image with the body where a scene has it."""
        of, s = self.of, self.of.regions
        rim = self.rim(scene)
        counts = np.zeros((3, of.count))
        own = np.zeros((2, s.anchors, of.count), np.float32)
        if len(rim):
            low, high = rim.outline[:2].min(axis=1), rim.outline[:2].max(axis=1)
            margin = 0.25 * (high - low).sum() + 8.0
            box = np.concatenate([low - margin, high + margin]).astype(np.int64)
            drawn = self.drawn(scene)
            kernels.count(self.image, of.bins, *drawn, box, *counts)
            if s.anchors:
                anchor = of.anchors(scene)[rim.vertices[:, 0]]
                kernels.count_lines(self.image, of.bins, rim.outline, anchor, 12, *drawn, *own)
        return RegionColours(*(normalised(c) for c in counts), own)

    def lines(self, scene: Scene, rim: Rim, step: int) -> NDArray:
        """(6, N) where along each line the contour is; see `places`."""
        of, s = self.of, self.of.regions
        out = np.empty((len(rim), 2 * s.half))
        anchor = of.anchors(scene)[rim.vertices[:, 0]] if s.anchors else np.zeros(len(rim), np.int64)
        kernels.profiles(
            self.image, of.bins, self.ratios[1], anchor, rim.outline, *self.drawn(scene), s.half, step, _GUARD, out
        )
        told = np.empty((6, len(rim)))
        kernels.places(out, float(step), s.heat, max(s.width, 0.6 * step), _NEAR, told)
        return told

    def match(self, scene: Scene, reach: float) -> RegionMatched:
        """Where along its normals the contour of the body is."""
        of, s = self.of, self.of.regions
        rim = self.rim(scene)
        step = max(min(round(reach / of.settings.near), math.ceil(self.reach / s.half)), 1)
        told = self.lines(scene, rim, step)
        contour = np.array(rim.outline)
        mean, var = told[0], told[1]
        if s.newton and step == 1:
            mean = np.clip(told[2] * var, -4.0, 4.0)
        contour[:2] += mean * contour[2:]
        share = min(self._spacing / self.drawn(scene)[3] / s.alike, 1.0)
        weight = share / (var + of.sigma**2)
        weight[told[4] < s.tells] = 0.0
        return RegionMatched(self, rim, contour, weight, geman_mcclure(s.loss * np.sqrt(share)))

    def starts(self, scene: Scene, information: NDArray | None, told: Evidence) -> Sequence[BodyState]:
        """Where colours alone show the body, if it is expected too roughly, or not where it was found."""
        of, s = self.of, self.of.search
        if not of.settings.search:
            return ()
        camera, seeker = scene.placed(of.camera), of.seeker(scene)
        R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
        size, spread = seeker.size, np.full(6, np.inf)
        x = seeker.posed(scene.pose.vertices)
        if information is not None:
            arm = se3.hat(scene.state.T_world_root[:3, 3] - x.mean(axis=0))
            J = np.block([[R, R @ arm], [np.zeros((3, 3)), R]])
            spread = np.sqrt(np.diag(J @ inverse(information)[:6, :6] @ J.T))
        rough = spread[:3].max() > 0.3 * size or spread[3:].max() > 0.25
        x = x @ R.T + t
        if not (rough or told.lost.any() or told.quality.min() < 0.8) or x[:, 2].min() < NEAR:
            return ()
        spread = np.clip(spread, [0.05 * size] * 3 + [0.05] * 3, [2.0 * size] * 3 + [1.0] * 3)
        focal, depth = camera.matrix[0, 0], float(x[:, 2].mean())
        step = max(round(size * focal / depth / s.side), 1)
        uv = camera.project(scene.pose.vertices)
        reach = (3.0 * spread[:2].max() * focal / depth) + 0.25 * size * focal / depth
        low = np.clip(np.floor(uv.min(axis=0) - reach), 0, None).astype(int)
        high = np.clip(np.ceil(uv.max(axis=0) + reach), None, camera.size).astype(int)
        shape = np.maximum((high - low) // step, 1)
        cells = np.empty((int(shape[1]), int(shape[0])))
        kernels.ratio_map(self.image, of.bins, self.ratios[0], int(low[0]), int(low[1]), step, cells)
        lens = lens_of(camera.matrix, int(low[0]), int(low[1]), step)
        motions, _ = seek(seeker, x, cells, lens, spread, s)
        return [moved(scene.state, camera.T_camera_world, m) for m in motions]

    def evidence(self, scene: Scene) -> Evidence:
        """Points of each segment's contour at which colours change as they should, and those at which they do not."""
        rim, areas = self.rim(scene), scene.surface.areas
        told = self.lines(scene, rim, 2)
        tells, here = told[4] > _TELLS, told[5] < _WORSE
        agreeing = np.bincount(rim.segment[tells & here], minlength=len(areas))
        contrary = np.bincount(rim.segment[tells & ~here], minlength=len(areas))
        whole = max(len(rim), 1)
        return Evidence(agreeing / whole, contrary / whole)

    def compact(self) -> RegionMeasurement:
        """Without the image but what is near the body."""
        return copy(self)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}


@dataclass(frozen=True, eq=False)
class RegionMatched(Matched):
    """A colour image with the places of the contour along its normals.

    Parameters
    ----------
    measurement : RegionMeasurement
    rim : Rim, N points of the body's occluding contour, of edges of its mesh
    tangents : (4, N) u, v [px] and unit normals of where the contour is
    weight : (N,) [1/px²]
    loss : Loss
    """

    measurement: RegionMeasurement
    rim: Rim
    tangents: NDArray
    weight: NDArray
    loss: Loss
    of_points = False

    @property
    def sensor(self) -> str:  # type: ignore[override]
        """Name of the sensor."""
        return self.measurement.sensor

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a line: the pixel of the body's point should lie where the contour is."""
        n, camera = len(self.rim), scene.placed(self.measurement.of.camera)
        numbers = np.arange(n)
        if scene.surface.morphing.is_rigid:
            data, segment, group = _kernels.buffers(2 * n)
            used = _kernels_outlines.tangent_rows(
                camera.packed, np.ascontiguousarray(scene.pose.vertices), self.rim.vertices, self.rim.share,
                self.rim.segment, self.tangents, numbers, numbers, 1.0, data, segment, group,
            )  # fmt: skip
            data[7, :used] *= self.weight[group[:used]]
            return [Rows(np.ascontiguousarray(data[:, :used]), segment[:used], group[:used], self.loss)]
        blended = morphed_outline_rows(scene.pose, self.rim, camera, self.tangents, (numbers, numbers), sigma=1.0)
        return [replace(blended, loss=self.loss)]

    def evidence(self, scene: Scene) -> Evidence:
        """As of the measurement."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [px], in the camera's own image, of the image's contour from the body's, by segments."""
        uv = scene.placed(self.measurement.of.camera).project(self.rim.on(scene.pose.vertices))
        away = np.sum(self.tangents[2:].T * (self.tangents[:2].T - uv), axis=1)
        seen = np.isfinite(away) & (self.weight > 0.0)
        return [by_segments(self.sensor, scene.body, away[seen], self.rim.segment[seen], "px")]


def spread_anchors(vertices: NDArray, count: int) -> NDArray:
    """(V,) the nearest of some vertices that are spread over all, each as far from the others as can be."""
    away = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1)
    best, near = np.full(len(vertices), np.inf), np.zeros(len(vertices), np.int64)
    for k in range(min(count, len(vertices))):
        d = np.linalg.norm(vertices - vertices[int(np.argmax(away))], axis=1)
        near[d < best] = k
        best = np.minimum(best, d)
        away = best
    return near
