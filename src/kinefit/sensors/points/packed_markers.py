"""Labelled markers of a whole take as one packed block of metres, which the compiled solvers evaluate exactly."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
        cls, body: Body, measurements: Iterable[Sequence[Measurement]], times: NDArray, loss: Loss
    ) -> PackedMarkers | None:
        """Markers of T frames with this loss, measured at the frames' times (T,) [s]; None if there are none."""
        streams, apart = dict[tuple[str, str], MarkerSensor](), set[str]()
        column, columns = dict[tuple[str, str, str], int](), dict[tuple[str, str, tuple[str, ...]], list[int]]()
        places, stated = room((len(times), 0, 3)), room((len(times), 0))
        for f, several in enumerate(measurements):
            for m in several:
                if not isinstance(m, MarkerMeasurement):
                    continue
                if abs(m.time - times[f]) > _MAX_TIME_GAP_S or m.of.loss != loss:
                    apart.add(m.sensor)
                key = m.sensor, m.marker_set
                own = columns.get((*key, m.names))
                if own is None:
                    streams.setdefault(key, m.of)
                    own = columns[*key, m.names] = [column.setdefault((*key, n), len(column)) for n in m.names]
                    places, stated = _wider(places, len(column)), _wider(stated, len(column))
                places[f, own], stated[f, own] = m.x_world, m.weight
            if f % _STRETCH == 0:
                release(places, stated)
        used = [k for k, (name, _, _) in enumerate(column) if name not in apart]
        if not used:
            return None
        if len(used) < len(column):
            places, stated = places[:, used], stated[:, used]
        kept = [key for key in streams if key[0] not in apart]
        of = [(kept.index((name, marker_set)), one) for name, marker_set, one in column if name not in apart]
        points = joined([markers_of(body, kept[q][1]).select((one,)) for q, one in of])
        scale = {name: 1.0 for name, _ in kept}
        source = np.array([q for q, _ in of])
        found = tuple((streams[key], key[1]) for key in kept)
        return cls(found, source, points, places, stated, times, loss, scale)

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

    @property
    def measured(self) -> tuple[NDArray, NDArray]:
        """(T, K, 3) [m] as measured, NaN where unobserved, and (K,) [m] stated sigma, 1 of markers never observed."""
        x, weight = room(self.places.shape), self.stated.max(axis=0)
        x[:] = np.where(self.stated[..., None] > 0.0, self.places, np.nan)
        return x, 1.0 / np.sqrt(np.where(weight > 0.0, weight, 1.0))

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


def _wider(array: NDArray, count: int) -> NDArray:
    """An array (T, K, ...) with so many columns; new ones are 0."""
    if array.shape[1] == count:
        return array
    out = room((len(array), count, *array.shape[2:]))
    out[:, : array.shape[1]] = array
    return out
