"""Measurements of a sensor with an uncertain pose and clock, compared with the body in the sensor's frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import BodyState
from kinefit.geometry import se3
from kinefit.sensors.base import Leftover, Matched, Measurement, leftovers_at, matched_by, rows_at
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene
from kinefit.solving.rows import AnyRows, DofRows, Rows

AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
"""Names of the six values of a displacement: shift [m] of its centre, then the rotation vector [rad]."""

CLOCK = "clock"
"""Name of the value [s] that is added to the sensor's times."""


def displacement(values: Mapping[str, float], centre: ArrayLike) -> NDArray:
    """(4, 4) transform from the sensor's frame to the world: a rotation about `centre` (3,) [m], and its shift."""
    c = np.asarray(centre, float)
    twist = np.array([values.get(axis, 0.0) for axis in AXES])
    R = se3.exp_so3(twist[3:])
    return se3.transform(R, c + twist[:3] - R @ c)


class Displaced(Measurement):
    """A measurement in a frame whose pose in the world and clock a subject fit estimates.

    The body is moved the opposite way instead of the sensor, so this works for every sensor. The scene's values of the
    sensor are those of `AXES` and `CLOCK`.

    Parameters
    ----------
    seen : Measurement
    centre : (3,) [m] centre of rotation; shift and turn are least correlated if it is in the middle of the points.
    """

    def __init__(self, seen: Measurement, centre: NDArray) -> None:
        self.sensor, self.time, self.settled = seen.sensor, seen.time, seen.settled
        self.seen, self.centre = seen, centre

    def match(self, scene: Scene, reach: float) -> Matched:
        """Correspondences of the sensor itself, up to a distance [m]."""
        there, _ = self.scene(scene)
        return DisplacedMatched(self, matched_by(self.seen, there, reach))

    def scene(self, scene: Scene) -> tuple[Scene, NDArray]:
        """The scene in the sensor's frame at the time of the measurement, and (4, 4) x_world = T x_sensor."""
        values = scene.values.get(self.sensor, {})
        now = scene.at_time(self.time + values.get(CLOCK, 0.0))
        T = displacement(values, self.centre)
        state = BodyState(se3.inverse(T) @ now.state.T_world_root, now.state.angles)
        return now.at(state, time=self.time, velocity=None, measurements=()), T

    def compact(self) -> Measurement:
        """Without whole images."""
        return Displaced(self.seen.compact(), self.centre)


@dataclass(frozen=True, eq=False)
class DisplacedMatched(Matched):
    """Correspondences of a displaced sensor.

    Parameters
    ----------
    measurement : Displaced
    matched : Matched, of the sensor itself
    """

    measurement: Displaced
    matched: Matched

    of_points = property(attrgetter("matched.of_points"))  # type: ignore[assignment]
    shows_surface = property(attrgetter("matched.shows_surface"))  # type: ignore[assignment]
    channels = property(attrgetter("matched.channels"))
    turns = property(attrgetter("matched.turns"))  # type: ignore[assignment]
    key = property(attrgetter("matched.key"))

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """The sensor's rows, in the world."""
        there, T = self.measurement.scene(scene)
        return [_moved(rows, T) for rows in rows_at(self.matched, there)]

    def squares(self, scene: Scene) -> NDArray:
        """(M,) in variances, as of the sensor."""
        return self.matched.squares(self.measurement.scene(scene)[0])

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """As of the sensor."""
        return leftovers_at(self.matched, self.measurement.scene(scene)[0])

    def evidence(self, scene: Scene) -> Evidence:
        """As of the sensor."""
        return self.matched.evidence(self.measurement.scene(scene)[0])


def _moved(rows: AnyRows, T: NDArray) -> AnyRows:
    """Rows on a body in the sensor's frame, transformed to the world."""
    R = T[:3, :3]
    if isinstance(rows, Rows):
        data = np.array(rows.data)
        data[:3], data[3:6] = R @ rows.data[:3] + T[:3, 3:], R @ rows.data[3:6]
        return Rows(data, rows.segment, rows.group, rows.loss)
    if isinstance(rows, DofRows):  # columns of the root are its twist about its own origin
        J = np.array(rows.jacobian)
        J[:, :3], J[:, 3:6] = rows.jacobian[:, :3] @ R.T, rows.jacobian[:, 3:6] @ R.T
        return replace(rows, by_dof=J)
    return rows
