"""`[[surface_points]]`: a surface that was tracked, such as by `kinefit surface`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from kinefit.bodies import Body
from kinefit.observations import SurfacePointVideo
from kinefit.readers.take.entries import Metres, Seconds
from kinefit.readers.take.kinds import Proposal, SensorKind, TakeEntry
from kinefit.readers.tracked_points import read_surface_points
from kinefit.sensors.surfaces.surface_points import SurfacePointSensor


class SurfacePointsEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[surface_points]]`."""

    file: Path  # table of time_s, point, x, y, z, std_x, std_y, std_z [s, m]
    time_offset: Seconds = 0.0  # [s]
    sigma: Metres = 0.01  # [m] standard deviation by which the surface slides on the bone, and the body's shape is off


def _read(entry: SurfacePointsEntry, name: str, _: Any) -> SurfacePointVideo:
    return read_surface_points(entry.file, name, time_offset=entry.time_offset)


def _sensor(entry: SurfacePointsEntry, recording: SurfacePointVideo, _: Body) -> SurfacePointSensor:
    return SurfacePointSensor(recording.sensor, slide=entry.sigma)


def _propose(files: Sequence[Path]) -> Iterator[Proposal]:
    reason = "a surface that kinefit surface tracked; it needs a [start] or another sensor"
    for number, file in enumerate(file for file in files if file.name == "trajectories.csv"):
        yield Proposal({"file": file}, reason, used=not number)


KIND = SensorKind(
    table="surface_points", summary="points of a tracked surface, which the sensor finds on the body by itself",
    entry=SurfacePointsEntry, read=_read, sensor=_sensor, propose=_propose, replaces_keypoints=True,
)  # fmt: skip
