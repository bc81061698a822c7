"""`[[tracker]]`: trackers fixed on the body, such as magnetic ones: poses of segments, or places of points."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec import field

from kinefit.bodies import Body
from kinefit.observations import BodyTrackerVideo
from kinefit.readers.take.entries import PlacedEntry
from kinefit.readers.take.kinds import SensorKind
from kinefit.readers.tracked_points import read_body_trackers
from kinefit.sensors.points.body_trackers import BodyTrackerSensor


class TrackerEntry(PlacedEntry, frozen=True, kw_only=True):
    """`[[tracker]]`."""

    points: dict[str, str]  # of each tracker of the file: landmark of the body, or segment, whose origin it then is
    mounts: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # [deg] rotation vector, from a
    # tracker's axes to its segment's
    rotation_sigma: float = 2.0  # [deg] standard deviation of an orientation
    mount_sigma: float = 0.0  # [deg] standard deviation of the mounts, which are then estimated; default: exact


def _read(entry: TrackerEntry, name: str, _: Any) -> BodyTrackerVideo:
    T = entry.T_world_file
    return read_body_trackers(entry.file, entry.points, name, time_offset=entry.time_offset, T_world_file=T)


def _sensor(entry: TrackerEntry, recording: BodyTrackerVideo, body: Body) -> BodyTrackerSensor:
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
