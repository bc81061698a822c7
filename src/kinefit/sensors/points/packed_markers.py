"""Labelled markers of a whole take as one packed block of metres, which the compiled solvers evaluate exactly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.bodies import Body, PointSet
from kinefit.losses import Loss
from kinefit.motion import Residuals
from kinefit.sensors.base import Matched, Measurement, matched_by
from kinefit.sensors.channels import joined
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.points.markers import MarkerMeasurement, MarkerSensor, markers_of, of_points
from kinefit.sensors.scene import Scene

_MAX_TIME_GAP_S = 1e-6  # of a marker from its frame; with a larger gap the body is moved, which only rows can do
_STRETCH = 600  # frames that are computed at a time


@dataclass(frozen=True, eq=False)
class PackedMarkers:
    """K labelled markers in T frames.

    Parameters
    ----------
    streams : Q marker sensors, each with a marker set
    source : (K,) int, number of each marker's stream
    points : PointSet of the K markers on the body
    places : (T, K, 3) [m] as measured, 0 where unobserved
    stated : (T, K) [1/m²] weights by the stated standard deviations, 0 where unobserved
    times : (T,) [s]
    loss : Loss of a marker, in its stated standard deviations
    scale : {sensor: factor} on the standard deviations, estimated from the take
    """

    streams: tuple[tuple[MarkerSensor, str], ...]
    source: NDArray
    points: PointSet
    places: NDArray
    stated: NDArray
    times: NDArray
    loss: Loss
    scale: Mapping[str, float]

    @classmethod
    def of(
        cls, body: Body, measurements: Sequence[Sequence[Measurement]], times: NDArray, loss: Loss
    ) -> PackedMarkers | None:
        """Markers of T frames with this loss, measured at the frames' times (T,) [s]; None if there are none."""
        found: dict[tuple[str, str], tuple[MarkerSensor, dict[str, None]]] = {}
        apart = set[str]()
        for time, several in zip(times, measurements, strict=True):
            for m in several:
                if isinstance(m, MarkerMeasurement):
                    _, names = found.setdefault((m.sensor, m.marker_set), (m.of, {}))
                    names.update(dict.fromkeys(m.names))
                    if abs(m.time - time) > _MAX_TIME_GAP_S or m.of.loss != loss:
                        apart.add(m.sensor)
        column: dict[tuple[str, str, str], int] = {}
        parts, streams, source = list[PointSet](), list[tuple[MarkerSensor, str]](), list[int]()
        for (name, marker_set), (sensor, names) in found.items():
            if name not in apart and names:
                column.update({(name, marker_set, one): len(source) + i for i, one in enumerate(names)})
                source += [len(streams)] * len(names)
                streams.append((sensor, marker_set))
                parts.append(markers_of(body, marker_set).select(tuple(names)))
        if not streams:
            return None
        places, stated = room((len(times), len(source), 3)), room((len(times), len(source)))
        for f, several in enumerate(measurements):
            for m in several:
                if isinstance(m, MarkerMeasurement) and m.sensor not in apart:
                    own = [column[m.sensor, m.marker_set, name] for name in m.names]
                    places[f, own], stated[f, own] = m.x_world, m.weight
        release(places, stated)
        scale = {sensor.name: 1.0 for sensor, _ in streams}
        return cls(tuple(streams), np.array(source), joined(parts), places, stated, times, loss, scale)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(self.scale)

    def columns(self, sensor: str) -> NDArray:
        """(K',) int: the markers of a sensor."""
        own = [q for q, (of, _) in enumerate(self.streams) if of.name == sensor]
        return np.flatnonzero(np.isin(self.source, own))

    @cached_property
    def weight(self) -> NDArray:
        """(T, K) [1/m²] weights by the estimated standard deviations, 0 where unobserved."""
        factor = np.array([self.scale[sensor.name] for sensor, _ in self.streams])
        return np.asarray(self.stated / np.square(factor[self.source]))

    def part(self, frames: slice) -> PackedMarkers:
        """The markers of some frames."""
        return replace(self, places=self.places[frames], stated=self.stated[frames], times=self.times[frames])

    def measurements(self, f: int) -> tuple[MarkerMeasurement, ...]:
        """The measurements of one frame."""
        out = list[MarkerMeasurement]()
        for q, (sensor, marker_set) in enumerate(self.streams):
            here = np.flatnonzero((self.source == q) & (self.stated[f] > 0.0))
            if len(here):
                names = tuple(self.points.names[k] for k in here)
                x = np.ascontiguousarray(self.places[f, here])
                out.append(MarkerMeasurement(sensor, names, x, marker_set, float(self.times[f])))
        return tuple(out)

    def matched(self, f: int, scene: Scene) -> tuple[Matched, ...]:
        """The matches of one frame."""
        return tuple(matched_by(m, scene, m.of.near) for m in self.measurements(f))

    def gaps(self, body: Body, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, K, 3) [m] measured minus fitted at states (T, 4, 4), (T, D); NaN where unobserved."""
        fitted = body.trajectories(roots, angles, self.points)
        return np.where(self.stated[..., None] > 0.0, self.places - fitted, np.nan)

    def squares(self, gaps: NDArray) -> NDArray:
        """(T, K) squared lengths of `gaps` (T, K, 3), in stated variances; NaN where unobserved."""
        return np.asarray(self.stated * np.square(gaps).sum(axis=2))

    def factors(self, gaps: NDArray) -> NDArray:
        """(T, K) robust factors of `gaps` (T, K, 3); 0 where unobserved."""
        squares = self.squares(gaps)
        return np.where(np.isfinite(squares), self.loss.factor(np.nan_to_num(squares)), 0.0)

    def evidence(self, body: Body, gaps: NDArray) -> Evidence:
        """Evidence of T frames from `gaps` (T, K, 3): that of all sensors, as `MarkerMatched.evidence` has it."""
        return of_points(body, self.points, self.squares(gaps))

    def residuals(self, body: Body, roots: NDArray, angles: NDArray) -> dict[str, Residuals]:
        """Residuals at states (T, 4, 4), (T, D), by sensor."""
        values, weights = room(self.places.shape), room(self.stated.shape)
        for start in range(0, len(values), _STRETCH):
            some = slice(start, start + _STRETCH)
            part = self.part(some)
            values[some] = part.gaps(body, roots[some], angles[some])
            weights[some] = part.factors(values[some])
            release(values, weights, self.places, self.stated)
        measured = np.where(np.isfinite(values), self.places, np.nan)
        out = {}
        for sensor in self.sensors:
            own = self.columns(sensor)
            out[sensor] = Residuals(
                tuple(self.points.names[k] for k in own), self.points.segments[own], values[:, own], weights[:, own],
                "m", measured[:, own], np.zeros(len(values), bool),
            )  # fmt: skip
        return out
