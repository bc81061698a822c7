"""What a marker file states and users relied on: clock, rates, rows, labels by column, contradictions of a C3D."""

from __future__ import annotations

import gzip
import struct
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
from numpy.typing import NDArray

import kinefit
from kinefit.bodies import placement
from kinefit.cli.markers._fit import fit_file
from kinefit.errors import KinefitError
from kinefit.exporters import write_markers
from kinefit.exporters.c3d_file import c3d_bytes
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers
from kinefit.takes.track import track_take

LABELS = ("LASI", "RASI", "LPSI", "RPSI", "C7")
_START = 12.5  # [s]


def _places(frames: int = 60) -> NDArray:
    """(F, 5, 3) [m] places of five markers that move."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(5, 3)) + 0.1 * np.sin(np.arange(frames) / 9.0)[:, None, None] * rng.normal(size=(5, 3))


def _trc(
    path: Path, *, x: NDArray | None = None, names: str = "\t\t\t".join(LABELS), axes: str = "\t\tX1\tY1\tZ1",
    numbers: Iterable[float] | None = None, times: Iterable[float] | None = None, rate: float = 100.0, count: int = 5,
) -> NDArray:  # fmt: skip
    """Write a TRC as another program would, and return the places [m] in it."""
    x = _places() if x is None else x
    numbers, times = list(numbers or range(1, len(x) + 1)), list(np.arange(len(x)) / 100.0 if times is None else times)
    lines = [
        "PathFileType\t4\t(X/Y/Z)\ta.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{len(x)}\t{count}\tm\t{rate:g}\t1\t{len(x)}", f"Frame#\tTime\t{names}", axes, "",
    ]  # fmt: skip
    for number, time, row in zip(numbers, times, x.reshape(len(x), -1), strict=True):
        lines.append(f"{number}\t{time:.5f}\t" + "\t".join(f"{v:.8f}" for v in row))
    path.write_text("\n".join(lines) + "\n")
    return x


def _c3d(
    path: Path, *, x: NDArray | None = None, header: dict[int, bytes] | None = None, analog: NDArray | None = None,
    samples: int = 1, groups: dict[str, dict[str, Any]] | None = None, first: int = 1,
) -> NDArray:  # fmt: skip
    """Write a C3D whose groups state what they are given and whose header has other bytes; its places [m]."""
    x = _places() if x is None else x
    own: dict[str, dict[str, Any]] = {"POINT": {"UNITS": ["m"], "LABELS": list(LABELS[: x.shape[1]])}}
    for name, values in (groups or {}).items():
        own[name] = own.get(name, {}) | values
    raw = bytearray(
        c3d_bytes(x, np.zeros(x.shape[:2]), own, scale=-1.0, rate=100.0, first=first, analog=analog, samples=samples)
    )
    for at, value in (header or {}).items():
        raw[at : at + len(value)] = value
    path.write_bytes(raw)
    return x


def _same(markers: Markers, x: NDArray, names: tuple[str, ...] = LABELS) -> bool:
    alike = markers.names == names and markers.positions.shape == x.shape
    return alike and np.allclose(markers.positions, x, atol=1e-5)


def _refused(file: Path, *words: str) -> bool:
    """Whether reading ends in an error with these words."""
    try:
        read_markers(file)
    except KinefitError as error:
        return all(word in str(error) for word in words)
    return False


def _rows(path: Path) -> NDArray:
    """Rows of numbers of a TRC or MOT, by plain parsing: its first columns only."""
    rows = [line.split("\t")[:2] for line in path.read_text().splitlines()[4:] if line[:1].isdigit()]
    return np.array(rows, float)


def _squat(path: Path, **changes: Any) -> None:
    """Write a labelled squat of 40 frames at 60 Hz, whose clock starts as `changes` say."""
    truth = kinefit.simulation.squat_and_wave(rate=60)
    points = placement(truth.body, "CMU_41").points
    write_markers(Markers(points.names, 60.0, truth.positions(points)[:40], up=truth.up, **changes), path)


def _fitted(path: Path, out: Path, start: float) -> bool:
    """Whether the fit of a file and all that it writes begin at the file's time."""
    (motion, files), *_ = fit_file(path, out, formats=("motion", "mot", "trc", "c3d", "markers")).values()
    starts = [motion.times[0], kinefit.read_motion(files["motion"]).times[0], _rows(files["mot"])[0, 0]]
    starts += [_rows(files[f])[0, 1] for f in ("trc", "markers")]
    starts.append(ezc3d.c3d(str(files["c3d"]))["header"]["points"]["first_frame"] / motion.rate)  # counted from 0
    return bool(np.allclose(starts, start, atol=1e-4))


def _starts_late(folder: Path) -> bool:
    with tempfile.TemporaryDirectory() as where:
        out = Path(where) / "out.trc"
        write_markers(read_markers(folder / "take.trc"), out)
        return tuple(_rows(out)[0]) == (1251.0, _START)


def _rows_missing(folder: Path) -> bool:
    markers = read_markers(folder / "take.trc")
    empty = np.flatnonzero(np.isnan(markers.positions).all(axis=(1, 2)))
    return len(markers) == 200 and list(empty) == [100, 101, 102] and abs(markers.times[103] - 1.03) < 1e-9


def _unnamed_column(folder: Path) -> bool:
    markers = read_markers(folder / "take.trc")
    right = markers.names == ("LASI", "*2", "LPSI", "RPSI", "C7")
    return right and np.allclose(markers.positions[0, 2], (-0.6014, 0.9321, -0.2611), atol=1e-4)


def _long(folder: Path) -> bool:
    with tempfile.TemporaryDirectory() as where:
        file = Path(where) / "take.c3d"
        file.write_bytes(gzip.decompress((folder / "take.c3d.gz").read_bytes()))
        markers = read_markers(file)
        return len(markers) == 66_000 and abs(markers.positions[-1, 0, 0] - 0.5) < 1e-4


CASES: dict[str, Callable[[Path], bool]] = {
    "trc-starts-at-12.5-s": _starts_late, "trc-rows-missing": _rows_missing, "trc-unnamed-column": _unnamed_column,
    "trc-axis-labels-from-X5": lambda folder: read_markers(folder / "take.trc").positions.shape == (60, 5, 3),
    "c3d-contradicting-rate": lambda folder: _refused(folder / "take.c3d", "60 Hz", "100 Hz"),
    "c3d-contradicting-scale": lambda folder: _refused(folder / "take.c3d", "-0.1", "0.1", "floats"),
    "c3d-long-frames": _long,
}  # fmt: skip
"""{case: whether the answer to the input in its folder is right}."""


def _clock_to_c3d(folder: Path) -> bool:
    _trc(folder / "a.trc", times=_START + np.arange(60) / 100.0)
    write_markers(read_markers(folder / "a.trc"), folder / "a.c3d")
    return int(ezc3d.c3d(str(folder / "a.c3d"))["header"]["points"]["first_frame"]) == 1250  # ezc3d counts from 0


def _clock_of_c3d(folder: Path) -> bool:
    _c3d(folder / "a.c3d", first=751)
    write_markers(read_markers(folder / "a.c3d"), folder / "a.trc")
    return tuple(_rows(folder / "a.trc")[0]) == (751.0, 7.5)


def _fit_of_trc(folder: Path) -> bool:
    _squat(folder / "a.trc", first_time=_START)
    return _fitted(folder / "a.trc", folder / "out", _START)


def _fit_of_c3d(folder: Path) -> bool:
    _squat(folder / "a.c3d", first_frame=301)
    return _fitted(folder / "a.c3d", folder / "out", 5.0)


def _track(folder: Path) -> bool:
    """A take of markers alone, cut, begins at the cut on the file's clock."""
    _squat(folder / "a.c3d", first_frame=301)
    (folder / "take.toml").write_text('[take]\nframes = [6, 20]\n[[markers]]\nfile = "a.c3d"\n')
    motion, _ = track_take(folder / "take.toml")
    return len(motion) == 14 and bool(np.allclose(motion.times[[0, -1]], (5.1, 5.1 + 13 / 60)))


def _rows_missing_by_time(folder: Path, *, both: bool = False) -> bool:
    """Rows are missing in the middle; frame numbers go on, or jump with the times."""
    x, kept = _places(), np.r_[:20, 25:60]
    x[20:25] = np.nan
    _trc(folder / "a.trc", x=x[kept], times=kept / 100.0, numbers=(kept + 1).tolist() if both else None)
    markers = read_markers(folder / "a.trc")
    return markers.positions.shape == x.shape and np.allclose(markers.positions, x, atol=1e-6, equal_nan=True)


def _nominal_rate(folder: Path, true: float = 59.94) -> bool:
    _trc(folder / "a.trc", x=_places(600), rate=60.0, times=np.arange(600) / true)
    markers = read_markers(folder / "a.trc")
    return abs(markers.rate - true) < 1e-3 and any("DataRate" in note for note in markers.notes)


def _as_named(names: str, right: tuple[str, ...] = LABELS, **changes: Any) -> Callable[[Path], bool]:
    def is_right(folder: Path) -> bool:
        x = _trc(folder / "a.trc", names=names, **changes)
        return _same(read_markers(folder / "a.trc"), x, right)

    return is_right


def _names_by_spaces(folder: Path) -> bool:
    """Where a name is missing, blanks alone do not show which."""
    _trc(folder / "a.trc")
    lines = (folder / "a.trc").read_text().splitlines()
    lines[3] = "Frame# Time LASI RASI LPSI C7"
    (folder / "a.trc").write_text("\n".join(lines) + "\n")
    return _refused(folder / "a.trc", "4 names for 5 markers")


def _refused_c3d(*words: str, **changes: Any) -> Callable[[Path], bool]:
    def is_refused(folder: Path) -> bool:
        _c3d(folder / "a.c3d", **changes)
        return _refused(folder / "a.c3d", *words)

    return is_refused


def _read_c3d(*words: str, frames: int = 60, **changes: Any) -> Callable[[Path], bool]:
    """Whether the places of a contradictory C3D are read, and its notes have these words."""

    def is_right(folder: Path) -> bool:
        x = _c3d(folder / "a.c3d", x=_places(frames), **changes)
        markers = read_markers(folder / "a.c3d")
        return _same(markers, x) and all(any(word in note for note in markers.notes) for word in words)

    return is_right


def _last_gap(folder: Path) -> bool:
    """A gap of the last marker leaves no empty cell at a row's end, which OpenSim refuses."""
    x = _places()
    x[[0, 30, 59], -1] = np.nan
    write_markers(Markers(LABELS, 100.0, x), folder / "a.trc")
    rows = [line for line in (folder / "a.trc").read_text().splitlines() if line[:1].isdigit()][1:]
    full = all(line.count("\t") == 16 and line.split("\t")[-1] for line in rows)
    return full and np.allclose(read_markers(folder / "a.trc").positions, x, atol=1e-6, equal_nan=True)


_ANALOG = np.arange(60 * 40, dtype=float).reshape(60, 40)
_EIGHT = {"ANALOG": {"USED": np.array(8, np.uint16), "RATE": np.array(500.0, np.float32), "LABELS": []}}
_SEVEN = {"ANALOG": _EIGHT["ANALOG"] | {"USED": np.array(7, np.uint16)}}
_OTHER_RATE = {"POINT": {"RATE": np.array(120.0, np.float32)}}

SIBLINGS: dict[str, Callable[[Path], bool]] = {
    "clock: TRC at 12.5 s, to C3D": _clock_to_c3d,
    "clock: C3D of a part, to TRC": _clock_of_c3d,
    "clock: TRC at 12.5 s, fitted, to MOT, TRC, C3D": _fit_of_trc,
    "clock: C3D of a part, fitted, to MOT, TRC, C3D": _fit_of_c3d,
    "clock: C3D of a part, a cut take of markers alone": _track,
    "rows: missing by their times alone": _rows_missing_by_time,
    "rows: missing by frame numbers and times": lambda folder: _rows_missing_by_time(folder, both=True),
    "rows: 59.94 Hz under DataRate 60": _nominal_rate,
    "rows: 119.88 Hz under DataRate 120 is 0.1 % off": lambda folder: _nominal_rate(folder, 60.06),
    "labels: the first column has no name": _as_named("\t\t\tRASI\t\t\tLPSI\t\t\tRPSI\t\t\tC7", ("*1", *LABELS[1:])),
    "labels: two columns without names": _as_named(
        "LASI\t\t\t\t\t\tLPSI\t\t\t\t\t\tC7\t\t\t", ("LASI", "*2", "LPSI", "*4", "C7")
    ),
    "labels: a name above each axis": _as_named("\t".join(n for n in LABELS for _ in "xyz")),
    "labels: a name and an axis above each column": _as_named("\t".join(f"{n}_{a}" for n in LABELS for a in "XYZ")),
    "labels: names by spaces, one missing": _names_by_spaces,
    "axis labels: from X0": _as_named("\t\t\t".join(LABELS), axes="\t\tX0\tY0\tZ0\tX1\tY1\tZ1"),
    "axis labels: without numbers": _as_named("\t\t\t".join(LABELS), axes="\t\t" + "X\tY\tZ\t" * 5),
    "axis labels: none": _as_named("\t\t\t".join(LABELS), axes=""),
    "rate: POINT:RATE 120, no analog": _refused_c3d("100 Hz", "120 Hz", groups=_OTHER_RATE),
    "rate: POINT:RATE 120, analog at 5 x 100 Hz": _read_c3d(
        "100 Hz counts", groups=_OTHER_RATE | _EIGHT, analog=_ANALOG, samples=5
    ),
    "scale: POINT:SCALE of integers, floats": _refused_c3d(
        "POINT:SCALE is 0.05", groups={"POINT": {"SCALE": np.array(0.05, np.float32)}}
    ),
    "scale: the header's of integers, floats": _refused_c3d(
        "scale is 0.1", header={12: struct.pack("<f", 0.1)}
    ),
    "start: first frames 1 and 833": _read_c3d("frame 1", first=833, header={6: struct.pack("<HH", 1, 60)}),
    "analog: 8 values a frame in the header, 40 are there": _read_c3d(
        "40 from block", groups=_EIGHT, analog=_ANALOG, samples=5, header={4: struct.pack("<H", 8)}
    ),
    "analog: none in the header, 40 are there": _read_c3d(
        "40 from block", groups=_EIGHT, analog=_ANALOG, samples=5, header={4: struct.pack("<H", 0)}
    ),
    "analog: neither count fits": _refused_c3d(
        "fits none", groups=_SEVEN, analog=_ANALOG, samples=5, header={4: struct.pack("<H", 8)}
    ),
    "long: counted by TRIAL": _read_c3d(frames=66_000),
    "long: counted by the file's length": _read_c3d(frames=66_000, groups={"TRIAL": {"ACTUAL_END_FIELD": []}}),
    "last marker with gaps, to TRC": _last_gap,
}  # fmt: skip
"""{kind and sibling of a case: whether the answer is right, in an empty folder}."""
