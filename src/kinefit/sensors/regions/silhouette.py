"""Silhouettes: the contour of a mask and the body's occluding contour as rows."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.rendering import scaled
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.geometry.losses import Loss, geman_mcclure
from kinefit.images.silhouette import choose_person, outline
from kinefit.observations import SilhouetteFrame
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.visibility.occlusion import drawn_together, outside_others
from kinefit.solving.correspondences.contours.outlines import Rim, morphed_outline_rows, outline_pairs, outline_rows
from kinefit.solving.rows import AnyRows, DofRows, Rows

_MAX_RENDER_SHIFT_PX = 0.5  # of a body since its rendering: half of the offset at which pixels at the contour are read
_FOREARM_RADIUS = 0.04  # [m]: a contour farther off is another part's, however poor the masks are
_POINT_SPACING_PX = 2.0  # of a contour, in the image in which contours are compared
_MIN_PAIR_DISTANCE_PX = 3.0  # of that image, within which points always pair: the neighbours on a slanted contour


def outline_camera(camera: Camera, settings: TrackSettings) -> Camera:
    """The camera of the image in which contours are compared: its own, downsampled by a whole factor."""
    return scaled(camera, 1.0 / max(round(max(camera.size) / settings.outline), 1))


def averaged(mask: NDArray, size: tuple[int, int]) -> NDArray:
    """A mask (H, W), downsampled to a size (width, height) [px] by area averaging.

    A whole factor comes first, as that is fast; it is at most half of the total, so that the second step blurs little.
    """
    height, width = mask.shape
    half = int(0.5 * min(width / size[0], height / size[1]))
    whole = max(k for k in range(1, max(half, 1) + 1) if width % k == height % k == 0)
    for step in ((width // whole, height // whole), size):
        if mask.shape != step[::-1]:
            mask = cv2.resize(mask, step, interpolation=cv2.INTER_AREA)
    return mask


def contour_rows(scene: Scene, rim: Rim, camera: Camera, tangents: NDArray, sigma: float) -> Rows | DofRows:
    """One row a point of a body's contour: it should project onto its tangent (4, N) of the image's, sigma [px]."""
    if scene.surface.morphing.is_rigid:
        return outline_rows(scene.body, scene.state, rim, scene.pose.vertices, camera, tangents, sigma=sigma)
    return morphed_outline_rows(scene.pose, rim, camera, tangents, sigma=sigma)


class SilhouetteSensor(Sensor):
    """The silhouettes of one camera. Rows pull the body's occluding contour and the mask's contour together.

    Parameters
    ----------
    camera : Camera, whose name frames bear; the sensor's own is "silhouette CAMERA".
    sigma : float [px] standard deviation of the contour, shape of the body included, in the camera's image.
    settings : TrackSettings
    """

    def __init__(self, camera: Camera, sigma: float, settings: TrackSettings) -> None:
        self.name, self.camera, self.settings = f"silhouette {camera.name}", camera, settings
        self.small = outline_camera(camera, settings)
        #: [px] of the small image in one of the camera's
        self.scale = self.small.size[0] / camera.size[0]
        self.sigma = max(sigma * self.scale, 0.5)

    def prepare(self, frame: SilhouetteFrame, scene: Scene) -> SilhouetteMeasurement:
        """The measurement of one mask: the contour of the blobs that are the body's.

        Raises
        ------
        ObservationError
            A mask of another size than the camera's.
        BodyError
            A body without surfaces.
        """
        return SilhouetteMeasurement(self, frame, scene)


class SilhouetteMeasurement(Measurement):
    """A silhouette of one time; of several blobs those at the body's predicted place count.

    Parameters
    ----------
    of : SilhouetteSensor
    frame : SilhouetteFrame
    scene : Scene with the body at its prediction.

    Attributes
    ----------
    mask : (h, w) uint8 in the image of `camera`
    outline : (4, M) u, v [px] and unit normals of its contour
    sigma : float [px] in that image
    """

    settled = False

    def __init__(self, of: SilhouetteSensor, frame: SilhouetteFrame, scene: Scene) -> None:
        if frame.size != of.camera.size:
            problem = f"masks of {frame.sensor} have {frame.size} px, its camera {of.camera.size}"
            raise ObservationError(problem, remedy="Give masks of the calibrated size.")
        self.sensor, self.time, self.of, self.sigma = of.name, frame.time, of, of.sigma
        mask = frame.mask
        if of.scale < 1.0:
            mask = averaged(mask, self.camera.size)
        vertices = scene.pose.vertices
        focal = float(np.sqrt(self.camera.matrix[0, 0] * self.camera.matrix[1, 1]))
        T = scene.placed(self.camera).T_camera_world
        z = vertices @ T[2, :3] + T[2, 3]
        self.pixels_per_metre = focal / max(float(np.median(z)), 0.1)  # [px/m] at the body
        self._last: tuple[NDArray, Camera, Rim] | None = None
        self.rim(scene, stale=0.0)
        size = 2 * int(np.ceil(of.settings.reach * self.pixels_per_metre)) + 1  # its largest motion
        seen = scene.surface.rims(scene.placed(self.camera)).drawn(self.camera) >= 0
        own = cv2.dilate(seen.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        other_people = self._parted(mask, scene)
        self.mask = choose_person(np.where(other_people, 0, mask).astype(np.uint8), own)
        points = outline(self.mask)[:, :: max(round(1.3 * _POINT_SPACING_PX), 1)]
        if other_people.any():  # a border between two people is no contour
            near_others = cv2.dilate(other_people.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
            column, row = (np.clip(np.rint(points[k]).astype(int), 0, n - 1) for k, n in enumerate(mask.shape[::-1]))
            points = points[:, ~near_others[row, column]]
        self.outline = np.ascontiguousarray(points)
        # The errors of a contour are alike over a patch of the surface, and each point is paired from both sides.
        share = min(_POINT_SPACING_PX / (of.settings.patch * self.pixels_per_metre), 1.0)
        self._row_sigma = self.sigma / np.sqrt(share / 2.0)

    @property
    def camera(self) -> Camera:
        """The camera of the image in which contours are compared."""
        return self.of.small

    def _parted(self, mask: NDArray, scene: Scene) -> NDArray:
        """(h, w) bool: pixels of the silhouette that are another person's."""
        if not scene.others:
            return np.zeros(mask.shape, bool)
        own, others = (drawn_together(several, self.camera) for several in ([scene], scene.others))
        if own is None or others is None:
            return np.zeros(mask.shape, bool)
        return outside_others(mask, own, others)

    def rim(self, scene: Scene, stale: float = _MAX_RENDER_SHIFT_PX) -> Rim:
        """The occluding contour at a scene's state, without inner points; cached for the latest state.

        The body is rendered anew if it has moved by more than `stale` [px].
        """
        vertices, camera = scene.pose.vertices, scene.placed(self.camera)
        if self._last is None or self._last[0] is not vertices or self._last[1] is not camera or stale == 0.0:
            rim = scene.surface.rims(camera).find(vertices, camera, spacing=_POINT_SPACING_PX, inner=False, stale=stale)
            self._last = vertices, camera, rim
        return self._last[2]

    def match(self, scene: Scene, reach: float) -> SilhouetteMatched:
        """Pair near points of both contours with similar normals; `reach` is the correspondence distance [m]."""
        bound = max(reach * self.pixels_per_metre, AGREEMENT_SIGMAS * self.sigma, _MIN_PAIR_DISTANCE_PX)
        rim = self.rim(scene)
        i, k = outline_pairs(rim.outline, self.outline, reach=bound, angle=self.of.settings.angle)
        loss = geman_mcclure(0.5 * bound / self._row_sigma)
        return SilhouetteMatched(self, rim.chosen(i), np.ascontiguousarray(self.outline[:, k]), self._row_sigma, loss)

    def evidence(self, scene: Scene) -> Evidence:
        """Share of each segment's contour with a silhouette's contour along it, and share without."""
        rim, areas = self.rim(scene), scene.surface.areas
        reach = max(min(AGREEMENT_SIGMAS * self.sigma, _FOREARM_RADIUS * self.pixels_per_metre), _MIN_PAIR_DISTANCE_PX)
        i, _ = outline_pairs(rim.outline, self.outline, reach=reach, angle=self.of.settings.angle, both=False)
        agreeing = np.bincount(rim.segment[i], minlength=len(areas))
        seen = np.bincount(rim.segment, minlength=len(areas))
        # points of an unoccluded segment
        whole = np.maximum(np.sqrt(np.pi * areas) * self.pixels_per_metre / _POINT_SPACING_PX, 1.0)
        return Evidence(agreeing / whole, (seen - agreeing) / whole)

    def overlap(self, scene: Scene) -> float:
        """Intersection over union, a share 0..1, of the body's silhouette at a scene's state and the mask."""
        self.rim(scene, stale=0.0)
        body, image = scene.surface.rims(scene.placed(self.camera)).drawn(self.camera) >= 0, self.mask > 127
        return float((body & image).sum() / max((body | image).sum(), 1))

    def compact(self) -> SilhouetteMeasurement:
        """A copy without the rendered contour."""
        return copy(self)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None}


@dataclass(frozen=True, eq=False)
class SilhouetteMatched(Matched):
    """A silhouette with its correspondences.

    Parameters
    ----------
    measurement : SilhouetteMeasurement
    rim : Rim, N points of the body's occluding contour, of edges of its mesh
    tangents : (4, N) u, v [px] and unit normals of the image's contour
    row_sigma : float [px] standard deviation of a pair
    loss : Loss
    """

    measurement: SilhouetteMeasurement
    rim: Rim
    tangents: NDArray
    row_sigma: float
    loss: Loss
    of_points = False

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a pair: the body's point should project onto the tangent of the image's contour."""
        camera = scene.placed(self.measurement.camera)
        return [replace(contour_rows(scene, self.rim, camera, self.tangents, self.row_sigma), loss=self.loss)]

    def evidence(self, scene: Scene) -> Evidence:
        """Share of each segment's contour with a silhouette's contour along it, and share without."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [px], in the camera's own image, of the mask's contour from the body's, by segments."""
        uv = scene.placed(self.measurement.camera).project(self.rim.on(scene.pose.vertices))
        away = np.sum(self.tangents[2:].T * (self.tangents[:2].T - uv), axis=1) / self.measurement.of.scale
        seen = np.isfinite(away)
        return [by_segments(self.sensor, scene.body, away[seen], self.rim.segment[seen], "px")]
