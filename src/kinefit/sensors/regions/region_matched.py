"""Frozen match of a colour image: one row for each line across the body's contour, and for each point of a seam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinefit.correspondences.contours.morphed import morphed_outline_rows
from kinefit.correspondences.contours.outlines import outline_rows
from kinefit.correspondences.contours.rims import Rim
from kinefit.losses import Loss
from kinefit.rows import AnyRows
from kinefit.sensors.base import Leftover, Matched, by_segments
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_seams import Seams
from kinefit.sensors.scene import Scene

if TYPE_CHECKING:
    from kinefit.sensors.regions.regions import RegionMeasurement


@dataclass(frozen=True, eq=False)
class RegionMatched(Matched):
    """A colour image with the positions of the contour along its normals.

    Parameters
    ----------
    measurement : RegionMeasurement
    rim : Rim, N points of the body's occluding contour, of edges of its mesh
    place : (4, N) u, v [px] of the contour in the image, and unit normals
    weight : (N,) [1/px²]
    loss : Loss
    seams : Seams, optional
    off, sure : (M,) [px], [1/px²] offset of each seam point from the image's seam, and its weight
    """

    measurement: RegionMeasurement
    rim: Rim
    place: NDArray
    weight: NDArray
    loss: Loss
    seams: Seams | None
    off: NDArray
    sure: NDArray
    of_points = False

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """One row a line: the body's point should project onto the image's contour; one row a seam point."""
        seams = [] if self.seams is None else [self.seams.rows(scene, self.off, self.sure, self.loss)]
        camera = scene.placed(self.measurement.of.camera)
        if not scene.surface.morphing.is_rigid:
            blended = morphed_outline_rows(scene.pose, self.rim, camera, self.place, sigma=1.0)
            return [replace(blended, weight=blended.weight * self.weight[blended.group], loss=self.loss), *seams]
        state, x = scene.state, scene.pose.vertices
        rows = outline_rows(scene.body, state, self.rim, x, camera, self.place, sigma=1.0)
        rows.data[7] *= self.weight[rows.group]
        return [replace(rows, loss=self.loss), *seams]

    def evidence(self, scene: Scene) -> Evidence:
        """Share of each segment's contour at which the colours change as expected, and at which they do not."""
        return self.measurement.evidence(scene)

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Distances [px], in the camera's own image, of the image's contour from the body's, by segments."""
        uv = scene.placed(self.measurement.of.camera).project(self.rim.on(scene.pose.vertices))
        away = np.sum(self.place[2:].T * (self.place[:2].T - uv), axis=1)
        seen = np.isfinite(away) & (self.weight > 0.0)
        return [by_segments(self.sensor, scene.body, away[seen], self.rim.segment[seen], "px")]
