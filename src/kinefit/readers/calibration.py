"""Calibrations of cameras: any usual file or folder -> `Rig`; and back, as Pose2Sim TOML."""

from __future__ import annotations

import json
import os
import re
import tempfile
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from kinefit.errors import CalibrationError, ExportError, FileError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import log_so3
from kinefit.readers.calibration_colmap import colmap_cameras
from kinefit.readers.calibration_qualisys import qualisys_cameras
from kinefit.readers.calibration_tables import (
    camera_from_table, camera_tables, numbers, read_table, rigid, stated_unit,
)  # fmt: skip

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254}  # [m]
FORMATS = (
    "OpenCV YAML/XML/JSON, Pose2Sim, aniposelib or caliscope TOML, Qualisys .qca XML, COLMAP text "
    "(cameras.txt and images.txt)"
)
_FARTHEST = 200.0  # [m] a camera farther from the world's origin was not measured in metres


def read_calibration(
    path: str | PathLike[str], *, unit: str | float = "auto", image_size: tuple[int, int] | None = None
) -> Rig:
    """Read the cameras of a calibration; its format is recognised from its content.

    Parameters
    ----------
    path : file or folder
        OpenCV YAML/XML/JSON (one file with all cameras, or a folder with one file a camera, or with
        intrinsics.yml and extrinsics.yml of a stereo pair), Pose2Sim, aniposelib or caliscope TOML, Qualisys .qca XML,
        COLMAP text (the folder). Poses are world to camera. A single camera without a pose becomes the world.
    unit : "auto", "m", "dm", "cm", "mm", "inch" or float [m]
        Unit of length of the file. "auto": what the file states (`unit = "mm"`, alone or under [metadata]), or what
        its format defines (Qualisys: mm), else metres unless that cannot be.
    image_size : (width, height) [px], optional
        Size of the images, for files that do not state it.

    Returns
    -------
    Rig
        In metres, pixels with (0, 0) in the centre of the first.

    Raises
    ------
    FileError
        Where the file is missing or of no known format.
    CalibrationError
        Where a camera cannot be used: missing key, wrong shape, not finite, wrong unit.
    """
    path = Path(path)
    if not path.exists():
        raise FileError("no such file or folder", file=path, remedy="Check the path of the calibration.")
    if path.is_dir():
        return _read_folder(path, unit, image_size)
    if path.name in ("cameras.txt", "images.txt"):
        return _read_folder(path.parent, unit, image_size)
    text = _read_text(path)
    kind = _recognise(text, path)
    if kind == "qualisys":
        cameras = qualisys_cameras(ElementTree.fromstring(text), path)
        return _rig(cameras, path, "mm" if unit == "auto" else unit)
    return _read_tables(path, kind, text, unit, image_size)


def read_opencv_stereo(
    intrinsics: str | PathLike[str],
    extrinsics: str | PathLike[str],
    *,
    image_size: tuple[int, int],
    unit: str | float = "auto",
    names: tuple[str, str] = ("left", "right"),
) -> Rig:
    """Read the pair of files that OpenCV's stereo calibration writes (M1, D1, M2, D2 and R, T).

    The first camera is the world. Its unit is that of the board's squares: give its length in metres as `unit`.
    """
    first, second = Path(intrinsics), Path(extrinsics)
    inner, outer = (_tree(path) for path in (first, second))
    for table, keys, path in ((inner, ("M1", "D1", "M2", "D2"), first), (outer, ("R", "T"), second)):
        for key in keys:
            if key not in table:
                raise CalibrationError(
                    f"key {key} missing", file=path, remedy="Give the files of OpenCV's stereo_calib sample."
                )
    R = numbers(outer["R"], (3, 3), second, "R")
    t = numbers(outer["T"], (3,), second, "T")
    cameras = []
    for i, (name, T) in enumerate(zip(names, (np.eye(4), rigid(R, t, second, "R"))), 1):
        table = {"matrix": inner[f"M{i}"], "distortion": inner[f"D{i}"]}
        camera = camera_from_table(name, table, first, image_size=image_size, pose_needed=False)
        cameras.append(camera.with_pose(T))
    return _rig(cameras, second, _chosen_unit(outer, unit))


def write_calibration(rig: Rig, path: str | PathLike[str]) -> None:
    """Write a rig as Pose2Sim TOML, in metres; the file appears whole or not at all.

    Raises
    ------
    ExportError
        Where it cannot be written.
    CalibrationError
        Where a camera has what the format lacks.
    """
    path = Path(path)
    text = "\n".join([*(_toml(camera, path) for camera in rig), '[metadata]\nadjusted = false\nerror = 0.0\nunit = "m"\n'])
    temporary = None
    try:
        with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, encoding="utf-8", newline="\n") as out:
            temporary = out.name
            out.write(text)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        raise ExportError(
            f"cannot be written: {error.strerror}", file=path, remedy="Choose a folder that exists and has room."
        ) from None


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


def _read_folder(folder: Path, unit: str | float, image_size: tuple[int, int] | None) -> Rig:
    if (folder / "cameras.txt").exists() or (folder / "cameras.bin").exists():
        return _rig(colmap_cameras(folder), folder, unit)
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in (".yml", ".yaml", ".xml", ".json", ".toml"))
    stems = {f.stem: f for f in files}
    if {"intrinsics", "extrinsics"} <= stems.keys():
        if image_size is None:
            raise CalibrationError(
                "these files do not state the size of the images",
                file=stems["intrinsics"],
                remedy="Pass image_size=(width, height).",
            )
        return read_opencv_stereo(stems["intrinsics"], stems["extrinsics"], image_size=image_size, unit=unit)
    if not files:
        raise FileError("no calibration in this folder", file=folder, remedy=f"kinefit reads {FORMATS}.")
    cameras = []
    for file in files:
        tree = _tree(file)
        factor = _factor(_chosen_unit(tree, unit), file)
        for name, table in camera_tables(tree, file.stem):
            camera = camera_from_table(name, table, file, image_size=image_size, pose_needed=len(files) > 1)
            cameras.append(_in_metres(camera, factor, file))
    return _rig(cameras, folder, 1.0)


def _read_tables(path: Path, kind: str, text: str, unit: str | float, image_size: tuple[int, int] | None) -> Rig:
    tree = read_table(text, kind, path)
    tables = camera_tables(tree, path.stem)
    cameras = [
        camera_from_table(name, table, path, image_size=image_size, pose_needed=len(tables) > 1)
        for name, table in tables
    ]
    return _rig(cameras, path, _chosen_unit(tree, unit))


def _tree(path: Path) -> dict:
    text = _read_text(path)
    kind = _recognise(text, path)
    if kind == "qualisys":
        raise CalibrationError("a Qualisys file", file=path, remedy="Give the path of this file itself.")
    tree = read_table(text, kind, path)
    return tree if isinstance(tree, dict) else {"cameras": tree}


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        raise FileError("cannot be read as text", file=path, remedy=f"kinefit reads {FORMATS}.") from None


def _recognise(text: str, path: Path) -> str:
    """Tell "toml", "json", "yaml", "xml" (OpenCV) or "qualisys" from the content."""
    start = text.lstrip()
    if start.startswith("<"):
        try:
            tag = ElementTree.fromstring(text).tag
        except ElementTree.ParseError as error:
            raise CalibrationError(f"broken XML: {error}", file=path, remedy="Export it again; it may be cut.") from None
        if tag in ("calibration", "opencv_storage"):
            return "qualisys" if tag == "calibration" else "xml"
    elif start.startswith("{") or (start.startswith("[") and path.suffix.lower() == ".json"):
        return "json"
    elif start.startswith(("%YAML", "---")):
        return "yaml"
    elif re.search(r"^\s*\[", text, re.M) or re.search(r"^\s*[\w-]+\s*=", text, re.M):
        return "toml"
    elif re.search(r"^\s*[\w-]+\s*:", text, re.M):
        return "yaml"
    raise FileError("not a calibration that kinefit knows", file=path, remedy=f"kinefit reads {FORMATS}.")


def _chosen_unit(tree: dict, unit: str | float) -> str | float:
    return unit if unit != "auto" else (stated_unit(tree) or "auto")


def _factor(unit: str | float, path: Path) -> float | None:
    """Metres per unit; None for "auto"."""
    if isinstance(unit, str):
        if unit == "auto":
            return None
        if unit not in UNITS:
            raise CalibrationError(
                f"unknown unit of length '{unit}'", file=path, remedy=f"Units: {', '.join(UNITS)}, or metres a unit."
            )
        return UNITS[unit]
    if not (np.isfinite(unit) and unit > 0):
        raise CalibrationError(f"unit of length {unit}", file=path, remedy="Give a positive number of metres.")
    return float(unit)


def _in_metres(camera: Camera, factor: float | None, path: Path) -> Camera:
    if factor is None:
        distance = float(np.linalg.norm(camera.centre_world))
        if distance > _FARTHEST:
            raise CalibrationError(
                f"stands {distance:.0f} from the world's origin, which cannot be metres",
                file=path,
                place=f"camera {camera.name}",
                remedy='Pass unit="mm", or write unit = "mm" (under [metadata] in TOML).',
            )
        return camera
    T = camera.T_camera_world.copy()
    T[:3, 3] *= factor
    return camera.with_pose(T)


def _rig(cameras: list[Camera], path: Path, unit: str | float) -> Rig:
    if not cameras:
        raise CalibrationError("no camera in it", file=path, remedy=f"kinefit reads {FORMATS}.")
    factor = _factor(unit, path)
    try:
        return Rig(tuple(_in_metres(camera, factor, path) for camera in cameras))
    except CalibrationError as error:
        if error.file is not None:
            raise
        raise CalibrationError(error.problem, file=path, place=error.place, remedy=error.remedy) from None
