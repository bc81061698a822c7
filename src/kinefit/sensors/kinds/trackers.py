"""`[[tracker]]`: trackers fixed on the body, such as magnetic ones: poses of segments, or places of points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import field
from numpy.typing import ArrayLike, NDArray

from kinefit._files import rate_of, read_table, repeated
from kinefit.bodies import Body
from kinefit.errors import FileError, ObservationError, choices
from kinefit.geometry import se3
from kinefit.observations import BodyTrackerFrame, SensorRecording
from kinefit.readers.take.entries import PlacedEntry
from kinefit.readers.take.kinds import SensorKind
from kinefit.sensors.points.body_trackers import BodyTrackerSensor

_POSITION_COLUMNS = ("time_s", "x", "y", "z")
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
_REMEDY = "Give a table with the columns time_s, tracker, x, y, z [s, m] and, for orientations, qw, qx, qy, qz."
_MAX_NORM_ERROR = 0.5  # of a unit quaternion; rounding changes it by much less


class TrackerEntry(PlacedEntry, frozen=True, kw_only=True):
    """`[[tracker]]`."""

    points: dict[str, str]  # of each tracker of the file: landmark of the body, or segment, whose origin it then is
    mounts: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # [deg] rotation vector, from a
    # tracker's axes to its segment's
    rotation_sigma: float = 2.0  # [deg] standard deviation of an orientation
    mount_sigma: float = 0.0  # [deg] standard deviation of the mounts, which are then estimated; default: exact


@dataclass(frozen=True, eq=False)
class BodyTrackerRecording(SensorRecording):
    """Trackers on the body over time.

    Parameters
    ----------
    sensor, rate, times : see `SensorRecording`
    names : (K,) of the trackers
    x_world : (F, K, 3) [m]; NaN if missing
    Rs_world_tracker : (F, K, 3, 3); NaN if missing
    source : file, for messages
    """

    names: tuple[str, ...]
    x_world: NDArray
    Rs_world_tracker: NDArray
    source: str = ""

    def frame(self, i: int) -> BodyTrackerFrame:
        """Frame number `i`; a negative number counts from the end."""
        i, time = self._at(i)
        return BodyTrackerFrame(self.sensor, time, self.names, self.x_world[i], self.Rs_world_tracker[i])


def read_body_trackers(
    path: Path, names: Iterable[str], sensor: str = "trackers", *, time_offset: float = 0.0,
    T_world_file: ArrayLike | None = None,
) -> BodyTrackerRecording:  # fmt: skip
    """Read named trackers of a table with the columns time_s, tracker, x, y, z [s, m], and optional qw, qx, qy, qz.

    Parameters
    ----------
    names : of the trackers to read; other rows are skipped
    time_offset : float [s] added to the times
    T_world_file : (4, 4) [m] from the frame of the table to the world; default: they are the same

    Raises
    ------
    FileError
        No such table, other columns, an invalid number or quaternion, a tracker twice at one time.
    ObservationError
        A name that the table lacks; a single time, which gives no rate.
    """
    names, T = tuple(names), np.eye(4) if T_world_file is None else np.asarray(T_world_file, float)
    labels, values = read_table(path, _POSITION_COLUMNS, _REMEDY, text="tracker", optional=_QUATERNION_COLUMNS)
    for name in names:
        if name not in labels:
            remedy = "Correct the name in `points` of this [[tracker]]."
            raise ObservationError(choices("tracker", name, list(dict.fromkeys(labels))), file=path, remedy=remedy)
    turned = np.isfinite(values[:, 4:]).all(axis=1)
    norm = np.linalg.norm(values[:, 4:], axis=1)
    odd = ~np.isnan(values[:, 4:]).all(axis=1) & ~(turned & (np.abs(norm - 1.0) < _MAX_NORM_ERROR))
    for bad, problem in (
        (~np.isfinite(values[:, :4]).all(axis=1), "a number that is not finite"),
        (odd, "qw, qx, qy, qz are not a unit quaternion"),
    ):
        if bad.any():
            place = f"line {int(np.argmax(bad)) + 2}"
            raise FileError(problem, file=path, place=place, remedy="Remove the row, or leave its quaternion empty.")
    keys = [(t, name) for t, name in zip(values[:, 0].tolist(), labels)]
    if twice := repeated(f"{name} at {t:g} s" for t, name in keys):
        raise FileError(f"{twice[0]} has two rows", file=path, remedy="Keep one.")
    times, frame = np.unique(values[:, 0], return_inverse=True)
    x, R = np.full((len(times), len(names), 3), np.nan), np.full((len(times), len(names), 3, 3), np.nan)
    for k, name in enumerate(names):
        own = np.array([label == name for label in labels])
        x[frame[own], k] = se3.apply(T, values[own, 1:4])
        R[frame[own & turned], k] = T[:3, :3] @ se3.rotation_from_quaternion(values[own & turned, 4:])
    rate = rate_of(times, path, _REMEDY)
    return BodyTrackerRecording(sensor, rate, times + time_offset, names, x, R, source=str(path))


def _read(entry: TrackerEntry, name: str, _: Any) -> BodyTrackerRecording:
    T = entry.T_world_file
    return read_body_trackers(entry.file, entry.points, name, time_offset=entry.time_offset, T_world_file=T)


def _sensor(entry: TrackerEntry, recording: BodyTrackerRecording, body: Body) -> BodyTrackerSensor:
    turn, mounts = np.radians(entry.rotation_sigma), {name: np.radians(m) for name, m in entry.mounts.items()}
    sensor = BodyTrackerSensor(
        recording.sensor, entry.points, sigma=entry.sigma, rotation_sigma=float(turn), mounts=mounts,
        mount_sigma=float(np.radians(entry.mount_sigma)),
    )  # fmt: skip
    sensor.places(body, recording.names)
    return sensor


KIND = SensorKind(
    table="tracker", summary="trackers fixed on the body: poses of segments, or places of points", label="trackers",
    entry=TrackerEntry, read=_read, sensor=_sensor, finds_pose=True, replaces_keypoints=True,
)  # fmt: skip
