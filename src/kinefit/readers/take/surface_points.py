"""Tracked surfaces: `[[surface_points]]`, the paths that `kinefit surface` writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinefit._files import rate_of, read_table
from kinefit.errors import FileError
from kinefit.observations import SurfacePointVideo

_COLUMNS = ("time_s", "point", "x", "y", "z", "std_x", "std_y", "std_z")
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
    values = read_table(path, _COLUMNS, _REMEDY)[1]
    bad = ~(np.isfinite(values).all(axis=1) & (values[:, 5:] > 0).all(axis=1) & (np.abs(values[:, 1]) < 2**53))
    if bad.any():
        problem = "a number that is not finite, or a standard deviation that is not positive"
        raise FileError(problem, file=path, place=f"line {int(np.argmax(bad)) + 2}", remedy="Remove the row.")
    times, frame = np.unique(values[:, 0], return_inverse=True)
    rate = rate_of(times, path, _REMEDY)
    order = np.argsort(frame, kind="stable")
    values, first = values[order], np.searchsorted(frame[order], np.arange(len(times) + 1))
    return SurfacePointVideo(
        sensor, rate, times + time_offset, first, values[:, 1].astype(np.int64), values[:, 2:5], values[:, 5:],
        source=str(path),
    )  # fmt: skip
