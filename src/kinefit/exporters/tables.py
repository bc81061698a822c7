"""Tables: a motion as CSV or Parquet files, one for each kind of result.

    angles      one row a frame: every coordinate [deg] (sliding ones [m]) with its standard deviation; the root as
                place [m] and unit quaternion in the world, its deviations along [m] and about [deg] the world's axes
    joints      joint centres [m] with standard deviations along the world's axes
    landmarks   landmarks [m]
    quality     of the frame and of every segment, 0..1
    residuals   long form, one row a sensor, frame and point that was seen: measured, measured minus fitted, weight; of
                depth, clouds and silhouettes one a segment: signed median, RMS and number of its residuals

Every table starts with `frame` (from 0) and `time [s]`; metres and the motion's own world unless told otherwise. A
deviation "inf" means that nothing observed it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ExportError
from kinefit.exporters.atomic import writing
from kinefit.exporters.skeletons.common import UNITS, bone_names, length_factor, turned
from kinefit.motion import Motion, Residuals
from kinefit.motion_columns import angle_columns, joint_columns, place_columns

Table = dict[str, NDArray]  # column -> (rows,)


def write_csv(
    motion: Motion, folder: str | PathLike[str], *, unit: str = "m", up: str | None = None, names: str | None = None
) -> tuple[Path, ...]:
    """Write angles.csv, joints.csv, landmarks.csv, quality.csv and residuals.csv; all of them or none.

    Parameters
    ----------
    motion : Motion
    folder : path
    unit, up, names : as in `tables`.

    Returns
    -------
    The files written.

    Raises
    ------
    ExportError
        Unknown unit, axis or names, or a file cannot be written.
    """
    return _write(tables(motion, unit=unit, up=up, names=names), Path(folder), ".csv", _to_csv)


def write_parquet(
    motion: Motion, folder: str | PathLike[str], *, unit: str = "m", up: str | None = None, names: str | None = None
) -> tuple[Path, ...]:
    """Write the same tables as Parquet; name, rate [Hz] and vertical axis stand in each file's metadata.

    Raises
    ------
    ExportError
        The extra "parquet" is not installed; and as `write_csv`.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ExportError(
            "Parquet needs the package pyarrow", file=folder, remedy="Install it: pip install 'kinefit[parquet]'."
        ) from error
    about = {"name": motion.name, "rate [Hz]": repr(float(motion.rate)), "up": up or motion.up}

    def to_parquet(table: Table, file: Path) -> None:
        content = pyarrow.table({name: pyarrow.array(column) for name, column in table.items()})
        pyarrow.parquet.write_table(content.replace_schema_metadata(about), file)

    return _write(tables(motion, unit=unit, up=up, names=names), Path(folder), ".parquet", to_parquet)


def tables(
    motion: Motion, *, unit: str = "m", up: str | None = None, names: str | None = None
) -> dict[str, Table]:
    """The tables by name, each column -> (rows,), in the units that the column's name tells.

    Parameters
    ----------
    motion : Motion
    unit : "m", "cm" or "mm"
        Of all lengths.
    up : str, optional
        Vertical axis of the tables' world; default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh", optional
        Joints and segments under these names (a joint bears its segment's); default: the body's own for both.

    Raises
    ------
    ExportError
        Unknown unit, axis or names.
    """
    place = f"tables of {motion.name}"
    factor, motion, body = length_factor(unit, UNITS, place), turned(motion, up or motion.up, place), motion.body
    segments = bone_names(body, names or "kinefit", place)
    bones = tuple(segments) if names else body.joints
    start = {"frame": np.arange(len(motion)), "time [s]": motion.times}
    quality = {name: motion.segment_quality[:, s] for s, name in enumerate(segments)}
    residuals = [_residuals(motion, sensor, r, factor, unit, segments) for sensor, r in motion.residuals.items()]
    return {
        "angles": start | angle_columns(motion, factor, unit),
        "joints": start | joint_columns(motion, bones, factor, unit),
        "landmarks": start | place_columns(body.landmarks.names, factor * motion.positions(), unit),
        "quality": start | {"quality": motion.quality} | quality,
        "residuals": _long(residuals),
    }


def _residuals(
    motion: Motion, sensor: str, r: Residuals, factor: float, unit: str, bones: list[str]
) -> Table:
    frames, points = np.nonzero(np.isfinite(r.norms))
    segments = np.array([bones[s] for s in r.segments], dtype=np.str_)
    pixels = r.unit == "px"
    factor, unit = (1.0, "px") if pixels else (factor, unit)
    out: Table = {
        "frame": frames,
        "time [s]": motion.times[frames],
        "sensor": np.full(len(frames), sensor),
        "point": np.array(r.names, dtype=np.str_)[points],
        "segment": segments[points],
        "unit": np.full(len(frames), unit),
    }
    if r.rms is not None and r.count is not None:  # of a segment's surface
        out[f"residual median [{unit}]"] = factor * r.values[frames, points, 0]
        out[f"residual rms [{unit}]"] = factor * r.rms[frames, points]
        out["count"] = r.count[frames, points]
    for i, axis in enumerate(() if not r.of_points else ("u", "v") if pixels else ("x", "y", "z")):
        out[f"measured {axis} [{unit}]"] = factor * r.measured[frames, points, i]
        out[f"residual {axis} [{unit}]"] = factor * r.values[frames, points, i]
    return out | {
        "residual": factor * r.norms[frames, points],
        "weight": np.asarray(r.weights, float)[frames, points],
        "left_right_swapped": np.asarray(r.swapped, bool)[frames],
    }


def _long(parts: list[Table]) -> Table:
    """One table below the other; a column that one of them lacks is NaN there."""
    columns = dict.fromkeys(name for part in parts for name in part)

    def column(part: Table, name: str) -> NDArray:
        return part.get(name, np.full(len(part["frame"]), np.nan))

    if not parts:
        return {name: np.zeros(0) for name in ("frame", "time [s]", "sensor", "point", "residual", "weight")}
    return {name: np.concatenate([column(part, name) for part in parts]) for name in columns}


def _write(
    content: Mapping[str, Table], folder: Path, suffix: str, write: Callable[[Table, Path], Any]
) -> tuple[Path, ...]:
    files = []
    with ExitStack() as stack:  # every file takes its place only when all are complete
        for name, table in content.items():
            files.append(folder / f"{name}{suffix}")
            write(table, stack.enter_context(writing(files[-1])))
    return tuple(files)


def _to_csv(table: Mapping[str, NDArray], file: Path) -> None:
    columns = [_cells(column) for column in table.values()]
    lines = [",".join(_quoted(name) for name in table), *(",".join(row) for row in zip(*columns))]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _cells(column: NDArray) -> list[str]:
    if column.dtype.kind == "f":
        return ["" if v != v else f"{v:.9g}" for v in column.tolist()]
    if column.dtype.kind == "b":
        return ["true" if v else "false" for v in column.tolist()]
    return [_quoted(str(v)) for v in column.tolist()]


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n\r') else text
