"""A sensor whose frame is not quite the world's: its measurements, compared with the body where that frame has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import BodyState
from kinefit.geometry import se3
from kinefit.rows import AnyRows, DofRows, Rows
from kinefit.sensors.base import Leftover, Matched, Measurement, leftovers_at, matched_by, rows_at
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.scene import Scene

AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
"""Names of the six values of a displacement: shift [m] of its centre, then the rotation vector [rad]."""

CLOCK = "clock"
"""Name of the value [s] that is added to the sensor's times."""


def displacement(values: Mapping[str, float], centre: ArrayLike) -> NDArray:
    """(4, 4) x_world = T x as the sensor's frame has it; turned about `centre` (3,) [m], which is shifted."""
    c = np.asarray(centre, float)
    twist = np.array([values.get(axis, 0.0) for axis in AXES])
    R = se3.exp_so3(twist[3:])
    return se3.transform(R, c + twist[:3] - R @ c)


class Displaced(Measurement):
    """What a sensor saw, in a frame that a subject fit moves against the world.

    The body moves the other way instead of the sensor: so any sensor that has its place in the world is displaced
    without knowing of it. The scene's values of the sensor are those of `AXES` and `CLOCK`.

    Parameters
    ----------
    seen : Measurement
    centre : (3,) [m] about which its frame is turned; in the middle of what was seen, shift and turn vary apart.
    """

    def __init__(self, seen: Measurement, centre: NDArray) -> None:
        self.sensor, self.time, self.settled = seen.sensor, seen.time, seen.settled
        self.seen, self.centre = seen, centre

    def match(self, scene: Scene, reach: float) -> Matched:
        """As the sensor itself matches."""
        there, _ = self.scene(scene)
        return DisplacedMatched(self, matched_by(self.seen, there, reach))

    def scene(self, scene: Scene) -> tuple[Scene, NDArray]:
        """The scene as the sensor's frame has it, at the time of the measurement, and x_world = T x (4, 4)."""
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

    @property
    def sensor(self) -> str:  # type: ignore[override]
        """Name of the sensor."""
        return self.measurement.sensor

    @property
    def of_points(self) -> bool:  # type: ignore[override]
        """As of the sensor."""
        return self.matched.of_points

    @property
    def shows_surface(self) -> bool:  # type: ignore[override]
        """As of the sensor."""
        return self.matched.shows_surface

    @property
    def channels(self) -> Sequence[str] | None:
        """As of the sensor."""
        return self.matched.channels

    @property
    def turns(self) -> Mapping[int, NDArray]:  # type: ignore[override]
        """As of the sensor, in the frames of the segments."""
        return self.matched.turns

    @property
    def key(self) -> bytes:
        """As of the sensor."""
        return self.matched.key

    def rows(self, scene: Scene) -> Sequence[AnyRows]:
        """The sensor's rows, in the world."""
        there, T = self.measurement.scene(scene)
        return [_moved(rows, T) for rows in rows_at(self.matched, there)]

    def squares(self, scene: Scene) -> NDArray:
        """As of the sensor."""
        return self.matched.squares(self.measurement.scene(scene)[0])

    def leftovers(self, scene: Scene) -> list[Leftover]:
        """As of the sensor."""
        return leftovers_at(self.matched, self.measurement.scene(scene)[0])

    def evidence(self, scene: Scene) -> Evidence:
        """As of the sensor."""
        return self.matched.evidence(self.measurement.scene(scene)[0])


def _moved(rows: AnyRows, T: NDArray) -> AnyRows:
    """Rows of a body in the sensor's frame as those of the body in the world: each turns with what it is about."""
    R = T[:3, :3]
    if isinstance(rows, Rows):
        data = np.array(rows.data)
        data[:3], data[3:6] = R @ rows.data[:3] + T[:3, 3:], R @ rows.data[3:6]
        return Rows(data, rows.segment, rows.group, rows.loss)
    if isinstance(rows, DofRows):  # columns of the root are its twist about its own origin
        J = np.array(rows.jacobian)
        J[:, :3], J[:, 3:6] = rows.jacobian[:, :3] @ R.T, rows.jacobian[:, 3:6] @ R.T
        return replace(rows, jacobian=J)
    return rows
