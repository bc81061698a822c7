"""Tables: a motion as CSV or Parquet files, one for each kind of result.

    angles      one row a frame: every coordinate [deg] (sliding ones [m]) with its standard deviation; the root as
                place [m] and unit quaternion in the world, its deviations along [m] and about [deg] the world's axes
    joints      joint centres [m] with standard deviations along the world's axes
    landmarks   landmarks [m]
    quality     of the frame and of every segment, 0..1
    residuals   long form, one row a sensor, frame and point that was seen: measured, measured minus fitted, weight

Every table starts with `frame` (from 0) and `time [s]`; the world is the motion's own. A deviation "inf" means that
nothing observed it.
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
from kinefit.exporters._atomic import writing
from kinefit.exporters._skeleton import continuous_quaternions
from kinefit.motion import Motion, Residuals

Table = dict[str, NDArray]  # column -> (rows,)


def write_csv(motion: Motion, folder: str | PathLike[str]) -> tuple[Path, ...]:
    """Write angles.csv, joints.csv, landmarks.csv, quality.csv and residuals.csv; all of them or none.

    Returns
    -------
    The files written.

    Raises
    ------
    ExportError
        A file cannot be written.
    """
    return _write(motion, Path(folder), ".csv", _to_csv)


def write_parquet(motion: Motion, folder: str | PathLike[str]) -> tuple[Path, ...]:
    """Write the same tables as Parquet; name, rate [Hz] and vertical axis of the take stand in each file's metadata.

    Raises
    ------
    ExportError
        The extra "parquet" is not installed, or a file cannot be written.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ExportError(
            "Parquet needs the package pyarrow", file=folder, remedy="Install it: pip install 'kinefit[parquet]'."
        ) from error
    about = {"name": motion.name, "rate [Hz]": repr(float(motion.rate)), "up": motion.up}

    def to_parquet(table: Table, file: Path) -> None:
        content = pyarrow.table({name: pyarrow.array(column) for name, column in table.items()})
        pyarrow.parquet.write_table(content.replace_schema_metadata(about), file)

    return _write(motion, Path(folder), ".parquet", to_parquet)


def tables(motion: Motion) -> dict[str, Table]:
    """The tables by name, each column -> (rows,), in the units that the column's name tells."""
    body = motion.body
    start = {"frame": np.arange(len(motion)), "time [s]": motion.times}
    joints, stds = _xyz(body.joints, motion.segment_poses()[..., :3, 3]), _xyz(body.joints, motion.joint_std, " std")
    quality = {name: motion.segment_quality[:, s] for s, name in enumerate(body.tree.segments)}
    return {
        "angles": start | _angles(motion),
        "joints": start | joints | stds,
        "landmarks": start | _xyz(body.landmarks.names, motion.positions()),
        "quality": start | {"quality": motion.quality} | quality,
        "residuals": _long([_residuals(motion, sensor, r) for sensor, r in motion.residuals.items()]),
    }


def _angles(motion: Motion) -> Table:
    body = motion.body
    units = ["m"] * 3 + ["deg"] * 3 + ["m" if slides else "deg" for slides in body.tree.prismatic]
    stds = motion.dof_std * [1.0 if unit == "m" else np.degrees(1.0) for unit in units]
    angles = np.where(body.tree.prismatic, motion.angles, np.degrees(motion.angles))
    quaternions = continuous_quaternions(motion.Ts_world_root[:, :3, :3])
    out = {f"root_t{axis} [m]": motion.Ts_world_root[:, i, 3] for i, axis in enumerate("xyz")}
    out |= {f"root_q{part}": quaternions[:, i] for i, part in enumerate("wxyz")}
    out |= {f"{name} [{unit}]": angles[:, d] for d, (name, unit) in enumerate(zip(body.tree.coordinates, units[6:]))}
    return out | {f"{name} std [{unit}]": stds[:, d] for d, (name, unit) in enumerate(zip(body.dof_names, units))}


def _xyz(names: tuple[str, ...], positions: NDArray, suffix: str = "") -> Table:
    return {f"{n} {axis}{suffix} [m]": positions[:, k, i] for k, n in enumerate(names) for i, axis in enumerate("xyz")}


def _residuals(motion: Motion, sensor: str, r: Residuals) -> Table:
    frames, points = np.nonzero(np.isfinite(r.norms))
    segments = np.array([motion.body.tree.segments[s] for s in r.segments], dtype=np.str_)
    pixels = r.unit == "px"
    out: Table = {
        "frame": frames,
        "time [s]": motion.times[frames],
        "sensor": np.full(len(frames), sensor),
        "point": np.array(r.names, dtype=np.str_)[points],
        "segment": segments[points],
        "unit": np.full(len(frames), r.unit),
    }
    for i, axis in enumerate(("u", "v") if pixels else ("x", "y", "z")):
        out[f"measured {axis} [{r.unit}]"] = r.measured[frames, points, i]
        out[f"residual {axis} [{r.unit}]"] = r.values[frames, points, i]
    return out | {
        "residual": r.norms[frames, points],
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


def _write(motion: Motion, folder: Path, suffix: str, write: Callable[[Table, Path], Any]) -> tuple[Path, ...]:
    files = []
    with ExitStack() as stack:  # every file takes its place only when all are complete
        for name, table in tables(motion).items():
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
