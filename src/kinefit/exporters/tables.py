"""Tables: a motion as CSV or Parquet files, one for each kind of result.

    angles      one row a frame: every coordinate [deg] (sliding ones [m]) with its standard deviation; the root as
                place [m] and unit quaternion in the world, its deviations along [m] and about [deg] the world's axes
    joints      joint centres and centre of mass (com) [m] with standard deviations along the world's axes
    landmarks   landmarks [m]
    quality     of the frame and of every segment, 0..1
    residuals   long form, one row a sensor, frame and point that was seen: measured, measured minus fitted, weight; of
                depth, clouds and silhouettes one a segment: signed median, RMS and number of its residuals

Every table starts with `frame` (from 0) and `time [s]`; metres and the motion's own world by default. A
deviation "inf" means that nothing observed it.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import writing
from kinefit.bodies import motion as motions
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError, extra
from kinefit.exporters.opensim import root_coordinates
from kinefit.exporters.skeletons.common import UNITS, bone_names, euler_zxy, length_factor, turned


@dataclass(frozen=True, eq=False)
class Curve:
    """One coordinate over time, as OpenSim calls it: values and standard deviations (F,) in `unit`.

    `speed_std` is that of its rate of change [unit/s], NaN where the motion does not tell it. `slopes` (F, k) are the
    changes of the value by those of k `coordinates`, numbered as in `Motion.dof_std` [unit/rad, unit/m].
    """

    name: str
    joint: str
    side: str  # "left", "right" or ""
    unit: str
    values: NDArray
    std: NDArray
    speed_std: float
    coordinates: tuple[int, ...]
    slopes: NDArray

    @property
    def stem(self) -> str:
        """Name without the side."""
        return self.name[:-2] if self.side else self.name


def curves(motion: Motion) -> list[Curve]:
    """All coordinates: the root's as OpenSim's ground_pelvis joint has them, y up, then the angles; without jumps."""
    tree, y_up = motion.body.tree, motion.turned("y")
    names, speeds = root_coordinates(motion.body), _speeds(motion)
    turns, turns_std, slopes = _root_turns(y_up)
    R, ones, out = motions.rotation_between_up(motion.up, "y"), np.ones((len(motion), 1)), []
    by_radians = np.degrees(ones)
    if tree.root_free:
        columns = [*turns.T, *y_up.Ts_world_root[:, :3, 3].T]
        stds = [*turns_std.T, *y_up.dof_std[:, :3].T]
        units = ["deg"] * 3 + ["m"] * 3
        turning = float(np.degrees(speeds[3:6].max()))
        fast = [turning] * 3 + [float(speeds[:3].max())] * 3
        moved = [(3, 4, 5)] * 3 + [(0, 1, 2)] * 3
        by = [*(slopes @ R).swapaxes(0, 1), *(ones * row for row in R)]
        out = [Curve(n, "pelvis", "", *of) for n, *of in zip(names, units, columns, stds, fast, moved, by)]
    for d, name in enumerate(tree.coordinates):
        slides = bool(tree.prismatic[d])
        values, std, speed = motion.angles[:, d], motion.dof_std[:, 6 + d], float(speeds[6 + d])
        if not slides:
            values, std, speed = np.degrees(np.unwrap(values)), np.degrees(std), float(np.degrees(speed))
        joint, _ = split_side(motion.body.joints[tree.owners[d]])
        unit, by_own = ("m", ones) if slides else ("deg", by_radians)
        out.append(Curve(name, joint, split_side(name)[1], unit, values, std, speed, (6 + d,), by_own))
    return out


def _speeds(motion: Motion) -> NDArray:
    """(6 + D,) [m/s, rad/s] standard deviations of rates of change, as smoothing reports them; NaN without."""
    smoothing = motion.provenance.get("smoothing")
    speed_std = smoothing.get("speed_std") if isinstance(smoothing, Mapping) else None
    speed_std = speed_std if isinstance(speed_std, Mapping) else {}
    return np.array([float(speed_std.get(name, np.nan)) for name in motion.body.dof_names])


def split_side(name: str) -> tuple[str, str]:
    """A name without its side, and "left", "right" or "": hand_l becomes ("hand", "left")."""
    side = {"_l": "left", "_r": "right"}.get(name[-2:], "")
    return (name[:-2] if side else name), side


def _root_turns(y_up: Motion) -> tuple[NDArray, NDArray, NDArray]:
    """Tilt, list and rotation (F, 3) [deg], their standard deviations, and slopes (F, 3, 3) [deg/rad] by world turns.

    R = Rz Rx Ry, so ω = z ż + Rz x ẋ + Rz Rx y ẏ; the standard deviations take the three errors as independent.
    """
    angles = euler_zxy(y_up.Ts_world_root[:, :3, :3])
    if not len(angles):
        return angles, angles, np.zeros((0, 3, 3))
    c, s = np.cos(angles), np.sin(angles)
    J = np.zeros((len(angles), 3, 3))
    J[:, 2, 0] = 1
    J[:, 0, 1], J[:, 1, 1] = c[:, 0], s[:, 0]
    J[:, 0, 2], J[:, 1, 2], J[:, 2, 2] = -s[:, 0] * c[:, 1], c[:, 0] * c[:, 1], s[:, 1]
    known = np.isfinite(y_up.dof_std[:, 3:6]).all(axis=1) & (np.abs(c[:, 1]) > 1e-3)
    std, slopes = np.full((len(angles), 3), np.inf), np.zeros(J.shape)
    slopes[known] = np.degrees(np.linalg.inv(J[known]))
    std[known] = np.sqrt((slopes[known] ** 2 @ y_up.dof_std[known, 3:6, None] ** 2)[..., 0])
    return np.degrees(np.unwrap(angles, axis=0)), std, slopes


DIGITS = {"thumb": "Thumb"} | {digit: f"{digit.capitalize()} finger" for digit in ("index", "middle", "ring", "little")}
"""Digits of a hand, as coordinates and segments begin, in words."""

FINGER_JOINTS = ("cmc", "mcp", "pip", "dip", "ip")
_FINGER_MOVES = {"flex": "flexion", "abd": "abduction", "dev": "ulnar deviation"}

NAMES = {
    "hip_flexion": "Hip flexion", "hip_adduction": "Hip adduction", "hip_rotation": "Hip inward rotation",
    "knee_angle": "Knee flexion", "ankle_angle": "Ankle dorsiflexion", "subtalar_angle": "Subtalar inversion",
    "mtp_angle": "Toe extension", "clav_prot": "Shoulder girdle protraction", "clav_elev": "Shoulder girdle elevation",
    "arm_flex": "Shoulder flexion", "arm_add": "Shoulder adduction", "arm_rot": "Shoulder inward rotation",
    "elbow_flex": "Elbow flexion", "pro_sup": "Forearm pronation", "wrist_flex": "Wrist flexion",
    "wrist_dev": "Wrist ulnar deviation", "pelvis_tilt": "Pelvic tilt (backward)",
    "pelvis_list": "Pelvic obliquity (right down)", "pelvis_rotation": "Pelvic rotation (to the left)",
    "lumbar_extension": "Lumbar extension", "lumbar_bending": "Lumbar bending (to the right)",
    "lumbar_rotation": "Lumbar rotation (to the left)", "thorax_extension": "Thoracic extension",
    "thorax_bending": "Thoracic bending (to the right)", "thorax_rotation": "Thoracic rotation (to the left)",
    "neck_extension": "Neck extension", "neck_bending": "Neck bending (to the right)",
    "neck_rotation": "Neck rotation (to the left)",
    **{f"{digit}_{joint}_{move}": f"{digit.capitalize()} {joint.upper()} {of}"
       for digit in DIGITS for joint in FINGER_JOINTS for move, of in _FINGER_MOVES.items()},
}  # fmt: skip
"""Clinical names of OpenSim's coordinates, in the direction that counts as positive."""


def spoken(coordinate: str) -> str:
    """Clinical name of a coordinate, with its side in words: hip_flexion_l becomes "left hip flexion"."""
    stem, side = split_side(coordinate)
    name = NAMES.get(stem, stem.replace("_", " "))
    return f"{side} {name[0].lower()}{name[1:]}".strip()


Table = dict[str, NDArray]  # column -> (rows,)

_ROWS, _FRAMES = 2000, 200  # of a piece that is written at once; the latter of the long form, some 100 rows each


@checked
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
    return _write(_in_pieces(motion, unit, up, names), Path(folder), ".csv", to_csv)


@checked
def write_parquet(
    motion: Motion, folder: str | PathLike[str], *, unit: str = "m", up: str | None = None, names: str | None = None
) -> tuple[Path, ...]:
    """Write the same tables as Parquet; name, rate [Hz] and vertical axis stand in each file's metadata.

    Raises
    ------
    ExportError
        The extra "parquet" is not installed; and as `write_csv`.
    """
    about = {"name": motion.name, "rate [Hz]": repr(float(motion.rate)), "up": up or motion.up}
    return _write(_in_pieces(motion, unit, up, names), Path(folder), ".parquet", parquet_writer(folder, about))


def parquet_writer(folder: str | PathLike[str], about: dict[str, str]) -> Callable[[Iterable[Table], Path], None]:
    """A function (pieces of a table, file) that writes Parquet, with `about` in the metadata; `folder` for messages.

    Raises
    ------
    ExportError
        The extra "parquet" is not installed.
    """
    with extra("parquet", "Parquet needs the package pyarrow", ExportError, file=folder):
        import pyarrow
        import pyarrow.parquet

    def to_parquet(pieces: Iterable[Table], file: Path) -> None:
        with ExitStack() as stack:
            writer = None
            for table in pieces:
                content = pyarrow.table({name: pyarrow.array(column) for name, column in table.items()})
                content = content.replace_schema_metadata(about)
                if writer is None:
                    writer = stack.enter_context(pyarrow.parquet.ParquetWriter(file, content.schema))
                writer.write_table(content)

    return to_parquet


@checked
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
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal", optional
        Joints and segments under these names (a joint bears its segment's); default: the body's own for both.

    Raises
    ------
    ExportError
        Unknown unit, axis or names.
    """
    whole = {name: list(pieces) for name, pieces in _in_pieces(motion, unit, up, names).items()}
    return {
        name: {column: np.concatenate([piece[column] for piece in pieces]) for column in pieces[0]}
        for name, pieces in whole.items()
    }


def _in_pieces(motion: Motion, unit: str, up: str | None, names: str | None) -> dict[str, Iterator[Table]]:
    """The tables by name, each as one after the other of pieces of its rows, made when they are asked for."""
    place = f"tables of {motion.name}"
    factor, motion, body = length_factor(unit, UNITS, place), turned(motion, up or motion.up, place), motion.body
    segments = bone_names(body, names or "kinefit", place)
    bones = tuple(segments) if names else body.joints
    start = {"frame": np.arange(len(motion)), "time [s]": motion.times}
    stretches = [slice(row, row + _ROWS) for row in range(0, max(len(motion), 1), _ROWS)]

    turns = motions.continuous_quaternions(motion.Ts_world_root[:, :3, :3])  # their signs go on from part to part
    quaternions = {f"root_q{part}": turns[:, i] for i, part in enumerate("wxyz")}

    def angles() -> Iterator[Table]:
        for some, piece in zip(stretches, of_parts(lambda part: motions.angle_columns(part, factor, unit))):
            yield piece | {name: column[some] for name, column in quaternions.items()}

    def of_parts(columns: Callable[[Motion], Table]) -> Iterator[Table]:
        for some, part in zip(stretches, motion.parts(_ROWS)):
            yield {name: column[some] for name, column in start.items()} | columns(part)

    def landmarks(part: Motion) -> Table:
        return motions.place_columns(body.landmarks.names, factor * part.positions(), unit)

    def quality(part: Motion) -> Table:
        return {"quality": part.quality, **{name: part.segment_quality[:, s] for s, name in enumerate(segments)}}

    residuals = _long(lambda sensor, frames: _residuals(motion, sensor, frames, factor, unit, segments), motion)
    return {
        "angles": angles(), "joints": of_parts(lambda part: motions.joint_columns(part, bones, factor, unit)),
        "landmarks": of_parts(landmarks), "quality": of_parts(quality), "residuals": residuals,
    }  # fmt: skip


def _residuals(
    motion: Motion, sensor: str, some: slice, factor: float, unit: str, bones: list[str]
) -> Table:
    r = motion.residuals[sensor]
    norms = np.linalg.norm(r.values[some], axis=-1)
    frames, points = np.nonzero(np.isfinite(norms))
    frames += some.start
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
        "residual": factor * norms[frames - some.start, points],
        "weight": np.asarray(r.weights, float)[frames, points],
        "left_right_swapped": np.asarray(r.swapped, bool)[frames],
    }


def _long(of: Callable[[str, slice], Table], motion: Motion) -> Iterator[Table]:
    """The sensors' tables one below the other; a column that one of them lacks is NaN there."""
    columns = dict.fromkeys(name for sensor in motion.residuals for name in of(sensor, slice(0, 0)))
    if not motion.residuals:
        yield {name: np.zeros(0) for name in ("frame", "time [s]", "sensor", "point", "residual", "weight")}
    for sensor in motion.residuals:
        for start in range(0, max(len(motion), 1), _FRAMES):
            part = of(sensor, slice(start, start + _FRAMES))
            yield {name: part.get(name, np.full(len(part["frame"]), np.nan)) for name in columns}


def _write(
    content: Mapping[str, Iterator[Table]], folder: Path, suffix: str, write: Callable[[Iterator[Table], Path], Any]
) -> tuple[Path, ...]:
    files = []
    with ExitStack() as stack:  # every file takes its place only when all are complete
        for name, pieces in content.items():
            files.append(folder / f"{name}{suffix}")
            write(pieces, stack.enter_context(writing(files[-1])))
    return tuple(files)


def quantity_table(rows: Sequence[Any], names: Iterable[str], quantities: Iterable[str]) -> Table:
    """Columns of attributes, texts or times [s], and of `values` {quantity [unit]: (value, standard deviation)}."""
    each = {name: [getattr(row, name) for row in rows] for name in names}
    out: Table = {f"{n} [s]" if n in ("start", "stop") else n: np.array(of) for n, of in each.items()}
    for name in quantities:
        stem, unit = name.split(" [")
        values, stds = np.array([row.values.get(name, (np.nan, np.nan)) for row in rows]).T
        out |= {name: values, f"{stem} std [{unit}": stds}
    return out


def to_csv(pieces: Iterable[Table], file: Path) -> None:
    """Write pieces of a table, (rows,) of each column, as CSV."""
    with open(file, "w", encoding="utf-8", newline="\n") as out:
        rows = csv.writer(out, lineterminator="\n")
        for number, table in enumerate(pieces):
            rows.writerows([] if number else [table])
            rows.writerows(zip(*map(_cells, table.values())))


def _cells(column: NDArray) -> list[str]:
    if column.dtype.kind == "f":
        return ["" if v != v else f"{v:.9g}" for v in column.tolist()]
    if column.dtype.kind == "b":
        return ["true" if v else "false" for v in column.tolist()]
    return list(map(str, column.tolist()))
