"""Point clouds: measured points as rows towards the body's surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.correspondences import surface_rows
from kinefit.geometry.camera import Camera
from kinefit.observations import PointCloud
from kinefit.rows import AnyRows, Rows
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor, by_segments
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, Evidence
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_view import camera_at, splat, view_of
from kinefit.sensors.surfaces.surface_match import SurfacePairs, along

_HASH_PRIMES = np.array((73856093, 19349663, 83492791))  # of a spatial hash (Teschner et al., VMV 2003)


class PointCloudSensor(Sensor):
    """A scanner of points on any surface, on the body, or on one of its segments (P2 2.3).

    Parameters
    ----------
    name : as its frames are named
    sigma : float [m] standard deviation of a point.
    settings : TrackSettings
    camera : Camera, if the scanner is one of the rig's: its points move with the camera's pose.
    """

    shows_person = True

    def __init__(self, name: str, sigma: float, settings: TrackSettings, camera: Camera | None = None) -> None:
        self.name, self.sigma, self.settings, self.camera = name, sigma, settings, camera

    def prepare(self, frame: PointCloud, scene: Scene) -> PointCloudMeasurement:
        """The measurement of one cloud: its points near the body.

        Raises
        ------
        BodyError
            A segment that the body does not have; a body without surfaces.
        """
        return PointCloudMeasurement(self, frame, scene)


class PointCloudMeasurement(Measurement):
    """Points of one time.

    Parameters
    ----------
    of : PointCloudSensor
    frame : PointCloud
    scene : Scene with the body at its prediction: points of unknown origin count only near it.

    Attributes
    ----------
    points : (N, 3) [m]
    """

    settled = False

    def __init__(self, of: PointCloudSensor, frame: PointCloud, scene: Scene) -> None:
        s = of.settings
        self.sensor, self.time, self.sigma, self._eye = of.name, frame.time, of.sigma, frame.viewpoint
        self.of = of
        self._segment = None if frame.segment is None else np.int64(scene.body.tree.segment(frame.segment))
        self._certain = frame.on_body or frame.segment is not None
        x, vertices = frame.points, scene.surface.posed(scene.state)
        if not self._certain:
            low, high = vertices.min(axis=0) - s.reach, vertices.max(axis=0) + s.reach
            x = x[((x > low) & (x < high)).all(axis=1)]
        self.points = np.array(x[:: max(len(x) // s.points, 1)], float)
        cells = np.floor(np.clip(self.points, -1e6, 1e6) / s.patch).astype(np.int64)
        patches = len(np.unique(cells @ _HASH_PRIMES))
        self._point_sigma = of.sigma * np.sqrt(max(len(self.points) / max(patches, 1), 1.0))

    @property
    def _camera(self) -> Camera | None:
        return self.of.camera

    def match(self, scene: Scene, reach: float) -> PointCloudMatched:
        """Match points to the nearest surface within `reach` [m]; twice as far if they are known to be the body's."""
        bound = max(2.0 * reach if self._certain else reach, AGREEMENT_SIGMAS * self.sigma)
        points, _ = self._seen(scene)
        camera = None if self._camera is None else scene.placed(self._camera)
        near = self._near(scene, bound)
        return PointCloudMatched(self, SurfacePairs.nearest(near, points, scene, bound / 2.0, camera=camera))

    def _seen(self, scene: Scene) -> tuple[NDArray, NDArray | None]:
        """(N, 3) [m] its points and (3,) [m] its viewpoint, with the scanner's pose in the scene's rig."""
        if self._camera is None:
            return self.points, self._eye
        eye = None if self._eye is None else along(self._eye[None], self._camera, scene)[0]
        return along(self.points, self._camera, scene), eye

    def _near(self, scene: Scene, reach: float) -> Rows:
        points, eye = self._seen(scene)
        return surface_rows(
            scene.body, scene.state, points, max_distance=reach, sigma=self._point_sigma, viewpoint=eye,
            segment=self._segment, frames=scene.frames,
        )  # fmt: skip

    def evidence(self, scene: Scene) -> Evidence:
        """Support of each segment: points near it over the number expected from its share of the surface, at most 1."""
        rows, areas = self._near(scene, AGREEMENT_SIGMAS * self.sigma), scene.surface.areas
        count, none = len(self.points), np.zeros(len(areas))
        if self._segment is not None:
            share, out = len(rows) / max(count, 1), Evidence(none, none.copy())
            out.agreeing[self._segment], out.contrary[self._segment] = share, (1.0 - share) * bool(count)
            return out
        expected = np.maximum(count * areas / max(areas.sum(), 1e-12), 1.0)
        return Evidence(np.minimum(np.bincount(rows.segment, minlength=len(none)) / expected, 1.0), none)

    def hints(self, scene: Scene) -> Hints:
        """A view of the points from the sensor."""
        if not len(self.points):
            return Hints()
        coarse, small = splat(self.points, camera_at(self.points, self._eye))
        return Hints(view=view_of(coarse, coarse > 0, small) if (coarse > 0).any() else None)


@dataclass(frozen=True, eq=False)
class PointCloudMatched(Matched):
    """A cloud with its correspondences.

    Parameters
    ----------
    measurement : PointCloudMeasurement
    pairs : SurfacePairs of points and the nearest ones of the surface
    """

    measurement: PointCloudMeasurement
    pairs: SurfacePairs
    of_points = False
    shows_surface = True

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a point."""
        return [self.pairs.rows(scene)]

    def evidence(self, scene: Scene) -> Evidence:
        """Support of each segment: points near it over the number expected from its share of the surface, at most 1."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [m] of the points from the surface, by segments."""
        rows = self.pairs.on_segments(scene)
        return [by_segments(self.sensor, scene.body, rows.residual, rows.segment, "m")]
