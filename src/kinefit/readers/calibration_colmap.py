"""Cameras of a COLMAP text model: a folder with cameras.txt and images.txt."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, choices
from kinefit.geometry.camera import Camera
from kinefit.geometry.se3 import rotation_from_quaternion
from kinefit.readers.calibration_tables import build_camera, rigid

# Parameters of every model, in COLMAP's order.
_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}
_RADTAN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")

Intrinsics = tuple[tuple[int, int], NDArray, NDArray, str]


def colmap_cameras(folder: Path) -> list[Camera]:
    """One camera an image, named after the image; translation in the model's arbitrary unit.

    COLMAP puts the centre of the first pixel at (0.5, 0.5); here it is (0, 0).
    """
    intrinsics = _cameras(folder / "cameras.txt")
    path = folder / "images.txt"
    images = _lines(path)[::2]  # every other line lists the points of the image above it
    entries = []
    for number, line in images:
        parts = line.split(maxsplit=9)
        place = f"line {number}"
        values = _floats(parts[:8], path, place)
        if len(parts) != 10 or parts[8] not in intrinsics:
            raise CalibrationError(
                "not an image of a known camera",
                file=path,
                place=place,
                remedy="Each image needs its line and a line (possibly empty) of points; cameras: "
                + ", ".join(intrinsics)
                + ".",
            )
        entries.append((place, values, intrinsics[parts[8]], PurePosixPath(parts[9])))
    stems = [image.stem for *_, image in entries]
    unique = len(set(stems)) == len(stems)
    cameras = []
    for place, values, (size, K, k, model), image in entries:
        name = image.stem if unique else str(image.with_suffix(""))
        quaternion = values[1:5]
        if not np.linalg.norm(quaternion) > 0:
            raise CalibrationError("a zero quaternion", file=path, place=place, remedy="Export the model again.")
        T = rigid(rotation_from_quaternion(quaternion), values[5:8], path, place)
        cameras.append(build_camera(name, size, K, k, model, T, path))
    return cameras


def _cameras(path: Path) -> dict[str, Intrinsics]:
    found = {}
    for number, line in _lines(path):
        place = f"line {number}"
        if not line.strip():
            continue
        parts = line.split()
        model = parts[1] if len(parts) > 1 else ""
        if model not in _MODELS:
            raise CalibrationError(
                choices("camera model", model, _MODELS), file=path, place=place, remedy="Undistort to one of these."
            )
        names = _MODELS[model].split()
        values = _floats(parts[2:], path, place)
        if len(values) != 2 + len(names):
            raise CalibrationError(
                f"{len(values) - 2} parameters", file=path, place=place, remedy=f"{model} has: {_MODELS[model]}."
            )
        given = dict(zip(names, values[2:]))
        fx, fy = given.get("f", given.get("fx")), given.get("f", given.get("fy"))
        K = np.array([[fx, 0, given["cx"] - 0.5], [0, fy, given["cy"] - 0.5], [0, 0, 1]], dtype=float)
        fisheye = "FISHEYE" in model
        k = np.array([given.get(key, 0.0) for key in (_FISHEYE if fisheye else _RADTAN)])
        found[parts[0]] = ((int(values[0]), int(values[1])), K, k, "fisheye" if fisheye else "radtan")
    return found


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines with their numbers, without comments; empty ones kept, as they mean "no points"."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise CalibrationError(
            "cannot be read as text",
            file=path,
            remedy="Convert the model: colmap model_converter --output_type TXT.",
        ) from None
    return [(i, line) for i, line in enumerate(text.splitlines(), 1) if not line.startswith("#")]


def _floats(parts: list[str], path: Path, place: str) -> NDArray:
    try:
        values = np.array([float(part) for part in parts])
    except ValueError as error:
        raise CalibrationError(str(error), file=path, place=place, remedy="Export the model again.") from None
    if not np.isfinite(values).all():
        raise CalibrationError("a number is not finite", file=path, place=place, remedy="Export the model again.")
    return values
