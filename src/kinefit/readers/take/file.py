"""The take file: one TOML that names the sensors of a recording, parsed once into typed records."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec

from kinefit._arguments import checked
from kinefit._files import BACKSLASHES, parse_toml, regular
from kinefit.errors import FileError, TakeError, check_choice, choices, printable, shortened
from kinefit.readers.ros.recordings import inside
from kinefit.readers.take.checks import check_take
from kinefit.readers.take.entries import (
    RENAMED,
    TABLES,
    CalibrationEntry,
    CameraEntry,
    DepthEntry,
    KeypointsEntry,
    LinesEntry,
    MarkersEntry,
    RegionEntry,
    SessionEntry,
    SilhouetteEntry,
    StartEntry,
    StereoEntry,
    SurfacePointsEntry,
    TrackerEntry,
    _Entry,
    _Head,
)
from kinefit.readers.take.find import find_take
from kinefit.readers.take.values import wrong_value
from kinefit.readers.units import LENGTHS, TIMES, worth

__all__ = [
    "CalibrationEntry", "CameraEntry", "DepthEntry", "KeypointsEntry", "LinesEntry", "MarkersEntry", "RegionEntry",
    "SessionEntry", "SilhouetteEntry", "StartEntry", "StereoEntry", "SurfacePointsEntry", "Take", "TrackerEntry",
    "read_take",
]


class _TakeFile(_Entry, frozen=True, kw_only=True):
    take: _Head = _Head()
    session: SessionEntry = SessionEntry()
    start: StartEntry | None = None
    calibration: CalibrationEntry | None = None
    camera: tuple[CameraEntry, ...] = ()
    keypoints: tuple[KeypointsEntry, ...] = ()
    markers: tuple[MarkersEntry, ...] = ()
    depth: tuple[DepthEntry, ...] = ()
    stereo: tuple[StereoEntry, ...] = ()
    silhouette: tuple[SilhouetteEntry, ...] = ()
    region: tuple[RegionEntry, ...] = ()
    lines: tuple[LinesEntry, ...] = ()
    surface_points: tuple[SurfacePointsEntry, ...] = ()
    tracker: tuple[TrackerEntry, ...] = ()


_SINGLE_TABLES = ("take", "session", "start", "calibration")


@dataclass(frozen=True)
class Take:
    """A take file, checked: all names in it agree and all files it names exist.

    Parameters
    ----------
    path : Path
        Of the take file.
    name : str
        Default: the take file's own name.
    rate : float [Hz] or None
        None: the videos' or markers'.
    up : "x", "y", "z", "-x", "-y" or "-z"
        Vertical axis of the calibration's (or markers') world.
    body : str
        Name in the catalogue, or absolute path of a body file.
    height : float [m] or None
        Stature of the person, as a first guess.
    person : int, str or None
        The target person if several are in view, see `PersonChoice`; None: the one with most visible points.
    subject : Path or None
        Take of the same person (a T-pose trial) that bone lengths come from; None: from this take itself.
    start : Path or None
        Motion file (`motion.npz`) that gives body and pose of the first step; None: they are sought.
    pose : StartEntry or None
        Where the body is at one step.
    clicks : Path or None
        Joints that were clicked in images, see `read_clicks`.
    click_sigma : float [px]
        Standard deviation of a click along each axis.
    size : bool or None
        Whether the body is fitted to the person's size and shape; None: unless `start` tells it.
    frames : (start, stop) or None
        Steps of the common time, t = step / rate.
    calibration : CalibrationEntry or None
    session : SessionEntry, subject and movement of the recording
    hide_faces : bool
        Whether images and videos that are made from the take's show no faces.
    cameras, keypoints, markers, depth, stereo, silhouettes, regions, skin, lines, surface_points, trackers : tuples
        Of entries; `skin` are the [[keypoints]] of format "skin", `keypoints` all others.
    digest : str
        SHA-256 of the file's tables as they are written, without comments and spacing; "" for a take of no file.
    """

    path: Path
    name: str
    rate: float | None
    up: str
    body: str
    height: float | None
    subject: Path | None
    frames: tuple[int, int] | None
    calibration: CalibrationEntry | None
    cameras: tuple[CameraEntry, ...]
    keypoints: tuple[KeypointsEntry, ...]
    markers: tuple[MarkersEntry, ...]
    depth: tuple[DepthEntry, ...] = ()
    stereo: tuple[StereoEntry, ...] = ()
    silhouettes: tuple[SilhouetteEntry, ...] = ()
    regions: tuple[RegionEntry, ...] = ()
    start: Path | None = None
    pose: StartEntry | None = None
    clicks: Path | None = None
    click_sigma: float = StartEntry().click_sigma
    size: bool | None = None
    person: int | str | None = None
    skin: tuple[KeypointsEntry, ...] = ()
    lines: tuple[LinesEntry, ...] = ()
    surface_points: tuple[SurfacePointsEntry, ...] = ()
    trackers: tuple[TrackerEntry, ...] = ()
    session: SessionEntry = field(default_factory=SessionEntry)
    hide_faces: bool = False
    digest: str = ""

    @property
    def other_sensors(self) -> tuple[object, ...]:
        """Entries of all sensors but cameras and the keypoints of a detector."""
        return (
            *self.depth, *self.stereo, *self.markers, *self.skin, *self.silhouettes, *self.regions, *self.lines,
            *self.surface_points, *self.trackers,
        )  # fmt: skip


@checked
def read_take(path: str | PathLike[str]) -> Take:
    """Read a take file, or the one in a folder; relative paths in it start at its own folder.

    Raises
    ------
    FileError
        The take file, or a file that it names, is missing; or it is not TOML.
    TakeError
        Unknown sensors, keys or values (the message lists what exists), no sensor at all, names that do not agree.
    """
    path = find_take(path).absolute()
    try:
        raw = parse_toml(regular(path).read_text(encoding="utf-8"), path)
    except FileNotFoundError as error:
        raise FileError("no such take file", file=path, remedy="Check the path.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"cannot be read ({error})", file=path, remedy="Give a text file in UTF-8.") from error
    digest = hashlib.sha256(json.dumps(raw, sort_keys=True, default=str).encode()).hexdigest()
    _check_keys(raw, path)
    _rename(raw, path)
    for row in raw.get("depth", []):
        for key, units in (("unit", LENGTHS), ("time_unit", TIMES)):
            if (value := worth(row.get(key), units)) is not None:
                row[key] = value
    _name_topics(raw, path)
    folder = path.parent
    try:
        content = msgspec.convert(raw, _TakeFile, dec_hook=_path_in(folder))
    except msgspec.ValidationError as error:
        raise wrong_value(error, TABLES, path) from error
    head, start = content.take, content.start or StartEntry()
    body = str(folder / head.body) if head.body.endswith((".toml", ".npz")) else head.body
    take = Take(
        path=path, name=head.name or printable(path.stem), rate=head.rate, up=head.up, body=body, height=head.height,
        subject=head.subject, frames=head.frames, calibration=content.calibration, cameras=content.camera,
        keypoints=tuple(k for k in content.keypoints if k.format != "skin"), markers=content.markers,
        depth=content.depth, stereo=content.stereo,
        silhouettes=content.silhouette, regions=content.region,
        skin=tuple(k for k in content.keypoints if k.format == "skin"), lines=content.lines, start=head.start,
        pose=None if start.is_clicks_alone else content.start, clicks=start.clicks, click_sigma=start.click_sigma,
        size=head.size, person=head.person, session=content.session,
        surface_points=content.surface_points, trackers=content.tracker, hide_faces=head.hide_faces,
        digest=digest,
    )  # fmt: skip
    check_take(take)
    return take


_MAX_PATH_BYTES = 2048  # bytes of a path within a take: systems allow 4096 in all


def _path_in(folder: Path) -> Callable[[type, Any], Path]:
    """Maker of absolute paths from the texts of a take file."""

    def make(_: type, value: Any) -> Path:
        if not isinstance(value, str) or not value:
            raise ValueError("a file or folder must be a text in quotes")
        if len(value.encode()) > _MAX_PATH_BYTES or any(len(part.encode()) > 255 for part in Path(value).parts):
            raise ValueError(f"{shortened(value, 60)!r} is no path: it is too long")
        if any(ord(character) < 32 for character in value):
            raise ValueError(f"{value!r} is no path: {BACKSLASHES}")
        return folder / value

    return make


def _name_topics(raw: dict[str, Any], path: Path) -> None:
    """Make `topic` a part of its file's path, as recordings of ROS 2 are read."""
    for table, key in (("camera", "video"), ("depth", "file")):
        for number, row in enumerate(raw.get(table, [])):
            topic, file = row.get("topic"), row.get(key)
            if topic is None or not isinstance(topic, str):
                continue
            place = f"[[{table}]] {number + 1}"
            if not isinstance(file, str) or not topic.strip("/"):
                remedy = f'Write {key} = "recording.mcap" and topic = "/front/image_raw".'
                raise TakeError(f"a topic without {key}, or without a name", file=path, place=place, remedy=remedy)
            recording = path.parent / file
            if recording.exists() and inside(recording) is None:
                problem = f"'topic' has no use with {file}"
                raise TakeError(problem, file=path, place=place, remedy="It is for MCAP recordings of ROS 2.")
            row[key] = f"{file}/{topic.strip('/')}"


def _fields(entry: type[msgspec.Struct]) -> tuple[str, ...]:
    return entry.__struct_fields__


def _check_keys(raw: dict[str, Any], path: Path) -> None:
    """Name an unknown table or key, and what exists."""
    for table, content in raw.items():
        check_choice("sensor or table", table, TABLES, TakeError, file=path, place=f"[{table}]")
        many = table not in _SINGLE_TABLES
        if many != isinstance(content, list):
            wanted = f"[[{table}]]" if many else f"[{table}]"
            raise TakeError(f"'{table}' is not a table {wanted}", file=path, place=table, remedy=f"Write {wanted}.")
        for number, row in enumerate(content if many else [content]):
            place = f"[[{table}]] {number + 1}" if many else f"[{table}]"
            if not isinstance(row, dict):
                raise TakeError("not a table", file=path, place=place, remedy=f"Write [[{table}]] and its keys below.")
            for key in row:
                if key not in _fields(TABLES[table]) and key not in RENAMED.get(table, {}):
                    problem = choices("key", key, _fields(TABLES[table]))
                    raise TakeError(problem, file=path, place=place, remedy=_belongs(key))


def _belongs(key: str) -> str | None:
    """Which tables have a key."""
    holding = [name for name in TABLES if key in _fields(TABLES[name])]
    tables = [f"[{name}]" if name in _SINGLE_TABLES else f"[[{name}]]" for name in holding]
    return f"'{key}' belongs to {', '.join(tables)}." if tables else None


def _rename(raw: dict[str, Any], path: Path) -> None:
    """Put the new name of a key in place of its old one, and say so."""
    for table, names in RENAMED.items():
        content = raw.get(table, [])
        for number, row in enumerate(content if isinstance(content, list) else [content]):
            place = f"[[{table}]] {number + 1}" if isinstance(content, list) else f"[{table}]"
            for old in [key for key in row if key in names]:
                new = names[old]
                if new in row:
                    raise TakeError(f"'{old}' and '{new}' are one key", file=path, place=place, remedy=f"Keep '{new}'.")
                row[new] = row.pop(old)
                warnings.warn(
                    f"{path}, {place}: '{old}' is now called '{new}'; the next version does not read '{old}'",
                    FutureWarning, stacklevel=3,
                )  # fmt: skip
