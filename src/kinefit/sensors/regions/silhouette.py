"""A silhouette of one time, made ready once, so that every iteration makes its rows quickly."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.correspondences.contours.morphed import morphed_outline_rows
from kinefit.correspondences.contours.outlines import outline_pairs, outline_rows
from kinefit.correspondences.contours.rims import Rim
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.images.silhouette import choose_person, outline
from kinefit.losses import Loss, geman_mcclure
from kinefit.observations import SilhouetteFrame
from kinefit.rendering import scaled
from kinefit.rows import AnyRows
from kinefit.sensors.base import Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.visibility.parting import drawn_together, outside_others

_AGREES = 3.0  # standard deviations within which a contour agrees
_STALE = 0.5  # [px] by which a body may have moved in the virtual image: half of how far beside its contour one looks
_LIMB = 0.04  # [m] radius of a forearm: an outline farther off is another part's, however poor the masks are
_SPACING = 2.0  # [px] between points of an outline, in the image in which they are compared
_LEAST = 3.0  # [px] of that image within which points are always paired: the neighbours on a slanted outline


def outline_camera(camera: Camera, settings: TrackSettings) -> Camera:
    """The camera with an image in which outlines are compared, a whole number of times smaller than its own."""
    return scaled(camera, 1.0 / max(round(max(camera.size) / settings.outline), 1))


def averaged(mask: NDArray, size: tuple[int, int]) -> NDArray:
    """A mask (H, W) averaged down to a size (width, height): by a whole factor first, as that is fast.

    The factor is at most half of the whole one: what the second step then shares between pixels is small.
    """
    height, width = mask.shape
    half = int(0.5 * min(width / size[0], height / size[1]))
    whole = max(k for k in range(1, max(half, 1) + 1) if width % k == height % k == 0)
    for step in ((width // whole, height // whole), size):
        if mask.shape != step[::-1]:
            mask = cv2.resize(mask, step, interpolation=cv2.INTER_AREA)
    return mask


class SilhouetteSensor(Sensor):
    """The silhouette in one camera: the body's occluding contour and the image's outline towards each other.

    Parameters
    ----------
    camera : Camera, whose name frames bear; the sensor's own is "silhouette CAMERA".
    sigma : float [px] standard deviation of the outline, shape of the body included, in the camera's image.
    settings : TrackSettings
    """

    def __init__(self, camera: Camera, sigma: float, settings: TrackSettings) -> None:
        self.name, self.camera, self.settings = f"silhouette {camera.name}", camera, settings
        self.small = outline_camera(camera, settings)
        #: [px] of the small image in one of the camera's
        self.scale = self.small.size[0] / camera.size[0]
        self.sigma = max(sigma * self.scale, 0.5)

    def prepare(self, frame: SilhouetteFrame, scene: Scene) -> SilhouetteMeasurement:
        """The outline of the blobs that are the body's.

        Raises
        ------
        ObservationError
            A mask of another size than the camera's.
        BodyError
            A body without surfaces.
        """
        return SilhouetteMeasurement(self, frame, scene)


class SilhouetteMeasurement(Measurement):
    """A silhouette of one time; of several blobs those count that are where the body is expected.

    Parameters
    ----------
    of : SilhouetteSensor
    frame : SilhouetteFrame
    scene : Scene with the body where it is expected.

    Attributes
    ----------
    mask : (h, w) uint8 of that image
    outline : (4, M) u, v [px] and unit normals of its outline
    sigma : float [px] there
    """

    settled = False

    def __init__(self, of: SilhouetteSensor, frame: SilhouetteFrame, scene: Scene) -> None:
        if frame.size != of.camera.size:
            problem = f"masks of {frame.sensor} are {frame.size} px, its camera has {of.camera.size}"
            raise ObservationError(problem, remedy="Give the masks in the size of the images that were calibrated.")
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
        size = 2 * int(np.ceil(of.settings.reach * self.pixels_per_metre)) + 1  # as far about it as it may have moved
        seen = scene.surface.rims(scene.placed(self.camera)).drawn(self.camera) >= 0
        own = cv2.dilate(seen.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        theirs = self._parted(mask, scene)
        self.mask = choose_person(np.where(theirs, 0, mask).astype(np.uint8), own)
        points = outline(self.mask)[:, :: max(round(1.3 * _SPACING), 1)]
        if theirs.any():  # where one person is cut off from another, no contour was seen
            beside = cv2.dilate(theirs.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
            column, row = (np.clip(np.rint(points[k]).astype(int), 0, n - 1) for k, n in enumerate(mask.shape[::-1]))
            points = points[:, ~beside[row, column]]
        self.outline = np.ascontiguousarray(points)
        # Over a patch of the surface the errors of an outline are alike, and every place is measured from both sides.
        share = min(_SPACING / (of.settings.patch * self.pixels_per_metre), 1.0)
        self._row_sigma = self.sigma / np.sqrt(share / 2.0)

    @property
    def camera(self) -> Camera:
        """The camera with the image in which outlines are compared."""
        return self.of.small

    def _parted(self, mask: NDArray, scene: Scene) -> NDArray:
        """(h, w) bool, where the silhouette is another person's."""
        if not scene.others:
            return np.zeros(mask.shape, bool)
        own, others = (drawn_together(several, self.camera) for several in ([scene], scene.others))
        if own is None or others is None:
            return np.zeros(mask.shape, bool)
        return outside_others(mask, own, others)

    def rim(self, scene: Scene, stale: float = _STALE) -> Rim:
        """The occluding contour at a scene's state, without its inner points; kept for the state asked for last."""
        vertices, camera = scene.pose.vertices, scene.placed(self.camera)
        if self._last is None or self._last[0] is not vertices or self._last[1] is not camera or stale == 0.0:
            rim = scene.surface.rims(camera).find(vertices, camera, spacing=_SPACING, inner=False, stale=stale)
            self._last = vertices, camera, rim
        return self._last[2]

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
        body, image = scene.surface.rims(scene.placed(self.camera)).drawn(self.camera) >= 0, self.mask > 127
        return float((body & image).sum() / max((body | image).sum(), 1))

    def compact(self) -> SilhouetteMeasurement:
        """Without what was drawn of the body."""
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
    tangents : (4, N) u, v [px] and unit normals of the image's outline
    row_sigma : float [px] standard deviation of a pair
    loss : Loss
    """

    measurement: SilhouetteMeasurement
    rim: Rim
    tangents: NDArray
    row_sigma: float
    loss: Loss
    of_points = False

    @property
    def sensor(self) -> str:  # type: ignore[override]
        """Name of the silhouettes."""
        return self.measurement.sensor

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a pair: the pixel of the body's point should lie on the tangent of the image's outline."""
        camera = scene.placed(self.measurement.camera)
        if scene.surface.morphing.is_rigid:
            rows = outline_rows(
                scene.body, scene.state, self.rim, scene.pose.vertices, camera, self.tangents, sigma=self.row_sigma
            )  # fmt: skip
            return [replace(rows, loss=self.loss)]
        blended = morphed_outline_rows(scene.pose, self.rim, camera, self.tangents, sigma=self.row_sigma)
        return [replace(blended, loss=self.loss)]

    def evidence(self, scene: Scene) -> Evidence:
        """Points of each segment's outline that the silhouette's outline runs along, and those that it does not."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [px], in the camera's own image, of the image's outline from the body's, by segments."""
        uv = scene.placed(self.measurement.camera).project(self.rim.on(scene.pose.vertices))
        away = np.sum(self.tangents[2:].T * (self.tangents[:2].T - uv), axis=1) / self.measurement.of.scale
        seen = np.isfinite(away)
        return [by_segments(self.sensor, scene.body, away[seen], self.rim.segment[seen], "px")]
