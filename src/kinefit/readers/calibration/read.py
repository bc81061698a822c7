"""Read camera calibrations of all common formats into a `Rig`; write a rig as Pose2Sim TOML."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import msgspec
import numpy as np

from kinefit._arguments import checked
from kinefit._files import metres_of, parse_toml, read_bytes, read_text, write_text
from kinefit.errors import CalibrationError, FileError, KinefitError, located, names_file
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import log_so3
from kinefit.readers.calibration.file_storage import parse_xml
from kinefit.readers.calibration.keys import find
from kinefit.readers.calibration.programs import colmap_cameras, matlab_tree, qualisys_cameras, read_mat, vicon_cameras
from kinefit.readers.calibration.tables import Sizes, camera_from_table, read_table
from kinefit.readers.calibration.trees import stereo_tables, tables_of
from kinefit.readers.plugins import CALIBRATIONS
from kinefit.readers.ros.images import mcap_rig
from kinefit.readers.ros.recordings import inside
from kinefit.readers.take.entries import CalibrationEntry

FORMATS = (
    "OpenCV YAML/XML/JSON, Pose2Sim, aniposelib, caliscope or FreeMoCap TOML, EasyMocap, CMU Panoptic, Qualisys or "
    "Theia3D XML, Vicon .xcp, MATLAB .mat, COLMAP text (cameras.txt and images.txt), Kalibr, MC-Calib, multical, "
    "transforms.json, MCAP of ROS 2"
)
SUFFIXES = (".yml", ".yaml", ".xml", ".json", ".toml", ".qca", ".qca.txt", ".xcp", ".mat")
"""Ends of the names of files in these formats."""
MAX_CALIBRATION_BYTES = 2_000_000
"""Largest file of a calibration [bytes]; a camera takes about a thousand."""
PAIRS = (("intrinsics", "extrinsics"), ("intri", "extri"))
"""Stems of two files that form one calibration: OpenCV's stereo calibration, EasyMocap."""

_FOREIGN = {
    "VIC-3D": (r"<!DOCTYPE\s+vpml|<vpml\b|<orientation>", "Calibrate with `kinefit calibrate board`"),
    "DICe": (r"DICe_xml_calibration", "Calibrate with `kinefit calibrate board`"),
    "Agisoft Metashape": (
        r"<document\b[^>]*>.*<sensors?\b|<calibration>\s*<projection>",
        "Export its cameras in COLMAP's format, and give that folder",
    ),
}
"""Programs whose XML is not read: what marks it, and what to do."""
_MAX_CAMERAS = 1000  # of a rig; the largest domes have 500
_XML_MAKERS = {"qualisys": qualisys_cameras, "vicon": vicon_cameras}  # both in millimetres
_MAX_ORIGIN_DISTANCE = 200.0  # [m] a camera farther from the world's origin is not in metres


@checked
@names_file
def read_calibration(
    path: str | PathLike[str],
    *,
    unit: str | float = "auto",
    image_size: tuple[int, int] | Callable[[str], tuple[int, int] | None] | None = None,
    exteriors: bool = True,
) -> Rig:
    """Read the cameras of a calibration; its format is recognised from its content.

    Parameters
    ----------
    path : file or folder
        OpenCV YAML/XML/JSON (one file with all cameras; a folder with one file or one folder a camera; a folder with
        intrinsics.yml and extrinsics.yml, or with EasyMocap's intri.yml and extri.yml), Pose2Sim, aniposelib,
        caliscope or FreeMoCap TOML, CMU Panoptic JSON, Qualisys or Theia3D XML, Vicon .xcp, MATLAB .mat (extra
        `matlab`), COLMAP text (the folder), Kalibr's camchain, MC-Calib YAML, multical JSON, transforms.json of
        nerfstudio and instant-ngp, MCAP of ROS 2 (CameraInfo and /tf_static; extra `ros`). Other JSON, YAML and TOML is
        read by the names of its keys (docs/calibration.md). Poses are world to camera unless a key says otherwise. A
        single camera without a pose becomes the world. What none of these reads, a plug-in may.
    unit : "auto", "m", "dm", "cm", "mm", "inch" or float [m]
        Unit of length of the file. "auto": as the file states (`unit = "mm"`, alone or under [metadata]), or as its
        format defines (Qualisys, Vicon, FreeMoCap: mm, Panoptic: cm), else metres, an error if that is implausible.
    image_size : (width, height) [px], or a function of the camera's name, optional
        Size of the images, for files that do not state it; the function returns None for an unknown camera.
    exteriors : bool
        False: cameras without a pose are read too, and placed at the origin.

    Returns
    -------
    Rig
        In metres; pixel (0, 0) is the centre of the first pixel.

    Raises
    ------
    FileError
        A missing file, or no known format.
    CalibrationError
        A camera with a missing key, a wrong shape, numbers that are not finite, a wrong unit, or a key that speaks of
        its lens, pose or convention and that kinefit does not read.
    PluginError
        A plug-in fails.
    """
    path = Path(path)
    if not path.exists():
        raise FileError("no such file or folder", file=path, remedy="Check the path of the calibration.")
    try:
        return _read(path, unit, image_size, exteriors)
    except KinefitError:
        if (name := CALIBRATIONS.name_of(path)) is None:
            raise
    options = {"unit": unit, "image_size": image_size if callable(image_size) else lambda camera: image_size}
    valid = lambda rig: isinstance(rig, Rig) and len(rig) > 0
    return CALIBRATIONS.get(name).call("read", path, **options, valid=valid, what="a Rig")  # type: ignore[no-any-return]


def _read(path: Path, unit: str | float, image_size: Sizes | None, exteriors: bool) -> Rig:
    """The cameras of a calibration in one of kinefit's own formats."""
    if (recording := inside(path)) is not None:
        return mcap_rig(recording[0])
    if path.stem in ("cameras", "images") and path.suffix in (".txt", ".bin"):
        path = path.parent
    with located(path):
        if path.is_dir():
            return _read_folder(path, unit, image_size, exteriors)
        kind, tree = _parse(path)
        if kind in _XML_MAKERS:
            return _rig(_XML_MAKERS[kind](tree), "mm" if unit == "auto" else unit)
        tables = [(name, table, path) for name, table in tables_of(tree, path.stem, exteriors)]
        return _rig_of(tables, unit, image_size, exteriors)


def read_opencv_stereo(
    intrinsics: str | PathLike[str],
    extrinsics: str | PathLike[str],
    *,
    image_size: tuple[int, int],
    unit: str | float = "auto",
    names: tuple[str, str] = ("left", "right"),
) -> Rig:
    """Read the pair of files that OpenCV's stereo calibration writes (M1, D1, M2, D2 and R, T).

    The first camera is the world. Its unit is that of the board's squares: give their length in metres as `unit`.
    """
    with located(path := Path(intrinsics)):
        tables = stereo_tables(_tree(path) | _tree(Path(extrinsics)), names)
        return _rig_of([(name, table, path) for name, table in tables], unit, image_size)


@checked
def write_calibration(
    rig: Rig, path: str | PathLike[str], *, metadata: Mapping[str, float | str | Sequence[float] | Sequence[str]] = {},
) -> None:  # fmt: skip
    """Write a rig as Pose2Sim TOML, in metres; the file appears whole or not at all.

    Parameters
    ----------
    metadata : more entries of [metadata].

    Raises
    ------
    ExportError
        The file cannot be written.
    CalibrationError
        A camera that the format cannot represent.
    """
    path = Path(path)
    more = "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in metadata.items())
    last = f'[metadata]\nadjusted = false\nerror = 0.0\nunit = "m"\n{more}'
    write_text(path, "\n".join([*(_toml(camera, path) for camera in rig), last]))


def _toml(camera: Camera, path: Path) -> str:
    name = json.dumps(camera.name, ensure_ascii=False)
    if camera.name == "metadata":
        raise CalibrationError("a camera cannot be called metadata here", file=path, remedy="Rename the camera.")
    key = camera.name if re.fullmatch(r"[A-Za-z0-9_-]+", camera.name) else name
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    entries = {
        "name": name,
        "size": [float(v) for v in camera.size],
        "matrix": camera.matrix.tolist(),
        "distortions": (camera.distortion if camera.distortion.size else np.zeros(4)).tolist(),
        "rotation": log_so3(R).tolist(),
        "translation": t.tolist(),
        "fisheye": str(camera.model == "fisheye").lower(),
    }
    return f"[{key}]\n" + "".join(f"{entry} = {value}\n" for entry, value in entries.items())


def _read_folder(folder: Path, unit: str | float, image_size: Sizes | None, exteriors: bool) -> Rig:
    if (folder / "cameras.txt").exists() or (folder / "cameras.bin").exists():
        return _rig(colmap_cameras(folder), unit)
    sources = calibration_sources(folder)
    if len(sources) == 1 and len(sources[0][1]) == 1:
        return read_calibration(sources[0][1][0], unit=unit, image_size=image_size, exteriors=exteriors)
    tables = []
    for name, group in sources:
        tree: dict = {}
        for file in group:
            tree |= _tree(file)
        with located(group[0]):
            tables += [(camera, table, group[0]) for camera, table in tables_of(tree, name, exteriors)]
    return _rig_of(tables, unit, image_size, exteriors)


def calibration_sources(path: Path) -> list[tuple[str, list[Path]]]:
    """Name and files of each camera, or group of cameras, of a file or folder of tables."""
    if path.is_file():
        return [(path.stem, [path])]
    files = _calibration_files(path)
    for pair in PAIRS:
        if set(pair) <= {file.stem for file in files}:
            return [(path.name, [file for file in files if file.stem in pair])]
    if files:
        return [(file.stem, [file]) for file in files]
    inner = [(sub.name, _calibration_files(sub)) for sub in sorted(path.iterdir()) if sub.is_dir()]
    return [(name, group) for name, group in inner if group]


def _calibration_files(folder: Path) -> list[Path]:
    files = sorted(file for file in folder.iterdir() if file.is_file() and file.name.lower().endswith(SUFFIXES))
    tables = [file for file in files if file.suffix.lower() not in (".xcp", ".mat")]  # these have other uses, too
    return tables or files


def _rig_of(
    tables: list[tuple[str, dict, Path]], unit: str | float, image_size: Sizes | None, exteriors: bool = True
) -> Rig:
    if len(tables) > _MAX_CAMERAS:
        problem = f"{len(tables)} cameras, more than {_MAX_CAMERAS}"
        raise CalibrationError(problem, remedy="Remove the cameras that recorded nothing.")
    pose_needed, cameras = len(tables) > 1 if exteriors else None, []
    for name, table, file in tables:
        with located(file):
            cameras.append(camera_from_table(name, table, image_size=image_size, pose_needed=pose_needed))
    return _rig(cameras, _chosen_unit([table for _, table, _ in tables], unit))


def _parse(path: Path) -> tuple[str, Any]:
    """Kind of a file (of `recognise`, or "mat"), and its tables, or the root of its XML."""
    with located(path):
        if path.suffix.lower() == ".mat":
            return "mat", read_mat(path)
        if (size := path.stat().st_size) > MAX_CALIBRATION_BYTES:
            problem = f"{size / 1e6:.0f} MB, too large for a calibration"
            raise FileError(problem, remedy=f"Is it another file? kinefit reads {FORMATS}.")
        text = read_text(path, "the calibration", remedy=f"kinefit reads {FORMATS}.")
        kind = recognise(text, path)
        return kind, _xml_root(text) if kind in _XML_MAKERS else matlab_tree(read_table(text, kind))


def _tree(path: Path) -> dict:
    kind, tree = _parse(path)
    if kind in _XML_MAKERS:
        problem = f"a file of {kind.capitalize()}"
        raise CalibrationError(problem, file=path, remedy="Give the path of this file itself.")
    return dict(tree)


def recognise(text: str, path: Path) -> str:
    """Detect "toml", "json", "yaml", "xml" (OpenCV), "qualisys" or "vicon" from the content; else raise FileError."""
    for program, (mark, remedy) in _FOREIGN.items():
        if text.lstrip().startswith("<") and re.search(mark, text, re.S | re.I):
            raise CalibrationError(
                "kinefit does not read this format", place=f"calibration of {program}",
                remedy=f"{remedy}, or write K, dist, R, t and size of each camera as JSON (docs/calibration.md).",
            )  # fmt: skip
    start = text.lstrip()
    if start.startswith("<"):
        tag = _xml_root(text).tag.lower()
        if tag in (roots := {"calibration": "qualisys", "opencv_storage": "xml", "cameras": "vicon"}):
            return roots[tag]
    elif start.startswith("{") or (start.startswith("[") and path.suffix.lower() == ".json"):
        return "json"
    elif start.startswith(("%YAML", "---")):
        return "yaml"
    elif re.search(r"^[ \t]*+(?:\[|[\w-]++[ \t]*+=)", text, re.M):
        return "toml"
    elif re.search(r"^[ \t]*+[\w-]++[ \t]*+:", text, re.M):
        return "yaml"
    raise FileError("not a calibration that kinefit knows", remedy=f"kinefit reads {FORMATS}.")


def _xml_root(text: str) -> ElementTree.Element:
    try:
        return parse_xml(text)
    except (ElementTree.ParseError, ValueError) as error:
        remedy = "Export it again; it may be cut."
        raise CalibrationError(f"broken XML: {error}", remedy=remedy) from None


def _chosen_unit(tables: list[dict], unit: str | float) -> str | float:
    """The unit that is asked for, else that which the tables of all cameras state."""
    stated = [find(table, "unit") for table in tables] if unit == "auto" else [unit]
    units = {one if one and type(one) in (str, int, float) else "auto" for one in stated}
    if len(units) > 1:
        problem = f"its cameras state different units: {', '.join(sorted(map(str, units)))}"
        raise CalibrationError(problem, remedy="Pass the unit that all of them have.")
    return units.pop() if units else unit


def metres_per_unit(tables: list[dict], unit: str | float) -> float:
    """Metres per unit of length of the tables of cameras; 1 if they state none."""
    return _factor(_chosen_unit(tables, unit)) or 1.0


def _factor(unit: str | float) -> float | None:
    """Metres per unit; None for "auto"."""
    if isinstance(unit, str):
        if unit == "auto":
            return None
        remedy = "Use one of these, or a number of metres."
        return metres_of(unit, CalibrationError, "unit of length", remedy=remedy)
    if not (np.isfinite(unit) and unit > 0):
        raise CalibrationError(f"unit of length {unit}", remedy="Give a positive number of metres.")
    return float(unit)


def _in_metres(camera: Camera, factor: float | None) -> Camera:
    if factor is None:
        distance = float(np.linalg.norm(camera.centre_world))
        if distance > _MAX_ORIGIN_DISTANCE:
            raise CalibrationError(
                f"stands {distance:.0f} from the world's origin, which cannot be metres", place=f"camera {camera.name}",
                remedy='Write unit = "mm" under [calibration] in the take (from Python: unit="mm").',
            )
        return camera
    T = camera.T_camera_world.copy()
    T[:3, 3] *= factor
    return camera.with_pose(T)


def _rig(cameras: list[Camera], unit: str | float) -> Rig:
    if not cameras:
        raise CalibrationError("no camera in it", remedy=f"kinefit reads {FORMATS}.")
    factor = _factor(unit)
    return Rig(tuple(_in_metres(camera, factor) for camera in cameras))


_KEY = "kinefit_found_from"


class FoundCameras(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A rig that was estimated from people; what is not the rig stands in [metadata] of its file.

    Parameters
    ----------
    rig : Rig [m]
    time_offsets : (C,) [s] to add to each camera's times, in the rig's order.
    position_sigma, rotation_sigma : float [m], [deg] standard deviations of a camera's pose.
    notes : sentences on the result and its uncertainty.
    made_from : (C,) texts that identify each camera's keypoints and settings: another text, another result; one text
        where the file is of a version that did not state them.
    height : float [m] of the person, which sets the scale; 0: unknown.
    """

    rig: Rig
    time_offsets: tuple[float, ...]
    position_sigma: Annotated[float, msgspec.Meta(ge=0.0)]
    rotation_sigma: Annotated[float, msgspec.Meta(ge=0.0)]
    notes: tuple[str, ...]
    made_from: tuple[str, ...] | str = msgspec.field(name=_KEY)
    height: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0

    def __post_init__(self) -> None:
        of_each = self.time_offsets, self.time_offsets if isinstance(self.made_from, str) else self.made_from
        if any(len(one) != len(self.rig) for one in of_each):
            raise ValueError(f"it is not of {len(self.rig)} cameras")


def write_found(found: FoundCameras, path: str | PathLike[str]) -> None:
    """Write a rig that was estimated from people; raises as `write_calibration`."""
    metadata = msgspec.structs.asdict(found)
    write_calibration(metadata.pop("rig"), path, metadata=metadata | {_KEY: metadata.pop("made_from")})


def read_found(path: str | PathLike[str]) -> FoundCameras | None:
    """Read a file of `write_found`; None where there is no file.

    Raises
    ------
    FileError, CalibrationError
        A file of something else; one of `write_found` that was damaged.
    """
    path = Path(path)
    if not path.is_file():
        return None
    remedy = "Delete it: it is made again. A calibration of your own has another name, which [calibration] states."
    if (metadata := _metadata(path)) is None:
        raise FileError("no whole file of cameras that were found from people", file=path, remedy=remedy)
    try:
        return msgspec.convert({**metadata, "rig": read_calibration(path)}, FoundCameras)
    except msgspec.ValidationError as error:
        raise FileError(f"its [metadata] is not whole: {error}", file=path, remedy=remedy) from error


def found_notes(entry: CalibrationEntry | None) -> tuple[str, ...]:
    """Notes on a take's calibration if it was estimated from people; else empty."""
    metadata = _metadata(entry.file) if entry is not None else None
    return () if metadata is None else tuple(map(str, metadata.get("notes", ())))


def _metadata(path: Path) -> dict[str, Any] | None:
    """[metadata] of a file of `write_found`; None for any other."""
    if path.suffix != ".toml" or not path.is_file():
        return None
    content = read_bytes(path)
    if _KEY.encode() not in content:
        return None
    metadata = parse_toml(content.decode("utf-8", "replace"), path).get("metadata")
    return metadata if isinstance(metadata, dict) and _KEY in metadata else None
