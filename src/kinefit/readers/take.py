"""The take file: one TOML that names the sensors of a recording, parsed once into typed records."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec

from kinefit.errors import FileError, TakeError, choices
from kinefit.readers.keypoints import KEYPOINT_SETS
from kinefit.readers.markers import UNITS


class _Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the take file; paths are absolute once it is read."""


class CalibrationEntry(_Entry, frozen=True, kw_only=True):
    """`[calibration]`: where the cameras stood."""

    file: Path
    unit: str = "auto"  # of its translations, where the format does not tell


class CameraEntry(_Entry, frozen=True, kw_only=True):
    """`[[camera]]`: one camera of the calibration, with its video or the size of its picture."""

    name: str
    video: Path | None = None
    size: tuple[int, int] | None = None  # [px] (width, height) of the picture; default: the video's
    image: Literal["as calibrated", "scaled", "letterboxed"] = "as calibrated"  # what became of the picture
    rotation: Literal[0, 90, 180, 270] = 0  # [deg] the picture is the calibration's, turned clockwise
    time_offset: float = 0.0  # [s] added to frame / rate


class KeypointsEntry(_Entry, frozen=True, kw_only=True):
    """`[[keypoints]]`: what a detector saw in one camera."""

    camera: str
    file: Path | None = None  # or folder; default, of "detect" only: what `kinefit detect` leaves beside the take
    format: Literal["openpose", "mediapipe", "caliscope", "detect"] = "openpose"
    set: str | None = None  # default: BODY_25B of openpose, MEDIAPIPE_33 of mediapipe
    frame: Literal["calibration", "video"] | None = None  # image frame of the coordinates; needed where the two differ
    rate: float | None = None  # [Hz]; default: the camera's video, or the take
    accuracy: float = 8.0  # [px] standard deviation, in the calibration's image


class MarkersEntry(_Entry, frozen=True, kw_only=True):
    """`[[markers]]`: a marker recording."""

    file: Path
    unit: str | None = None  # where the file does not tell it
    set: str | None = None  # the body's marker set that its labels belong to; default: the one that fits
    time_offset: float = 0.0  # [s]
    accuracy: float = 0.005  # [m] standard deviation


class _Head(_Entry, frozen=True, kw_only=True):
    name: str | None = None
    rate: float | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    body: str = "humanoid"
    height: float | None = None
    subject: Path | None = None
    frames: tuple[int, int] | None = None


class _File(_Entry, frozen=True, kw_only=True):
    take: _Head = _Head()
    calibration: CalibrationEntry | None = None
    camera: tuple[CameraEntry, ...] = ()
    keypoints: tuple[KeypointsEntry, ...] = ()
    markers: tuple[MarkersEntry, ...] = ()


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
    subject : Path or None
        Take of the same person (a T-pose trial) that bone lengths come from; None: from this take itself.
    frames : (start, stop) or None
        Steps of the common time, t = step / rate.
    calibration : CalibrationEntry or None
    cameras, keypoints, markers : tuples of entries
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


def read_take(path: str | PathLike[str]) -> Take:
    """Read a take file; relative paths in it start at its own folder.

    Raises
    ------
    FileError
        The take file, or a file that it names, is missing; or it is not TOML.
    TakeError
        Unknown sensors, keys or values (the message lists what exists), no sensor at all, names that do not agree.
    """
    path = Path(path).absolute()
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileError("no such take file", file=path, remedy="Check the path.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"cannot be read ({error})", file=path, remedy="Give a text file in UTF-8.") from error
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"not TOML: {error}", file=path, remedy="Put texts in quotes and numbers not.") from error
    _check_keys(raw, path)
    folder = path.parent
    try:
        content = msgspec.convert(raw, _File, dec_hook=_path_in(folder))
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$.")
        place = place.rstrip("`")
        listed = ", ".join(map(repr, _options(place.rpartition(".")[2])))
        remedy = f"There are: {listed}." if listed and "enum" in problem else None
        raise TakeError(problem.replace("enum ", ""), file=path, place=place or None, remedy=remedy) from error
    head = content.take
    body = str(folder / head.body) if head.body.endswith(".toml") else head.body
    take = Take(
        path=path, name=head.name or path.stem, rate=head.rate, up=head.up, body=body, height=head.height,
        subject=head.subject, frames=head.frames, calibration=content.calibration, cameras=content.camera,
        keypoints=content.keypoints, markers=content.markers,
    )
    _check_values(take)
    _check_names(take)
    _check_files(take)
    return take


def _path_in(folder: Path) -> Callable[[type, Any], Path]:
    """Maker of absolute paths from the texts of a take file."""

    def make(_: type, value: Any) -> Path:
        if not isinstance(value, str) or not value:
            raise ValueError("a file or folder is a text")
        return folder / value

    return make


def _options(key: str) -> tuple[Any, ...]:
    """What may be written for a key, where it is one of a few."""
    for entry in (_Head, CameraEntry, KeypointsEntry):
        if key in _fields(entry):
            hint = get_type_hints(entry)[key]
            literals = [hint, *get_args(hint)]
            return next((get_args(literal) for literal in literals if get_origin(literal) is Literal), ())
    return ()


def _fields(entry: type[msgspec.Struct]) -> tuple[str, ...]:
    return entry.__struct_fields__


def _check_keys(raw: dict[str, Any], path: Path) -> None:
    """Name an unknown table or key, and what exists."""
    tables: dict[str, type[msgspec.Struct]] = {
        "take": _Head, "calibration": CalibrationEntry, "camera": CameraEntry, "keypoints": KeypointsEntry,
        "markers": MarkersEntry,
    }
    for table, content in raw.items():
        if table not in tables:
            raise TakeError(choices("sensor or table", table, tables), file=path, place=f"[{table}]")
        many = table in ("camera", "keypoints", "markers")
        if many != isinstance(content, list):
            wanted = f"[[{table}]]" if many else f"[{table}]"
            raise TakeError(f"'{table}' is not a table {wanted}", file=path, place=table, remedy=f"Write {wanted}.")
        for number, row in enumerate(content if many else [content]):
            place = f"[[{table}]] {number + 1}" if many else f"[{table}]"
            if not isinstance(row, dict):
                raise TakeError("not a table", file=path, place=place, remedy=f"Write [[{table}]] and its keys below.")
            for key in row:
                if key not in _fields(tables[table]):
                    raise TakeError(choices("key", key, _fields(tables[table])), file=path, place=place)


def _check_values(take: Take) -> None:
    """Refuse numbers that cannot be."""

    def refuse(problem: str, place: str, remedy: str) -> None:
        raise TakeError(problem, file=take.path, place=place, remedy=remedy)

    if take.rate is not None and not 0 < take.rate < 1e6:
        refuse(f"rate {take.rate:g} Hz", "[take] rate", "Give frames per second, or leave it out.")
    if take.height is not None and not 0.3 < take.height < 3:
        refuse(f"height {take.height:g} m", "[take] height", "Give the stature in metres, or leave it out.")
    if take.frames is not None and not take.frames[0] < take.frames[1]:
        refuse(f"frames {list(take.frames)}", "[take] frames", "Give [first, one after the last].")
    for camera in take.cameras:
        if not abs(camera.time_offset) < 1e6 or (camera.size and min(camera.size) < 1):
            refuse(f"size {camera.size}, time offset {camera.time_offset} s", f"camera {camera.name}", "Give px and s.")
    for source in take.keypoints:
        place = f"keypoints of camera {source.camera}"
        if source.set is not None and source.set not in KEYPOINT_SETS:
            refuse(choices("keypoint set", source.set, KEYPOINT_SETS), place, "Use one of these.")
        if source.format != "openpose" and source.set not in (None, "MEDIAPIPE_33"):
            refuse(f"{source.format} gives no {source.set}", place, 'Use set = "MEDIAPIPE_33", or leave it out.')
        if source.file is None and source.format != "detect":
            refuse(f"no file of {source.format} keypoints", place, 'Write file = "...", or format = "detect".')
        if not 0 < source.accuracy < 1e4 or (source.rate is not None and not 0 < source.rate < 1e6):
            refuse(f"accuracy {source.accuracy} px, rate {source.rate} Hz", place, "Give positive numbers.")
    for entry in take.markers:
        place = f"markers {entry.file.name}"
        if not 0 < entry.accuracy < 1 or not abs(entry.time_offset) < 1e6:
            refuse(f"accuracy {entry.accuracy} m, time offset {entry.time_offset} s", place, "Give metres and seconds.")
        if entry.unit is not None and entry.unit.lower() not in UNITS:
            refuse(choices("unit", entry.unit, UNITS), place, "Use one of these.")


def _check_names(take: Take) -> None:
    """Names within the take agree, and there is something to see."""
    if not (take.cameras or take.keypoints or take.markers):
        remedy = "Add [[camera]] with [[keypoints]], or [[markers]]."
        raise TakeError("an empty take: it names no sensor", file=take.path, remedy=remedy)
    names = [entry.name for entry in take.cameras]
    for name in names:
        if names.count(name) > 1:
            raise TakeError("there are two of this name", file=take.path, place=f"camera {name}", remedy="Rename one.")
    for source in take.keypoints:
        if source.camera not in names:
            raise TakeError(
                choices("camera", source.camera, names), file=take.path, place=f"keypoints of camera {source.camera}",
                remedy=f'Add [[camera]] with name = "{source.camera}", or correct the name.',
            )
    if take.cameras and take.calibration is None:
        raise TakeError("cameras without calibration", file=take.path, remedy='Add [calibration] with file = "...".')


def _check_files(take: Take) -> None:
    """Every file that the take names is there."""
    named: list[tuple[str, Path | None]] = [("[calibration] file", take.calibration.file if take.calibration else None)]
    named += [(f"camera {entry.name}, video", entry.video) for entry in take.cameras]
    named += [(f"keypoints of camera {entry.camera}", entry.file) for entry in take.keypoints]
    named += [("[take] subject", take.subject)]
    named += [("markers", entry.file) for entry in take.markers]
    named += [("[take] body", Path(take.body) if take.body.endswith(".toml") else None)]
    for place, file in named:
        if file is not None and not file.exists():
            raise FileError(
                f"no such file or folder: {file}", file=take.path, place=place,
                remedy="Correct the path; a relative one starts at the take file.",
            )
