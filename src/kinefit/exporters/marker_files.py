"""Markers as C3D or TRC: labels, gaps, residuals, unit and events as they are; a C3D keeps the rest of its source."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_bytes, write_text
from kinefit.errors import ExportError
from kinefit.exporters.c3d_file import MAX_FRAMES, Value, c3d_bytes, label_groups, screens
from kinefit.exporters.opensim.files import trc_head
from kinefit.exporters.skeletons.common import length_factor
from kinefit.observations import Markers
from kinefit.readers.c3d_file import C3d, read_c3d

UNITS = {"m": 1.0, "dm": 10.0, "cm": 100.0, "mm": 1000.0, "in": 1.0 / 0.0254, "ft": 1.0 / 0.3048}
"""Units of length in a metre."""

_MOST_RESIDUAL = 255  # what a byte counts to
_OURS = ("POINT", "TRIAL", "EVENT")  # groups that are written anew


@checked
def write_markers(
    markers: Markers, path: str | PathLike[str], *, unit: str | None = None, like: str | PathLike[str] | None = None
) -> None:
    """Write markers as C3D or TRC, by the name's ending.

    Reading the file gives the same labels, gaps, unit, rate, clock and events, positions as 32-bit floats (TRC: to
    seven digits), and residuals to 1/255 of the largest (C3D; TRC holds none). C3D counts the clock in whole frames, so
    its first frame is the one at `first_time`, where frame 1 is at 0 s; TRC has that time and `first_frame`.

    Parameters
    ----------
    markers : Markers
    path : .c3d or .trc
    unit : "mm", "cm", "m" ...; default: that of the file which the markers came from.
    like : C3D file, optional
        Its analog channels (force plates, EMG) and all its groups of parameters are kept, in frames that are the same.

    Raises
    ------
    ExportError
        Another ending, no frame, more than the format can hold (C3D: a time before 0), or the file cannot be written.
    FileError
        `like` is damaged.
    """
    path = Path(path)
    unit = unit or (markers.unit if markers.unit in UNITS else "mm")
    factor = length_factor(unit, UNITS, path)
    if not len(markers) or not markers.names or len(markers.names) > MAX_FRAMES:
        problem = f"{len(markers)} frames of {len(markers.names)} markers cannot be written"
        raise ExportError(problem, file=path, remedy="Write at least one frame of at least one marker.")
    if path.suffix.lower() == ".c3d":
        write_bytes(path, _c3d(markers, path, unit, factor, read_c3d(Path(like)) if like else None))
    elif path.suffix.lower() == ".trc":
        write_text(path, _trc(markers, path, unit, factor))
    else:
        raise ExportError("neither .c3d nor .trc", file=path, remedy="Give the file one of these endings.")


def _c3d(markers: Markers, path: Path, unit: str, factor: float, like: C3d | None) -> bytes:
    first = round(markers.first_time * markers.rate) + 1
    if first < 1:
        problem = f"C3D counts no frames before 0 s, the markers begin at {markers.first_time:g} s"
        raise ExportError(problem, file=path, remedy="Write a .trc, or cut the markers to times from 0 on.")
    seen = np.isfinite(markers.positions).all(axis=2)
    residual = np.zeros(seen.shape) if markers.residual is None else np.nan_to_num(markers.residual) * factor
    scale = _residual_unit(residual[seen])
    fourth = np.where(seen, np.clip(np.round(residual / scale), 0, _MOST_RESIDUAL), -1.0)
    groups: dict[str, dict[str, Value]] = {
        "POINT": {
            "UNITS": [unit], **(screens(markers.up) if markers.up else {}),
            **label_groups(markers.names, ["marker"] * len(markers.names)),
        },
        "ANALOG": {"USED": np.array(0, np.uint16), "RATE": np.array(markers.rate, np.float32), "LABELS": []},
    }  # fmt: skip
    if markers.events:
        groups["EVENT"] = _events(markers)
    analog, samples = None, 1
    if like is not None:
        analog, samples = _rows(like, markers, path), like.samples
        for key, value in like.parameters.items():
            group, _, name = key.partition(":")
            if group not in _OURS:
                whole = key == "ANALOG:OFFSET" and isinstance(value, np.ndarray) and np.all(value == np.round(value))
                groups.setdefault(group, {})[name] = value.astype(np.int16) if whole else value  # type: ignore[union-attr]
    points = np.where(seen[..., None], markers.positions * factor, 0.0)
    return c3d_bytes(
        points, fourth, groups, scale=-scale, rate=markers.rate, first=first, analog=analog, samples=samples
    )


def _rows(like: C3d, markers: Markers, path: Path) -> NDArray | None:
    """Analog samples of the markers' frames."""
    start = markers.first_frame - like.first_frame
    if not 0 <= start <= len(like.points) - len(markers):
        raise ExportError(
            f"frames {markers.first_frame} to {markers.first_frame + len(markers) - 1} are not all in the file "
            f"given as `like` ({like.first_frame} to {like.first_frame + len(like.points) - 1})", file=path,
            remedy="Name the file that the markers came from.",
        )  # fmt: skip
    return like.analog[start : start + len(markers)].astype(np.float32) if like.analog.shape[1] else None


def _residual_unit(residual: NDArray) -> float:
    """Unit in which residuals are counted from 0 to 255: the one that they come in where they do, else the finest."""
    steps = np.unique(residual)
    gaps = np.diff(steps, prepend=0.0)
    if not np.any(gaps > 1e-9):
        return 1.0
    smallest = float(gaps[gaps > 1e-9].min())
    counted = steps / smallest
    own = counted[-1] <= _MOST_RESIDUAL + 0.5 and bool(np.all(np.abs(counted - np.round(counted)) < 1e-3))
    return smallest if own else float(steps[-1]) / _MOST_RESIDUAL


def _events(markers: Markers) -> dict[str, Value]:
    times = np.array([[e.time // 60.0, e.time % 60.0] for e in markers.events], np.float32).T
    count = len(markers.events)
    return {
        "USED": np.array(count, np.uint16), "CONTEXTS": [e.context for e in markers.events],
        "LABELS": [e.label for e in markers.events], "SUBJECTS": [e.subject for e in markers.events], "TIMES": times,
        "ICON_IDS": np.zeros(count, np.uint16), "GENERIC_FLAGS": np.zeros(count, np.uint8),
    }  # fmt: skip


def _trc(markers: Markers, path: Path, unit: str, factor: float) -> str:
    names = [n.replace("\t", " ").replace("\n", " ") for n in markers.names]
    first = markers.first_frame
    lines = trc_head(path, names, f"{markers.rate:.10g}", len(markers), unit, first)
    lines[3] += "\t\t"  # as Vicon's programs write it
    seen = np.isfinite(markers.positions).all(axis=2)
    for f, (t, x) in enumerate(zip(markers.times.tolist(), (markers.positions * factor).tolist(), strict=True)):
        cells = [f"{p[0]:.7g}\t{p[1]:.7g}\t{p[2]:.7g}" if ok else "\t\t" for p, ok in zip(x, seen[f], strict=True)]
        end = "" if seen[f, -1] else "NaN"  # OpenSim refuses a row that ends in an empty cell
        lines.append(f"{first + f}\t{t:.9f}\t" + "\t".join(cells) + end)
    return "\n".join(lines) + "\n"
