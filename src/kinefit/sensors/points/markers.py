"""Labelled markers of one time: point to point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.geometry.losses import Loss
from kinefit.observations import MarkerFrame
from kinefit.sensors.base import Hints, Leftover, Matched, Measurement, Sensor
from kinefit.sensors.evidence import AGREEMENT_SIGMAS, MIN_VISIBLE_OUTLINE, Evidence
from kinefit.sensors.scene import Scene
from kinefit.solving.correspondences import _kernels
from kinefit.solving.rows import AnyRows

_AT_JOINT = 0.05  # [m] from a joint: such a point is evidence for the segments on both sides of it


class MarkerSensor(Sensor):
    """A marker system, its markers named.

    Parameters
    ----------
    name : str
    sigma : float [m] standard deviation along each axis, with what a marker moves on the skin
    loss : Loss of a marker, in its standard deviations
    near : float [m] correspondence distance at which the loss holds as it is; it is wider while all is far off
    each : {marker: float} [m] of those that have a sigma of their own
    """

    places_points = True

    def __init__(
        self, name: str, sigma: float, loss: Loss, near: float, each: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        self.name, self.sigma, self.loss, self.near, self.each = name, sigma, loss, near, each

    def prepare(self, frame: MarkerFrame, scene: Scene) -> MarkerMeasurement:
        """Those markers that the body has and that were seen.

        Raises
        ------
        BodyError
            A marker set that the body does not have.
        """
        known = set(markers_of(scene.body, frame.marker_set).names)
        seen = np.isfinite(frame.positions).all(axis=1)
        here = [k for k, name in enumerate(frame.names) if name in known and seen[k]]
        names = tuple(frame.names[k] for k in here)
        x = np.ascontiguousarray(frame.positions[here])
        return MarkerMeasurement(self, names, x, frame.marker_set, frame.time)


def markers_of(body: Body, marker_set: str) -> PointSet:
    """Where a marker set's markers sit on a body; the body's landmarks for no set."""
    return body.markers(marker_set) if marker_set else body.landmarks


class MarkerMeasurement(Measurement):
    """Markers of one time.

    Parameters
    ----------
    of : MarkerSensor
    names : (M,); x_world : (M, 3) [m]; marker_set : str; time : float [s]
    """

    def __init__(
        self, of: MarkerSensor, names: tuple[str, ...], x_world: NDArray, marker_set: str, time: float
    ) -> None:
        self.sensor, self.time, self.of = of.name, time, of
        self.names, self.x_world, self.marker_set = names, x_world, marker_set
        self.weight = 1.0 / np.square([of.each.get(name, of.sigma) for name in names])
        self._points: tuple[Body, PointSet] | None = None

    def points_of(self, body: Body) -> PointSet:
        """(M,) the markers on a body."""
        if self._points is None or self._points[0] is not body:
            self._points = body, markers_of(body, self.marker_set).select(self.names)
        return self._points[1]

    def match(self, scene: Scene, reach: float) -> MarkerMatched:
        """As they are named."""
        loss = self.of.loss
        return MarkerMatched(self, replace(loss, scale=loss.scale * max(reach / self.of.near, 1.0)))

    def hints(self, scene: Scene) -> Hints:
        """Where they are."""
        return Hints(self.points_of(scene.body), self.x_world)


@dataclass(frozen=True, eq=False)
class MarkerMatched(Matched):
    """Markers with their places on the body; measurement and the Loss of a marker."""

    measurement: MarkerMeasurement
    loss: Loss
    lasts = 1.0  # a marker system's own noise is a tenth of what markers are off by: skin, and where they were put on
    independent = True

    cameras = np.zeros(0, np.int64)

    @property
    def places(self) -> Sequence[tuple[str, str]]:  # type: ignore[override]
        """Of every marker."""
        return [(self.measurement.marker_set, name) for name in self.measurement.names]

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """Three rows a marker."""
        m = self.measurement
        rows = scene.rows_of(_kernels.point_rows, 3, m.points_of(scene.body), m.x_world, m.weight)
        return [replace(rows, loss=self.loss)]

    def squares(self, scene: Scene) -> NDArray:
        """(M,) squared distances, in variances."""
        m = self.measurement
        return np.asarray(m.weight * np.square(m.x_world - scene.positions(m.points_of(scene.body))).sum(axis=1))

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """Of every marker."""
        m = self.measurement
        points = m.points_of(scene.body)
        values, factor = m.x_world - scene.positions(points), self.loss.factor(self.squares(scene))
        return [Leftover(m.sensor, m.names, points.segments, values, factor, "m", m.x_world)]

    def evidence(self, scene: Scene) -> Evidence:
        """A marker speaks for its segment within three standard deviations, and against it beyond."""
        return of_points(scene.body, self.measurement.points_of(scene.body), self.squares(scene))


def of_points(body: Body, points: PointSet, square: NDArray) -> Evidence:
    """Evidence of points with squared residuals (..., K) in variances, NaN for those that were not seen."""
    above = body.tree.parents[points.segments]
    at_joint = np.flatnonzero((above >= 0) & (np.linalg.norm(points.points, axis=1) < _AT_JOINT))
    speaks = np.zeros((len(points), len(body.tree.segments)))
    speaks[np.arange(len(points)), points.segments] = MIN_VISIBLE_OUTLINE
    speaks[at_joint, above[at_joint]] += MIN_VISIBLE_OUTLINE
    with np.errstate(invalid="ignore"):
        return Evidence((square < AGREEMENT_SIGMAS**2) @ speaks, (square >= AGREEMENT_SIGMAS**2) @ speaks)
