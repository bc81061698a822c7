"""Tracked surfaces: `[[surface_points]]`, the paths that `kinefit surface` writes."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from kinefit._files import no_column
from kinefit.errors import FileError, ObservationError
from kinefit.observations import SurfacePointVideo
from kinefit.readers.take.file import Take

_COLUMNS = ("time_s", "point", "x", "y", "z", "std_x", "std_y", "std_z")
_FINEST = 1e-6  # [s] from time to time
_REMEDY = f"Give trajectories.csv of `kinefit surface`, or a table with the columns {', '.join(_COLUMNS)}."


def read_surface_points(path: Path, sensor: str = "surface_points", *, time_offset: float = 0.0) -> SurfacePointVideo:
    """Points of a table with the columns time_s, point, x, y, z, std_x, std_y, std_z [s, m]; others are not read.

    Raises
    ------
    FileError
        No such table, other columns, or a number that is none, with its line.
    ObservationError
        No points, or a single time, of which no rate follows.
    """
    rows: list[list[float]] = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = csv.reader(file)
            names = [name.strip() for name in next(table, [])]
            missing = [name for name in _COLUMNS if name not in names]
            if missing:
                raise FileError(no_column(missing, names), file=path, remedy=_REMEDY)
            at = [names.index(name) for name in _COLUMNS]
            for line, row in enumerate(table, 2):
                try:
                    rows.append([float(row[k]) for k in at])
                except (ValueError, IndexError):
                    raise FileError("a number that is none", file=path, place=f"line {line}", remedy=_REMEDY) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"cannot be read: {error}", file=path, remedy=_REMEDY) from None
    values = np.array(rows).reshape(-1, len(_COLUMNS))
    bad = ~(np.isfinite(values).all(axis=1) & (values[:, 5:] > 0).all(axis=1) & (np.abs(values[:, 1]) < 2**53))
    if bad.any():
        problem = "a number that is not finite, or a standard deviation that is not positive"
        raise FileError(problem, file=path, place=f"line {int(np.argmax(bad)) + 2}", remedy="Leave the row out.")
    times, frame = np.unique(values[:, 0], return_inverse=True)
    if len(times) < 2:
        raise ObservationError(f"points of {len(times)} times", file=path, remedy=_REMEDY)
    if not _FINEST < (step := float(np.median(np.diff(times)))) < 1 / _FINEST:
        raise ObservationError(f"times {step:g} s apart", file=path, remedy="Give time_s in seconds.")
    order = np.argsort(frame, kind="stable")
    values, first = values[order], np.searchsorted(frame[order], np.arange(len(times) + 1))
    return SurfacePointVideo(
        sensor, 1.0 / step, times + time_offset, first, values[:, 1].astype(np.int64), values[:, 2:5], values[:, 5:],
        source=str(path),
    )  # fmt: skip


def surface_sensor(take: Take, k: int) -> str:
    """Name of the sensor of the k-th [[surface_points]] of a take."""
    return "surface_points" if len(take.surface_points) == 1 else f"surface_points {k + 1}"


def load_surface_points(take: Take) -> tuple[SurfacePointVideo, ...]:
    """All `[[surface_points]]` of a take, in its order; errors as of `read_surface_points`."""
    return tuple(
        read_surface_points(entry.file, surface_sensor(take, k), time_offset=entry.time_offset)
        for k, entry in enumerate(take.surface_points)
    )
