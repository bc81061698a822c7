"""`[[lines]]`: image lines of known objects, from a table of two image points a line and frame."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_text
from kinefit.errors import FileError, ObservationError, choices
from kinefit.observations import LineVideo
from kinefit.readers.take.cameras import TakeCameras, stated_frame, stated_rate
from kinefit.readers.take.entries import Pixels, Rate
from kinefit.readers.take.kinds import SensorKind, TakeEntry, refuse

_COLUMNS = ("frame", "line", "u1", "v1", "u2", "v2")
_REMEDY = f"Give a table with the columns {', '.join(_COLUMNS)} (.csv), or a list of objects with these keys (.json)."


class LinesEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[lines]]`: image lines in one camera on which points or edges of the body lie."""

    camera: str
    file: Path  # table of frame, line, u1, v1, u2, v2 [px]
    landmarks: dict[str, tuple[str, ...]]  # of each line: two ends of an edge of the body, or one point
    frame: Literal["calibration", "video"] | None = None  # image frame of the lines; needed where the two differ
    rate: Rate | None = None  # [Hz]; default: the camera's video, or the take
    sigma: Pixels = 2.0  # [px] standard deviation, in the calibration's image

    def __post_init__(self) -> None:
        example = 'Write landmarks = { edge = ["r_asis", "l_asis"] }, one entry for each line.'
        refuse(not self.landmarks, "no landmarks", example)
        for name, own in self.landmarks.items():
            odd = not 1 <= len(set(own)) == len(own) <= 2
            refuse(odd, f"line '{name}' has {len(own)} landmarks", "Give the two ends of an edge, or one point.")


def read_lines(path: Path, names: Iterable[str]) -> tuple[NDArray, NDArray]:
    """Frames (F,), those that the file has, and the named lines' points (F, L, 2, 2) [px], NaN where there are none.

    Raises
    ------
    FileError
        No such table, a number that is none, a line twice in one frame.
    ObservationError
        A line whose name is not known, or no line at all.
    """
    names = tuple(names)
    rows: dict[tuple[int, str], list[float]] = {}
    for place, row in _rows(path):
        try:
            frame, name = int(row["frame"]), str(row["line"]).strip()
            ends = [float(row[key]) for key in _COLUMNS[2:]]
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise FileError(f"not a row with a line ({error})", file=path, place=place, remedy=_REMEDY) from error
        if name not in names:
            raise ObservationError(
                choices("line", name, names), file=path, place=place, remedy="Add it to `landmarks`, or remove it."
            )
        if not np.isfinite(ends).all() or frame < 0 or (frame, name) in rows:
            problem = f"frame {frame}, line '{name}' appears twice, or its numbers are not finite"
            raise FileError(problem, file=path, place=place, remedy="Give each line once a frame; frames begin with 0.")
        rows[frame, name] = ends
    if not rows:
        raise ObservationError("no lines", file=path, remedy=_REMEDY)
    frames = np.unique([frame for frame, _ in rows])
    out = np.full((len(frames), len(names), 2, 2), np.nan)
    for (frame, name), ends in rows.items():
        out[np.searchsorted(frames, frame), names.index(name)] = np.reshape(ends, (2, 2))
    return frames, out


def _rows(path: Path) -> Iterable[tuple[str, Mapping[str, Any]]]:
    """Rows of a table, each with its place for messages."""
    try:
        text = read_text(path, "the lines", remedy=_REMEDY)
        if path.suffix.lower() == ".json":
            content = json.loads(text)
            if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
                raise FileError("not a list of objects", file=path, remedy=_REMEDY)
            return [(f"entry {i}", row) for i, row in enumerate(content)]
        return [(f"line {i}", row) for i, row in enumerate(csv.DictReader(text.splitlines()), 2)]
    except (ValueError, RecursionError, csv.Error) as error:
        raise FileError(f"cannot read the lines ({error})", file=path, remedy=_REMEDY) from error


def _read(entry: LinesEntry, _: str, cameras: TakeCameras) -> LineVideo:
    frame = stated_frame(cameras.images[entry.camera], entry.frame, "lines")
    rate, clock = stated_rate(entry.rate or cameras.fastest), cameras.clocks.get(entry.camera)
    names = tuple(entry.landmarks)
    frames, ends = read_lines(entry.file, names)
    if frame is not None:
        ends = frame.to_calibration(ends)
    of_video = entry.rate is None and clock is not None and frames[-1] < len(clock)
    times = clock[frames] if of_video and clock is not None else frames / rate
    times = cameras.offset(entry.camera) + times
    return LineVideo(
        entry.camera, rate, times, names, tuple(map(tuple, entry.landmarks.values())), ends,
        source=str(entry.file),
    )  # fmt: skip


KIND = SensorKind(
    table="lines", summary="image lines on which points or edges of the body lie", entry=LinesEntry, read=_read,
    sigma=lambda entry: {f"lines {entry.camera}": entry.sigma}, finds_pose=True, replaces_keypoints=True,
)  # fmt: skip
