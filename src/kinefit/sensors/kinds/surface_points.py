"""`[[surface_points]]`: a surface that was tracked, such as by `kinefit surface`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._files import rate_of, read_table
from kinefit.bodies import Body
from kinefit.errors import FileError
from kinefit.observations import SensorRecording, SurfacePointFrame
from kinefit.readers.take.entries import Metres, Seconds
from kinefit.readers.take.kinds import Proposal, SensorKind, TakeEntry
from kinefit.sensors.surfaces.surface_points import SurfacePointSensor

_COLUMNS = ("time_s", "point", "x", "y", "z", "std_x", "std_y", "std_z")
_REMEDY = f"Give trajectories.csv of `kinefit surface`, or a table with {', '.join(_COLUMNS)}."


class SurfacePointsEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[surface_points]]`."""

    file: Path  # table of time_s, point, x, y, z, std_x, std_y, std_z [s, m]
    time_offset: Seconds = 0.0  # [s]
    sigma: Metres = 0.01  # [m] standard deviation by which the surface slides on the bone, and the body's shape is off


@dataclass(frozen=True, eq=False)
class SurfacePointRecording(SensorRecording):
    """Tracked points of a surface over time.

    Parameters
    ----------
    sensor, rate, times : see `SensorRecording`
    first : (F + 1,) int
        Start of each frame in the columns below, and their length.
    ids : (N,) int, the same for the same point at all times
    x_world : (N, 3) [m]
    std : (N, 3) [m] standard deviations along the world's axes
    source : file, for messages
    """

    first: NDArray
    ids: NDArray
    x_world: NDArray
    std: NDArray
    source: str = ""

    def frame(self, i: int) -> SurfacePointFrame:
        """Frame number `i`; a negative number counts from the end."""
        i, time = self._at(i)
        part = slice(int(self.first[i]), int(self.first[i + 1]))
        covariance = self.std[part, :, None] ** 2 * np.eye(3)
        return SurfacePointFrame(self.sensor, time, self.ids[part], self.x_world[part], covariance)


def read_surface_points(
    path: Path, sensor: str = "surface_points", *, time_offset: float = 0.0
) -> SurfacePointRecording:
    """Points of a table with the columns time_s, point, x, y, z, std_x, std_y, std_z [s, m]; others are not read.

    Raises
    ------
    FileError
        No such table, other columns, or a number that is none, with its line.
    ObservationError
        No points, or a single time, of which no rate follows.
    """
    values = read_table(path, _COLUMNS, _REMEDY)[1]
    bad = ~(np.isfinite(values).all(axis=1) & (values[:, 5:] > 0).all(axis=1) & (np.abs(values[:, 1]) < 2**53))
    if bad.any():
        problem = "a number that is not finite, or a standard deviation that is not positive"
        raise FileError(problem, file=path, place=f"line {int(np.argmax(bad)) + 2}", remedy="Remove the row.")
    times, frame = np.unique(values[:, 0], return_inverse=True)
    rate = rate_of(times, path, _REMEDY)
    order = np.argsort(frame, kind="stable")
    values, first = values[order], np.searchsorted(frame[order], np.arange(len(times) + 1))
    return SurfacePointRecording(
        sensor, rate, times + time_offset, first, values[:, 1].astype(np.int64), values[:, 2:5], values[:, 5:],
        source=str(path),
    )  # fmt: skip


def _read(entry: SurfacePointsEntry, name: str, _: Any) -> SurfacePointRecording:
    return read_surface_points(entry.file, name, time_offset=entry.time_offset)


def _sensor(entry: SurfacePointsEntry, recording: SurfacePointRecording, _: Body) -> SurfacePointSensor:
    return SurfacePointSensor(recording.sensor, slide=entry.sigma)


def _propose(files: Sequence[Path]) -> Iterator[Proposal]:
    reason = "a surface that kinefit surface tracked; it needs a [start] or another sensor"
    for number, file in enumerate(file for file in files if file.name == "trajectories.csv"):
        yield Proposal({"file": file}, reason, used=not number)


KIND = SensorKind(
    table="surface_points", summary="points of a tracked surface, which the sensor finds on the body by itself",
    entry=SurfacePointsEntry, read=_read, sensor=_sensor, propose=_propose, replaces_keypoints=True,
)  # fmt: skip
