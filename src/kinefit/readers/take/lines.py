"""Image lines of known objects: `[[lines]]`, a table of two image points a line and frame; and clicked joints."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_text
from kinefit.errors import FileError, ObservationError, TakeError, choices
from kinefit.observations import ClickVideo, LineVideo
from kinefit.readers.annotations import read_clicks
from kinefit.readers.take.cameras import TakeCameras, stated_frame, stated_rate
from kinefit.readers.take.entries import LinesEntry

_COLUMNS = ("frame", "line", "u1", "v1", "u2", "v2")
_REMEDY = f"Give a table with the columns {', '.join(_COLUMNS)} (.csv), or a list of objects with these keys (.json)."

_CLICK_CROSS_PX = 20.0  # from a click to the ends of the two lines that cross there: short, that no lens bends them


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


def load_clicks(cameras: TakeCameras) -> tuple[ClickVideo, ...]:
    """Joints that were clicked: each is two image lines that cross in it, along u and v, with its landmark on both.

    Raises
    ------
    TakeError
        Nothing states the rate; a camera that the take does not have.
    FileError
        As `read_clicks`.
    """
    take, images, out = cameras.take, cameras.images, list[ClickVideo]()
    if take.clicks is None:
        return ()
    steps = read_clicks(take.clicks)
    for camera in dict.fromkeys(camera for of in steps for camera in of.points):
        if camera not in images:
            problem = choices("camera", camera, images)
            raise TakeError(problem, file=take.clicks, place="[start] clicks", remedy="Remove its clicks.")
        rate = stated_rate(cameras.fastest, take.path)
        mine = [of for of in steps if of.points.get(camera)]
        names = tuple(dict.fromkeys(name for of in mine for name in of.points[camera]))
        uv = np.array([[of.points[camera].get(name, (np.nan, np.nan)) for name in names] for of in mine])
        cross = _CLICK_CROSS_PX * np.array([[[0, -1], [0, 1]], [[-1, 0], [1, 0]]])
        ends = images[camera].to_calibration(uv[:, :, None, None] + cross).reshape(len(mine), -1, 2, 2)
        offset = cameras.offset(camera)
        times = offset + np.array([round(of.step - offset * rate) for of in mine]) / rate
        titles = tuple(f"{name} {axis}" for name in names for axis in "uv")
        landmarks = tuple((name,) for name in names for _ in "uv")
        out.append(ClickVideo(camera, rate, times, titles, landmarks, ends, source=str(take.clicks)))
    return tuple(out)


def load_lines(entry: LinesEntry, cameras: TakeCameras) -> LineVideo:
    """A `[[lines]]` of a take.

    Raises
    ------
    TakeError
        Nothing states the rate, or the image in which the lines are.
    KinefitError
        As `read_lines`.
    """
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
