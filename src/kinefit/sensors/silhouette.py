"""A silhouette of one time, made ready once, so that every iteration makes its rows quickly."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.correspondences.morphed import morphed_outline_rows
from kinefit.correspondences.outlines import outline_pairs, outline_rows
from kinefit.correspondences.rims import Rim
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images.silhouette import choose_person, outline
from kinefit.losses import Loss, geman_mcclure
from kinefit.observations import SilhouetteFrame
from kinefit.rendering import scaled
from kinefit.rows import AnyRows, DofRows, Rows
from kinefit.sensors.base import Matched, Measurement, Sensor
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import FusionSettings
from kinefit.sensors.surface import Surface
from kinefit.sensors.surface_match import SegmentResiduals, by_segment

_AGREES = 3.0  # standard deviations of a rim that agrees
_STALE = 0.5  # [px] by which a body may have moved in the virtual image: half of how far beside its rim it is looked at
_LIMB = 0.04  # [m] radius of a forearm: an outline farther off is another part's, however poor the masks are
_SPACING = 2.0  # [px] between points of an outline, in the image in which they are compared
_LEAST = 3.0  # [px] of that image within which points are always paired: the neighbours on a slanted outline


def outline_camera(camera: Camera, settings: FusionSettings) -> Camera:
    """The camera with an image in which outlines are compared, a whole number of times smaller than its own."""
    return scaled(camera, 1.0 / max(round(max(camera.size) / settings.outline), 1))


class SilhouetteMeasurement:
    """The silhouette in one camera: the body's rim and the image's outline towards each other.

    Parameters
    ----------
    frame : SilhouetteFrame
    camera : Camera
    surface : Surface of the body
    vertices : (V, 3) [m]
        Its mesh where the body is thought to be: of several blobs it tells which are the body's.
    sigma : float [px] standard deviation of the outline, shape of the body included, in the camera's image.

    Raises
    ------
    ObservationError
        A mask of another size than the camera's.
    """

    def __init__(
        self, frame: SilhouetteFrame, camera: Camera, surface: Surface, vertices: NDArray, sigma: float,
        settings: FusionSettings,
    ) -> None:  # fmt: skip
        if frame.size != camera.size:
            problem = f"masks of {frame.sensor} are {frame.size} px, its camera has {camera.size}"
            raise ObservationError(problem, remedy="Give the masks in the size of the images that were calibrated.")
        self.camera = outline_camera(camera, settings)
        self.sensor, self.surface, self._settings = frame.sensor, surface, settings
        scale = self.camera.size[0] / camera.size[0]
        #: [px] standard deviation in the image in which outlines are compared
        self.sigma = max(sigma * scale, 0.5)
        mask = frame.mask
        if scale < 1.0:
            mask = cv2.resize(mask, self.camera.size, interpolation=cv2.INTER_AREA)
        focal = float(np.sqrt(self.camera.matrix[0, 0] * self.camera.matrix[1, 1]))
        z = vertices @ self.camera.T_camera_world[2, :3] + self.camera.T_camera_world[2, 3]
        self.pixels_per_metre = focal / max(float(np.median(z)), 0.1)  # [px/m] at the body
        rim = surface.rims(self.camera).find(vertices, self.camera, spacing=_SPACING, inner=False)
        self.mask = choose_person(mask, self._about(settings.reach * self.pixels_per_metre))
        points = outline(self.mask)
        self._image = np.ascontiguousarray(points[:, :: max(round(1.3 * _SPACING), 1)])
        self._first: tuple[NDArray, Rim] | None = (vertices, rim)
        # Over a patch of the surface the errors of an outline are alike, and every place is told of from both sides.
        share = min(_SPACING / (settings.patch * self.pixels_per_metre), 1.0)
        self._row_sigma = self.sigma / np.sqrt(share / 2.0)

    def _about(self, reach: float) -> NDArray:
        """(h, w) bool: as far about the body, as it was drawn last, as it may have moved."""
        seen = self.surface.rims(self.camera).drawn(self.camera) >= 0
        size = 2 * int(np.ceil(reach)) + 1
        return cv2.dilate(seen.astype(np.uint8), np.ones((size, size), np.uint8)) > 0

    def rim(self, state: BodyState, stale: float = _STALE) -> tuple[NDArray, Rim]:
        """Vertices in the world and the rim at a state, without its inner points."""
        vertices = self.surface.pose(state).vertices
        if self._first is not None and self._first[0] is vertices:
            return self._first
        finder = self.surface.rims(self.camera)
        rim = finder.find(vertices, self.camera, spacing=_SPACING, inner=False, stale=stale)
        self._first = vertices, rim
        return self._first

    def rows(self, state: BodyState, bound: float) -> list[Rows | DofRows]:
        """Rows at a state, softened at half the bound."""
        return [self.linked(state, bound)[0]]

    def linked(self, state: BodyState, bound: float) -> tuple[Rows | DofRows, Rim, NDArray]:
        """The rows at a state, the point of the rim that each is about, and that of the outline (4, N)."""
        reach = max(bound * self.pixels_per_metre, _AGREES * self.sigma, _LEAST)
        vertices, shown = self.rim(state)
        pairs = outline_pairs(shown.outline, self._image, reach=reach, angle=self._settings.angle)
        rows: Rows | DofRows
        if self.surface.morphing.is_rigid:
            body, camera = self.surface.body, self.camera
            rows = outline_rows(body, state, shown, vertices, camera, self._image, pairs, sigma=self._row_sigma)
        else:
            pose = self.surface.pose(state)
            rows = morphed_outline_rows(pose, shown, self.camera, self._image, pairs, sigma=self._row_sigma)
        square = rows.weight * rows.residual**2 * self._row_sigma**2  # [px²]
        rows.weight[:] = rows.weight / (1.0 + square / (0.5 * reach) ** 2) ** 2
        points = shown.chosen(pairs[0][rows.group])
        tangents = self._image[:, pairs[1][rows.group]]
        rows.group[:] = -1  # softened already
        return rows, points, tangents

    def evidence(self, state: BodyState) -> Evidence:
        """Points of each segment's outline that the silhouette's outline runs along, and those that it does not."""
        _, shown = self.rim(state)
        count = len(self.surface.areas)
        reach = max(min(_AGREES * self.sigma, _LIMB * self.pixels_per_metre), _LEAST)
        i, _ = outline_pairs(shown.outline, self._image, reach=reach, angle=self._settings.angle, both=False)
        agreeing = np.bincount(shown.segment[i], minlength=count)
        seen = np.bincount(shown.segment, minlength=count)
        whole = np.maximum(self._outline_of_segments(), 1.0)
        return Evidence(agreeing / whole, (seen - agreeing) / whole)

    def overlap(self, state: BodyState) -> float:
        """Intersection over union of the body's own silhouette at a state and the image's, 0..1."""
        self._first = None
        self.rim(state, stale=0.0)
        body, image = self.surface.rims(self.camera).drawn(self.camera) >= 0, self.mask > 127
        return float((body & image).sum() / max((body | image).sum(), 1))

    def _outline_of_segments(self) -> NDArray:
        """(S,) points on the outline of each segment, about, if it were seen alone."""
        return np.sqrt(np.pi * self.surface.areas) * self.pixels_per_metre / _SPACING

    def view(self) -> None:
        """Outlines do not show where a limb is in space."""




class SilhouetteSensor(Sensor):
    """The silhouette in one camera: the body's occluding contour and the image's outline towards each other.

    Parameters
    ----------
    camera : Camera, whose name frames bear; the sensor's own is "silhouette CAMERA".
    sigma : float [px] standard deviation of the outline, shape of the body included, in the camera's image.
    settings : FusionSettings
    """

    def __init__(self, camera: Camera, sigma: float, settings: FusionSettings) -> None:
        self.name, self.camera, self.settings = f"silhouette {camera.name}", camera, settings
        self.small = outline_camera(camera, settings)
        #: [px] of the small image in one of the camera's
        self.scale = self.small.size[0] / camera.size[0]
        self.sigma = max(sigma * self.scale, 0.5)

    def prepare(self, frame: SilhouetteFrame, scene: Scene) -> OutlineMeasurement:
        """The outline of the blobs that are the body's.

        Raises
        ------
        ObservationError
            A mask of another size than the camera's.
        BodyError
            A body without surfaces.
        """
        return OutlineMeasurement(self, frame, scene)


class OutlineMeasurement(Measurement):
    """A silhouette of one time; of several blobs those count that are where the body is expected.

    Parameters
    ----------
    of : SilhouetteSensor
    frame : SilhouetteFrame
    scene : Scene with the body where it is expected.

    Attributes
    ----------
    camera : Camera of the small image in which outlines are compared
    mask : (h, w) uint8 of that image
    outline : (4, M) u, v [px] and unit normals of its outline
    sigma : float [px] there
    """

    settled = False

    def __init__(self, of: SilhouetteSensor, frame: SilhouetteFrame, scene: Scene) -> None:
        if frame.size != of.camera.size:
            problem = f"masks of {frame.sensor} are {frame.size} px, its camera has {of.camera.size}"
            raise ObservationError(problem, remedy="Give the masks in the size of the images that were calibrated.")
        self.sensor, self.time, self.of, self.camera, self.sigma = of.name, frame.time, of, of.small, of.sigma
        mask = frame.mask
        if of.scale < 1.0:
            mask = cv2.resize(mask, self.camera.size, interpolation=cv2.INTER_AREA)
        vertices = scene.pose.vertices
        focal = float(np.sqrt(self.camera.matrix[0, 0] * self.camera.matrix[1, 1]))
        z = vertices @ self.camera.T_camera_world[2, :3] + self.camera.T_camera_world[2, 3]
        self.pixels_per_metre = focal / max(float(np.median(z)), 0.1)  # [px/m] at the body
        self._last: tuple[NDArray, Rim] | None = None
        self.rim(scene, stale=0.0)
        size = 2 * int(np.ceil(of.settings.reach * self.pixels_per_metre)) + 1  # as far about it as it may have moved
        seen = scene.surface.rims(self.camera).drawn(self.camera) >= 0
        self.mask = choose_person(mask, cv2.dilate(seen.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
        self.outline = np.ascontiguousarray(outline(self.mask)[:, :: max(round(1.3 * _SPACING), 1)])
        # Over a patch of the surface the errors of an outline are alike, and every place is told of from both sides.
        share = min(_SPACING / (of.settings.patch * self.pixels_per_metre), 1.0)
        self._row_sigma = self.sigma / np.sqrt(share / 2.0)

    def rim(self, scene: Scene, stale: float = _STALE) -> Rim:
        """The occluding contour at a scene's state, without its inner points; kept for the state asked for last."""
        vertices = scene.pose.vertices
        if self._last is None or self._last[0] is not vertices or stale == 0.0:
            finder = scene.surface.rims(self.camera)
            rim = finder.find(vertices, self.camera, spacing=_SPACING, inner=False, stale=stale)
            self._last = vertices, rim
        return self._last[1]

    def match(self, scene: Scene, reach: float) -> SilhouetteMatched:
        """Points of both outlines that are near each other and look the same way."""
        bound = max(reach * self.pixels_per_metre, _AGREES * self.sigma, _LEAST)
        rim = self.rim(scene)
        i, k = outline_pairs(rim.outline, self.outline, reach=bound, angle=self.of.settings.angle)
        loss = geman_mcclure(0.5 * bound / self._row_sigma)
        return SilhouetteMatched(self, rim.chosen(i), np.ascontiguousarray(self.outline[:, k]), self._row_sigma, loss)

    def evidence(self, scene: Scene) -> Evidence:
        """Points of each segment's outline that the silhouette's outline runs along, and those that it does not."""
        rim, areas = self.rim(scene), scene.surface.areas
        reach = max(min(_AGREES * self.sigma, _LIMB * self.pixels_per_metre), _LEAST)
        i, _ = outline_pairs(rim.outline, self.outline, reach=reach, angle=self.of.settings.angle, both=False)
        agreeing = np.bincount(rim.segment[i], minlength=len(areas))
        seen = np.bincount(rim.segment, minlength=len(areas))
        whole = np.maximum(np.sqrt(np.pi * areas) * self.pixels_per_metre / _SPACING, 1.0)  # points, if seen alone
        return Evidence(agreeing / whole, (seen - agreeing) / whole)

    def overlap(self, scene: Scene) -> float:
        """Intersection over union of the body's own silhouette at a scene's state and the image's, 0..1."""
        self.rim(scene, stale=0.0)
        body, image = scene.surface.rims(self.camera).drawn(self.camera) >= 0, self.mask > 127
        return float((body & image).sum() / max((body | image).sum(), 1))

    def compact(self) -> OutlineMeasurement:
        """Without what was drawn of the body."""
        out = copy(self)
        out._last = None
        return out


@dataclass(frozen=True, eq=False)
class SilhouetteMatched(Matched):
    """A silhouette with its correspondences.

    Parameters
    ----------
    measurement : OutlineMeasurement
    rim : Rim, N points of the body's occluding contour, of edges of its mesh
    tangents : (4, N) u, v [px] and unit normals of the image's outline
    row_sigma : float [px] standard deviation of a pair
    loss : Loss
    """

    measurement: OutlineMeasurement
    rim: Rim
    tangents: NDArray
    row_sigma: float
    loss: Loss

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a pair: the pixel of the body's point should lie on the tangent of the image's outline."""
        numbers, camera = np.arange(len(self.rim)), self.measurement.camera
        pairs = numbers, numbers
        if scene.surface.morphing.is_rigid:
            rows = outline_rows(
                scene.body, scene.state, self.rim, scene.pose.vertices, camera, self.tangents, pairs,
                sigma=self.row_sigma,
            )  # fmt: skip
            return [replace(rows, loss=self.loss)]
        blended = morphed_outline_rows(scene.pose, self.rim, camera, self.tangents, pairs, sigma=self.row_sigma)
        return [replace(blended, loss=self.loss)]

    def evidence(self, scene: Scene) -> Evidence:
        """Points of each segment's outline that the silhouette's outline runs along, and those that it does not."""
        return self.measurement.evidence(scene)

    def summary(self, scene: Scene) -> SegmentResiduals:
        """Distances [px], in the camera's own image, of the image's outline from the body's, by segments."""
        uv = self.measurement.camera.project(self.rim.on(scene.pose.vertices))
        away = np.sum(self.tangents[2:].T * (self.tangents[:2].T - uv), axis=1) / self.measurement.of.scale
        seen = np.isfinite(away)
        return by_segment(away[seen], self.rim.segment[seen], len(scene.body.tree.segments))
