"""Read tables of tracked points: body-worn trackers, and the paths of `kinefit surface`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from kinefit._files import rate_of, read_table, repeated
from kinefit.errors import FileError, ObservationError, choices
from kinefit.geometry import se3
from kinefit.observations import BodyTrackerVideo, SurfacePointVideo

_POSITION_COLUMNS = ("time_s", "x", "y", "z")
_QUATERNION_COLUMNS = ("qw", "qx", "qy", "qz")
_REMEDY = "Give a table with the columns time_s, tracker, x, y, z [s, m] and, for orientations, qw, qx, qy, qz."
_MAX_NORM_ERROR = 0.5  # of a unit quaternion; rounding changes it by much less


def read_body_trackers(
    path: Path, names: Iterable[str], sensor: str = "trackers", *, time_offset: float = 0.0,
    T_world_file: ArrayLike | None = None,
) -> BodyTrackerVideo:  # fmt: skip
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
    return BodyTrackerVideo(sensor, rate, times + time_offset, names, x, R, source=str(path))


_SURFACE_COLUMNS = ("time_s", "point", "x", "y", "z", "std_x", "std_y", "std_z")
_SURFACE_REMEDY = f"Give trajectories.csv of `kinefit surface`, or a table with {', '.join(_SURFACE_COLUMNS)}."


def read_surface_points(path: Path, sensor: str = "surface_points", *, time_offset: float = 0.0) -> SurfacePointVideo:
    """Points of a table with the columns time_s, point, x, y, z, std_x, std_y, std_z [s, m]; others are not read.

    Raises
    ------
    FileError
        No such table, other columns, or a number that is none, with its line.
    ObservationError
        No points, or a single time, of which no rate follows.
    """
    values = read_table(path, _SURFACE_COLUMNS, _SURFACE_REMEDY)[1]
    bad = ~(np.isfinite(values).all(axis=1) & (values[:, 5:] > 0).all(axis=1) & (np.abs(values[:, 1]) < 2**53))
    if bad.any():
        problem = "a number that is not finite, or a standard deviation that is not positive"
        raise FileError(problem, file=path, place=f"line {int(np.argmax(bad)) + 2}", remedy="Remove the row.")
    times, frame = np.unique(values[:, 0], return_inverse=True)
    rate = rate_of(times, path, _SURFACE_REMEDY)
    order = np.argsort(frame, kind="stable")
    values, first = values[order], np.searchsorted(frame[order], np.arange(len(times) + 1))
    return SurfacePointVideo(
        sensor, rate, times + time_offset, first, values[:, 1].astype(np.int64), values[:, 2:5], values[:, 5:],
        source=str(path),
    )  # fmt: skip
