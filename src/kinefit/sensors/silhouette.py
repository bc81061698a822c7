"""A silhouette of one time, made ready once, so that every iteration makes its rows quickly."""

from __future__ import annotations

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
from kinefit.observations import SilhouetteFrame
from kinefit.rendering import scaled
from kinefit.rows import DofRows, Rows
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surface import Surface

_AGREES = 3.0  # standard deviations of a rim that agrees
_STALE = 0.5  # [px] by which a body may have moved in the virtual image: half of how far beside its rim it is looked at
_LIMB = 0.04  # [m] radius of a forearm: an outline farther off is another part's, however poor the masks are
_SPACING = 2.0  # [px] between points of an outline, in the image in which they are compared
_LEAST = 3.0  # [px] of that image within which points are always paired: the neighbours on a slanted outline


def outline_camera(camera: Camera, settings: TrackSettings) -> Camera:
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
        settings: TrackSettings,
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


