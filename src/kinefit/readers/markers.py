"""Read marker recordings, C3D and TRC, in metres; other formats by plug-ins."""

from __future__ import annotations

import re
from collections import Counter
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import metres_of, read_bytes
from kinefit.errors import FileError, KinefitError, ObservationError, names_file, shortened
from kinefit.observations import MarkerEvent, Markers
from kinefit.readers.c3d_file import C3d, read_c3d
from kinefit.readers.plates import PlatesRead, read_plates
from kinefit.readers.plugins import MARKERS, FileFormat

_MIN_PIXELS = 200.0  # "metres" that no marker in one plane is away from the origin, and points in images are
_MAX_NEAR_ORIGIN = 0.01  # [m] from the origin, of a person in metres that are read as millimetres
_OF_EVENT: dict[str, tuple[str, type]] = {
    "label": ("LABELS", str), "context": ("CONTEXTS", str), "subject": ("SUBJECTS", str),
    "description": ("DESCRIPTIONS", str), "icon": ("ICON_IDS", int), "flag": ("GENERIC_FLAGS", int),
}  # fmt: skip
_COMPUTED_POINTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS")  # of a C3D: no positions
_STATE = 'State it: --unit mm on the command line, unit="mm" from Python, unit = "mm" in a take.'
_OF_AXIS = re.compile(r"(.+?)[\s_.:(\[-]*([xyz])[)\]]?", re.IGNORECASE)  # a label that is repeated for each axis
_NUMBER = re.compile(r"(?:^|\s)[-+.]?\d")  # at the beginning of a cell
_MAX_JITTER_FRAMES = 0.5  # of a row's time from its frame: beyond, the next frame is nearer
_MAX_RATE_ERROR = 0.02  # of DataRate against the times: beyond, neither is believed
_MAX_MISSING_ROWS = 1000  # and nine for each row that is there: beyond, the times are wrong
_MIN_RATE_ERROR = 1e-4  # of DataRate: below, it is a rounded number (65.05 for 65.0533 Hz)
_TRC_REMEDY = "Expected: PathFileType, names and values of DataRate NumFrames NumMarkers Units, marker names, rows."


@checked
@names_file
def read_markers(path: str | PathLike[str], *, unit: str | None = None) -> Markers:
    """Read a C3D or TRC file, or one of a plug-in's format; its content decides which.

    Parameters
    ----------
    path : path
    unit : str, optional
        "m", "cm", "mm", "in" ...: only for files that do not state it, or state a wrong one.

    Returns
    -------
    Markers
        Positions [m] in the file's own world; NaN for a negative residual, an empty cell, or a point exactly at the
        origin. Computed points of a C3D (angles, forces ...) are skipped. Points without a label are called "*1",
        "*2" ...; a repeated label gets the suffix "_2". Events of a C3D are kept.

    Raises
    ------
    FileError
        Missing, damaged or truncated (the message has the number of readable frames), or neither C3D nor TRC.
    ObservationError
        No or unknown unit, two in one file, or pixels; no marker, or none visible in any frame; a rate that
        contradicts the times.
    PluginError
        A plug-in fails.
    """
    name = MARKERS.name_of(path := Path(path))
    if name is None:
        raise FileError("neither C3D nor TRC", remedy="Markers are read from .c3d and .trc files, or by a plug-in.")
    read = MARKERS.get(name).call("read", path, unit=unit, valid=lambda m: isinstance(m, Markers), what="Markers")
    if unit is None and _is_of_image(read):
        problem, remedy = "its points are pixels of an image", 'Name it in [[keypoints]] with format = "sports2d".'
        raise ObservationError(problem, remedy=f"{remedy} Or state the unit of its markers.")
    return _of_one_unit(read)


def _is_c3d(path: Path) -> bool:
    return path.suffix.lower() == ".c3d" or read_bytes(path, 64)[1:2] == b"\x50"


def _is_trc(path: Path) -> bool:
    head = read_bytes(path, 64).lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    return path.suffix.lower() == ".trc" or head.startswith(b"pathfiletype")


def _metres(unit: str | None) -> float:
    if not unit:
        raise ObservationError("the file states no unit", place="units", remedy=_STATE)
    return metres_of(unit, ObservationError, place="units", remedy=_STATE)


def _unique(names: list[str]) -> tuple[str, ...]:
    """Unique names: "*1" ... for empty ones, a suffix for repeated ones."""
    taken: Counter[str] = Counter()
    unique: list[str] = []
    for i, name in enumerate(names):
        base = name = name or f"*{i + 1}"
        while name in taken:
            taken[base] += 1
            name = f"{base}_{taken[base]}"
        taken[name] += 1
        unique.append(name)
    return tuple(unique)


def _unseen(markers: int, frames: int) -> ObservationError:
    problem = f"none of the {markers} markers is visible in any of the {frames} frames"
    remedy = "Export it again with its trajectories, or choose another trial."
    return ObservationError(problem, remedy=remedy)


def _is_of_image(markers: Markers) -> bool:
    """Whether positions in "metres" are pixels, as Sports2D writes them: all in the plane z = 0, and far from 0."""
    x = np.nan_to_num(markers.positions)
    return markers.unit == "m" and not x[..., 2].any() and float(abs(x).max()) > _MIN_PIXELS


def is_in_pixels(path: Path) -> bool:
    """Whether a file is a TRC whose points are pixels of an image."""
    try:
        return path.suffix.lower() == ".trc" and _is_of_image(_read_trc(path, None))
    except KinefitError:
        return False


def _of_one_unit(markers: Markers) -> Markers:
    """The markers; raises ObservationError if three to half of them stay near the origin: these have another unit."""
    away = np.nan_to_num(np.linalg.norm(markers.positions, axis=-1)).max(axis=0)
    near = [name for name, far in zip(markers.names, away, strict=True) if 0 < far < _MAX_NEAR_ORIGIN]
    if 3 <= len(near) <= len(away) // 2 and away.max() > 10 * _MAX_NEAR_ORIGIN:
        listed = ", ".join(near[:4]) + (" ..." if len(near) > 4 else "")
        raise ObservationError(
            f"{len(near)} of {len(away)} markers stay within {1e3 * _MAX_NEAR_ORIGIN:.0f} mm of the origin ({listed}), "
            f"others go {away.max():.3g} m away: two units in one file", remedy="Export all markers in one unit.",
        )
    return markers


def _entries(c3d: C3d, key: str, kind: type = str) -> list[Any]:
    """Texts or numbers of a parameter with its continuations, in the order of the file: LABELS, LABELS2 ..."""
    found: list[Any] = []
    for suffix in ("", *map(str, range(2, 100))):
        values = c3d.parameters.get(key + suffix)
        if values is None:
            break
        found += values.ravel(order="F").tolist() if isinstance(values, np.ndarray) else values
    return [value for value in found if isinstance(value, kind)]


def _read_c3d(path: Path, unit: str | None) -> Markers:
    c3d = read_c3d(path)
    count = c3d.points.shape[1]
    labels = (_entries(c3d, "POINT:LABELS") + [""] * count)[:count]
    computed = {name for kind in _COMPUTED_POINTS for name in _entries(c3d, f"POINT:{kind}")} - {""}
    keep = [i for i, label in enumerate(labels) if label not in computed]
    if not keep:
        raise ObservationError("all points of this file are computed quantities, none is a marker")
    screen = "".join(_entries(c3d, "POINT:Y_SCREEN")[:1]).strip().lower().removeprefix("+")
    unit = unit or next(iter(_entries(c3d, "POINT:UNITS")), None)
    metres = _metres(unit)
    if c3d.missing[:, keep].all():
        raise _unseen(len(keep), len(c3d.points))
    positions = np.where(c3d.missing[..., None], np.nan, c3d.points) * metres
    up = screen if screen in ("x", "y", "z") else None
    try:
        forces = read_plates(c3d, metres, screen if screen.removeprefix("-") in ("x", "y", "z") else None)
    except FileError as error:  # the markers are good all the same
        forces = PlatesRead((), (f"force plates are left out: {error.problem}",))
    return Markers(
        tuple(_unique(labels)[i] for i in keep), c3d.rate, positions[:, keep], residual=c3d.residual[:, keep] * metres,
        up=up, first_frame=c3d.first_frame, source=str(path),
        unit=str(unit).strip().lower(), events=_events(c3d, path.name),
        notes=tuple(f"{path.name}: {note}" for note in (*c3d.notes, *forces.notes)), plates=forces.plates,
    )


def _events(c3d: C3d, source: str) -> tuple[MarkerEvent, ...]:
    """Events of the group EVENT, else of the header, in the order of their times."""
    times, found = _entries(c3d, "EVENT:TIMES", float), list[MarkerEvent]()  # minutes and seconds in turn
    if not times:
        found = [MarkerEvent(label, time, source=source) for label, time in c3d.events]
    else:
        columns = {name: _entries(c3d, f"EVENT:{key}", kind) for name, (key, kind) in _OF_EVENT.items()}
        for k, (minutes, seconds) in enumerate(zip(times[::2], times[1::2])):
            known = {"label": ""} | {name: values[k] for name, values in columns.items() if k < len(values)}
            found.append(MarkerEvent(time=60.0 * minutes + seconds, source=source, **known))
    return tuple(sorted((e for e in found if np.isfinite(e.time)), key=lambda e: e.time))


def _read_trc(path: Path, unit: str | None) -> Markers:
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    lines = text.splitlines()
    if len(lines) < 5 or not lines[0].lstrip().lower().startswith("pathfiletype"):
        raise FileError("not a TRC file", place="line 1", remedy=_TRC_REMEDY)
    header = dict(zip(map(str.lower, lines[1].split()), lines[2].split(), strict=False))
    try:
        rate, stated = float(header["datarate"]), int(float(header["numframes"]))
        count = int(float(header["nummarkers"]))
    except (KeyError, ValueError, OverflowError) as error:
        problem = f"DataRate, NumFrames or NumMarkers is missing or not a number ({error})"
        raise FileError(problem, place="line 3", remedy=_TRC_REMEDY) from error
    if not 0 < rate < np.inf:
        raise FileError(f"rate {rate:g} Hz", place="line 3", remedy="Correct DataRate.")
    if not 0 <= count <= len(text) or stated < 0:  # a cell takes a character at least
        raise FileError(f"{count} markers in {stated} frames", place="line 3", remedy="Correct NumMarkers.")
    names = _trc_names(lines, count)
    metres = _metres(unit or header.get("units"))
    frames, times, rows = _trc_rows(lines, text.endswith(("\n", "\r")), len(names))
    steps, rate, notes = _trc_clock(frames, times, rate)
    if len(steps) and steps[-1] + 1 < stated - 1:  # some writers count one too many
        problem = f"the file is truncated: {len(frames)} of {stated} frames can be read"
        raise FileError(problem, remedy="Copy or export it again; or, if it is complete, correct NumFrames in line 3.")
    if not names or not len(frames):
        problem = f"{len(frames)} frames of {len(names)} markers: nothing in this file"
        raise ObservationError(problem, remedy="Export it again, or choose another trial.")
    positions = np.full((int(steps[-1]) + 1, len(names), 3), np.nan)
    positions[steps] = rows
    missing = ~positions.any(axis=-1) | ~np.isfinite(positions).all(axis=-1)
    if missing.all():
        raise _unseen(len(names), len(frames))
    return Markers(
        _unique(names), rate, np.where(missing[..., None], np.nan, positions * metres), first_frame=int(frames[0]),
        source=str(path), unit=str(unit or header.get("units")).strip().lower(), first_time=float(times[0]),
        notes=tuple(f"{path.name}: {note}" for note in notes),
    )


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("\t")] if "\t" in line else line.split()


def _trc_names(lines: list[str], count: int) -> list[str]:
    """Names of the markers by the columns that they stand above, "" for one without; a name of three axes once."""
    cells = _cells(lines[3])
    filled = [k for k, cell in enumerate(cells) if cell][2:]
    names = [cells[k] for k in filled]
    columns = max(len(_cells(line.rstrip())) for line in lines[4:]) - 2
    if names and len(names) % 3 == 0 and columns <= len(names):  # a name above every column
        of_axes = [(m[1], m[2].lower()) if (m := _OF_AXIS.fullmatch(name)) else (name, "") for name in names]
        bases = [base for base, _ in of_axes[::3]]
        if of_axes == [(base, axis) for base in bases for axis in "xyz"]:
            return bases
        if names == [name for name in names[::3] for _ in range(3)]:
            return names[::3]
    for width in (3, 2, 1) if "\t" in lines[3] else (1,):  # columns from a name to the next
        first = 2 + (filled[0] - 2) % width if filled else 2
        named = {(k - first) // width: cells[k] for k in filled}
        wide = max([count, *(slot + 1 for slot in named)])
        whole = width == 3 or wide == max(named, default=wide - 1) + 1 == count
        if whole and all((k - first) % width == 0 for k in filled):
            return [named.get(slot, "") for slot in range(wide)]
    if len(names) < count:
        raise FileError(
            f"{len(names)} names for {count} markers, and not above their columns", place="line 4",
            remedy="Write each name above the first of its three columns, with tabs between the columns.",
        )  # fmt: skip
    return names


def _trc_clock(numbers: NDArray, times: NDArray, rate: float) -> tuple[NDArray, float, list[str]]:
    """Frame (F,) of each row, from 0; the rate [Hz] of the times; notes on missing rows and contradictions."""
    rows = np.arange(len(times))
    if len(times) < 3:
        return rows, rate, []
    elapsed, jumps, notes = times - times[0], np.diff(numbers), []
    decimals = next((d for d in range(7) if np.allclose(times, np.round(times, d), rtol=0.0, atol=1e-9)), 7)
    rounding = 10.0**-decimals * rate  # [frames]
    limit = max(_MAX_JITTER_FRAMES, rounding)
    numbered = np.concatenate([[0.0], np.cumsum(jumps / np.median(jumps))]) if jumps.min() > 0 else rows
    timed = np.round(elapsed * rate)
    if np.median(np.diff(timed)) != 1 or timed[-1] > 2 * len(times):  # DataRate or a time is wrong
        timed = rows

    def jitter(frames: NDArray, rate: float) -> float:
        """Largest distance [frames] of a row's time from its frame; infinite for frames that cannot be."""
        possible = np.allclose(frames, np.round(frames)) and np.diff(frames).min() > 0
        possible &= frames[-1] < 10 * len(times) + _MAX_MISSING_ROWS
        return float(np.abs(elapsed * rate - frames).max()) if possible else np.inf

    def measured(frames: NDArray) -> float:
        return float(frames[-1]) / max(float(elapsed[-1]), 1e-9)

    trials = [(rows, rate, limit), (numbered, rate, limit), (timed, rate, limit / 2.0)]
    trials += [(f, measured(f), limit) for f in (rows, numbered) if abs(measured(f) / rate - 1.0) < _MAX_RATE_ERROR]
    frames, found = next(((f, r) for f, r, most in trials if jitter(f, r) <= most), (rows, np.nan))
    if np.isnan(found):
        problem = f"DataRate {rate:g} Hz, but the {len(times)} rows go from {times[0]:g} to {times[-1]:g} s"
        raise ObservationError(problem, place="line 3", remedy="Correct DataRate or the times.")
    own = measured(frames)
    if abs(own / rate - 1.0) > _MIN_RATE_ERROR and jitter(frames, rate) > 4.0 * jitter(frames, own) + rounding:
        found = own
    if found != rate:
        notes.append(f"DataRate is {rate:g} Hz, the times of its rows give {found:.6g} Hz: the times count")
    lacking = frames[-1] - rows[-1]
    if lacking or numbered[-1] > rows[-1]:
        after = numbers[np.argmax(np.diff(frames if lacking else numbered) > 1)]
        what = f"{lacking:.0f} frames have no row and are empty" if lacking else "frame numbers jump, times do not"
        notes.append(f"{what}, first after frame {after:.0f}")
    return np.round(frames).astype(int), found, notes


def _trc_rows(lines: list[str], ended: bool, count: int) -> tuple[NDArray, NDArray, NDArray]:
    """Frame numbers (F,), times (F,) [s] and positions (F, M, 3) in the file's unit; NaN where a cell is empty."""
    width = 2 + 3 * count
    rows: list[list[float]] = []
    for number, line in enumerate(lines[4:], start=5):
        if not line.strip() or not (rows or _NUMBER.search(line)):
            continue
        cells = _cells(line)
        while len(cells) > width and not cells[-1]:
            cells.pop()
        short = width - len(cells)
        cut = number == len(lines) and not ended
        if "\t" in line and short > 0 and short % 3 == 0 and not cut:
            cells += [""] * short  # trailing markers without data
        elif short > 0 and cut:
            problem = f"the file is truncated: {len(rows)} frames can be read"
            raise FileError(problem, place=f"line {number}", remedy="Copy or export it again.")
        elif short:
            problem = f"{len(cells)} cells where {count} markers need {width}"
            raise FileError(problem, place=f"line {number}", remedy=_TRC_REMEDY)
        try:
            rows.append([float(cell or "nan") for cell in cells])
        except ValueError as error:
            remedy = "Leave the cells of a marker empty where it is not seen."
            problem = f"a cell is not a number ({shortened(str(error), 120)})"
            raise FileError(problem, place=f"line {number}", remedy=remedy) from error
    table = np.array(rows, dtype=float).reshape(len(rows), width)
    if not np.isfinite(table[:, :2]).all():
        raise FileError("a row without frame number or time", remedy=_TRC_REMEDY)
    return table[:, 0], table[:, 1], table[:, 2:].reshape(len(rows), count, 3)


C3D = FileFormat("C3D", (".c3d",), _read_c3d, _is_c3d)
TRC = FileFormat("TRC of OpenSim", (".trc",), _read_trc, _is_trc)
