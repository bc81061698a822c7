"""The take file: one TOML that names the sensors of a recording, parsed once into typed records."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec

from kinefit.errors import FileError, TakeError, choices
from kinefit.readers.keypoints import KEYPOINT_SETS
from kinefit.readers.markers import UNITS
from kinefit.readers.take.entries import (
    CalibrationEntry,
    CameraEntry,
    DepthEntry,
    KeypointsEntry,
    MarkersEntry,
    SilhouetteEntry,
    StereoEntry,
    _Entry,
    _Head,
)

__all__ = [
    "CalibrationEntry",
    "CameraEntry",
    "DepthEntry",
    "KeypointsEntry",
    "MarkersEntry",
    "SilhouetteEntry",
    "StereoEntry",
    "Take",
    "read_take",
]


class _File(_Entry, frozen=True, kw_only=True):
    take: _Head = _Head()
    calibration: CalibrationEntry | None = None
    camera: tuple[CameraEntry, ...] = ()
    keypoints: tuple[KeypointsEntry, ...] = ()
    markers: tuple[MarkersEntry, ...] = ()
    depth: tuple[DepthEntry, ...] = ()
    stereo: tuple[StereoEntry, ...] = ()
    silhouette: tuple[SilhouetteEntry, ...] = ()


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
    start : Path or None
        Motion file (`motion.npz`) that tells body and pose of the first step; None: they are sought.
    frames : (start, stop) or None
        Steps of the common time, t = step / rate.
    calibration : CalibrationEntry or None
    cameras, keypoints, markers, depth, stereo, silhouettes : tuples of entries
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
    start: Path | None = None


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
        listed = ", ".join(map(repr, _options(place)))
        remedy = f"There are: {listed}." if listed and "enum" in problem else None
        raise TakeError(problem.replace("enum ", ""), file=path, place=place or None, remedy=remedy) from error
    head = content.take
    body = str(folder / head.body) if head.body.endswith((".toml", ".npz")) else head.body
    take = Take(
        path=path, name=head.name or path.stem, rate=head.rate, up=head.up, body=body, height=head.height,
        subject=head.subject, frames=head.frames, calibration=content.calibration, cameras=content.camera,
        keypoints=content.keypoints, markers=content.markers, depth=content.depth, stereo=content.stereo,
        silhouettes=content.silhouette, start=head.start,
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


def _options(place: str) -> tuple[Any, ...]:
    """What may be written at a place such as "camera[0].image", where it is one of a few."""
    table, _, key = place.rpartition(".")
    entries: dict[str, type[msgspec.Struct]] = {
        "camera": CameraEntry, "keypoints": KeypointsEntry, "silhouette": SilhouetteEntry, "take": _Head,
    }  # fmt: skip
    entry = entries.get(table.partition("[")[0])
    if entry is None or key not in _fields(entry):
        return ()
    hint = get_type_hints(entry)[key]
    return next((get_args(literal) for literal in (hint, *get_args(hint)) if get_origin(literal) is Literal), ())


def _fields(entry: type[msgspec.Struct]) -> tuple[str, ...]:
    return entry.__struct_fields__


def _check_keys(raw: dict[str, Any], path: Path) -> None:
    """Name an unknown table or key, and what exists."""
    tables: dict[str, type[msgspec.Struct]] = {
        "take": _Head, "calibration": CalibrationEntry, "camera": CameraEntry, "keypoints": KeypointsEntry,
        "markers": MarkersEntry, "depth": DepthEntry, "stereo": StereoEntry,
        "silhouette": SilhouetteEntry,
    }
    for table, content in raw.items():
        if table not in tables:
            raise TakeError(choices("sensor or table", table, tables), file=path, place=f"[{table}]")
        many = table not in ("take", "calibration")
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
        if source.frames is not None and not source.frames[0] < source.frames[1]:
            refuse(f"frames {list(source.frames)}", place, "Give [first, one after the last].")
    for shape in take.silhouettes:
        place = f"silhouette of camera {shape.camera}"
        if not 0 < shape.accuracy < 1e4 or (shape.rate is not None and not 0 < shape.rate < 1e6):
            refuse(f"accuracy {shape.accuracy} px, rate {shape.rate} Hz", place, "Give positive numbers.")
        if shape.file is None and shape.format == "masks":
            refuse("no file of masks", place, 'Write file = "..." (a folder), or another format.')
    for entry in take.markers:
        place = f"markers {entry.file.name}"
        if not 0 < entry.accuracy < 1 or not abs(entry.time_offset) < 1e6:
            refuse(f"accuracy {entry.accuracy} m, time offset {entry.time_offset} s", place, "Give metres and seconds.")
        if entry.unit is not None and entry.unit.lower() not in UNITS:
            refuse(choices("unit", entry.unit, UNITS), place, "Use one of these.")
    for problem, place, remedy in _odd_depth(take):
        refuse(problem, place, remedy)


def _odd_depth(take: Take) -> Iterator[tuple[str, str, str]]:
    """Numbers of depth sensors and stereo pairs that cannot be: problem, place, remedy."""
    for entry in take.depth:
        place = f"depth {entry.name}"
        if not 0 < entry.accuracy < 1 or not abs(entry.time_offset) < 1e6:
            yield f"accuracy {entry.accuracy} m, time offset {entry.time_offset} s", place, "Give metres and seconds."
        for key, value in (("unit", entry.unit), ("rate", entry.rate), ("time_unit", entry.time_unit)):
            if value is not None and not 0 < value < 1e6:
                yield f"{key} = {value:g}", place, "Give a positive number: unit in metres a count, rate in Hz."
        if entry.range is not None and not 0 <= entry.range[0] < entry.range[1]:
            yield f"range = {list(entry.range)}", place, "Give [near, far] in metres."
        if entry.size is not None and min(entry.size) < 1:
            yield f"size = {list(entry.size)}", place, "Give [width, height] in pixels."
        if entry.camera is not None and take.calibration is None:
            yield f"camera = {entry.camera}, but no [calibration]", place, "Add one, or give intrinsics."
        if entry.distortion and entry.intrinsics is None:
            yield "distortion without intrinsics", place, "Write intrinsics = [fx, fy, cx, cy] too."
        if entry.intrinsics is not None and not min(entry.intrinsics[:2]) > 0:
            yield f"intrinsics = {list(entry.intrinsics)}", place, "Give [fx, fy, cx, cy] in pixels."
    for pair in take.stereo:
        if not (0 < pair.range[0] < pair.range[1] and 0 < pair.accuracy < 100):
            yield (
                f"range {list(pair.range)} m, accuracy {pair.accuracy} px", f"stereo {pair.name}",
                "Give [near, far] in metres, nearer than far, and pixels.",
            )


def _check_names(take: Take) -> None:
    """Names within the take agree, and there is something to see."""
    if not (take.cameras or take.keypoints or take.markers or take.depth or take.silhouettes):
        remedy = "Add [[camera]] with [[keypoints]], [[depth]], or [[markers]]."
        raise TakeError("an empty take: it names no sensor", file=take.path, remedy=remedy)
    names = [entry.name for entry in take.cameras]
    sensors = [*names, *(entry.name for entry in take.depth), *(entry.name for entry in take.stereo)]
    for name in sensors:
        if sensors.count(name) > 1:
            kind = "camera" if name in names else "depth" if any(d.name == name for d in take.depth) else "stereo"
            raise TakeError("there are two of this name", file=take.path, place=f"{kind} {name}", remedy="Rename one.")
    named = [("keypoints", k.camera) for k in take.keypoints] + [("silhouette", s.camera) for s in take.silhouettes]
    for kind, camera in named:
        if camera not in names:
            raise TakeError(
                choices("camera", camera, names), file=take.path, place=f"{kind} of camera {camera}",
                remedy=f'Add [[camera]] with name = "{camera}", or correct the name.',
            )
    if take.cameras and take.calibration is None:
        raise TakeError("cameras without calibration", file=take.path, remedy='Add [calibration] with file = "...".')
    for pair in take.stereo:
        for side in (pair.left, pair.right):
            if not any(entry.name == side and entry.video is not None for entry in take.cameras):
                raise TakeError(
                    choices("camera with a video", side, [e.name for e in take.cameras if e.video is not None]),
                    file=take.path, place=f"stereo {pair.name}", remedy="Name two [[camera]] that have a video.",
                )  # fmt: skip
        if pair.left == pair.right:
            raise TakeError("left and right are one camera", file=take.path, place=f"stereo {pair.name}")
    videos = [entry.name for entry in take.cameras if entry.video is not None]
    for shape in take.silhouettes:
        if shape.format == "background" and shape.camera not in videos:
            raise TakeError(
                choices("camera with a video", shape.camera, videos), file=take.path,
                place=f"silhouette of camera {shape.camera}", remedy="Give the [[camera]] its video.",
            )  # fmt: skip
        if [s.camera for s in take.silhouettes].count(shape.camera) > 1:
            raise TakeError("two silhouettes", file=take.path, place=f"camera {shape.camera}", remedy="Leave one out.")
    alone = [entry.name for entry in take.depth if entry.intrinsics is not None]
    if alone and (take.calibration is not None or len(take.depth) > 1):
        raise TakeError(
            "intrinsics alone do not tell where a sensor stands beside others", file=take.path,
            place=f"depth {alone[0]}", remedy="Put its intrinsics and its pose into the calibration, and not here.",
        )  # fmt: skip


def _check_files(take: Take) -> None:
    """Every file that the take names is there."""
    named: list[tuple[str, Path | None]] = [("[calibration] file", take.calibration.file if take.calibration else None)]
    named += [(f"camera {entry.name}, video", entry.video) for entry in take.cameras]
    named += [(f"keypoints of camera {entry.camera}", entry.file) for entry in take.keypoints]
    named += [(f"silhouette of camera {entry.camera}", entry.file) for entry in take.silhouettes]
    named += [("[take] subject", take.subject), ("[take] start", take.start)]
    named += [("markers", entry.file) for entry in take.markers]
    named += [("[take] body", Path(take.body) if take.body.endswith((".toml", ".npz")) else None)]
    named += [(f"depth {entry.name}", entry.file) for entry in take.depth]
    named += [(f"depth {entry.name}, background", entry.background) for entry in take.depth]
    for place, file in named:
        if file is not None and not file.exists() and not ("*" in file.name and any(file.parent.glob(file.name))):
            raise FileError(
                f"no such file or folder: {file}", file=take.path, place=place,
                remedy="Correct the path; a relative one starts at the take file.",
            )
