"""Cameras of a COLMAP text model: a folder with cameras.txt and images.txt."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular
from kinefit.errors import CalibrationError, check_choice, located
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import quaternion
from kinefit.readers.calibration.tables import numbers, rigid, rotation_of

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

_POINTS = re.compile(r"(?:[-+.\deE]++\s++[-+.\deE]++\s++(?:-1|\d++)(?:\s++|$))+")
"""X Y POINT3D_ID of each point; an image's line ends in a name, and has ten parts where that has no blank."""

Intrinsics = tuple[tuple[int, int], NDArray, NDArray, str]


def colmap_cameras(folder: Path) -> list[Camera]:
    """Read one camera for each image, named after it; translations in the model's arbitrary unit.

    COLMAP puts the centre of the first pixel at (0.5, 0.5); here it is (0, 0).

    Raises
    ------
    CalibrationError
        No text model, an unknown lens model, an image without its camera, numbers that are missing or not finite.
    """
    intrinsics = _cameras(folder / "cameras.txt")
    entries: list[tuple[PurePosixPath, Intrinsics, NDArray]] = []
    for number, line in _images(path := folder / "images.txt"):
        parts = line.split(maxsplit=9)
        with located(path, f"line {number}"):
            values = numbers(parts[:8])
            if len(parts) != 10 or parts[8] not in intrinsics:
                remedy = "An image's line is: ID QW QX QY QZ TX TY TZ CAMERA_ID NAME. Its points may follow in one "
                remedy += f"line of X Y POINT3D_ID each. Cameras: {', '.join(intrinsics)}."
                raise CalibrationError("not an image of a known camera", remedy=remedy)
            T = rigid(rotation_of(values[1:5]), values[5:8])
        entries.append((PurePosixPath(parts[9]), intrinsics[parts[8]], T))
    names = image_names([image for image, *_ in entries])
    return [Camera(name, *lens, T) for name, (_, lens, T) in zip(names, entries)]


def image_names(images: list[PurePosixPath]) -> list[str]:
    """Names of the cameras of images: file names without folder and ending, or with the folder if two are equal."""
    stems = [image.stem for image in images]
    return stems if len(set(stems)) == len(stems) else [str(image.with_suffix("")) for image in images]


def colmap_texts(rig: Rig, folder: Path, metres_per_unit: float) -> dict[str, str]:
    """Texts of cameras.txt and images.txt with the rig's cameras, matched by image names; all else is kept.

    A lens that the camera's model cannot represent gets the smallest model that can.

    Parameters
    ----------
    folder : of the model
    metres_per_unit : float [m]

    Raises
    ------
    CalibrationError
        Images that share a camera and now differ in their lens; a model that cannot be read.
    """
    path = folder / "images.txt"
    images = [(number, line.split(maxsplit=9)) for number, line in _images(path)]
    texts = {name: regular(folder / name).read_text("utf-8").splitlines() for name in ("cameras.txt", "images.txt")}
    owners: dict[str, Camera] = {}
    for name, (number, parts) in zip(image_names([PurePosixPath(parts[9]) for _, parts in images]), images):
        if name not in rig:
            continue
        camera, owner = rig[name], owners.setdefault(parts[8], rig[name])
        if not (np.array_equal(camera.matrix, owner.matrix) and np.array_equal(camera.distortion, owner.distortion)):
            problem = f"images {owner.name} and {name} share camera {parts[8]}, but now differ in their lens"
            remedy = "Give each its own camera in cameras.txt."
            raise CalibrationError(problem, file=path, place=f"line {number}", remedy=remedy)
        T = camera.T_camera_world
        pose = [*quaternion(T[:3, :3]), *(T[:3, 3] / metres_per_unit)]
        texts["images.txt"][number - 1] = " ".join([parts[0], *(repr(float(v)) for v in pose), *parts[8:]])
    for number, line in _lines(folder / "cameras.txt"):
        parts = line.split()
        if parts and parts[0] in owners:
            texts["cameras.txt"][number - 1] = _camera_line(parts[0], parts[1], owners[parts[0]])
    return {name: "\n".join(lines) + "\n" for name, lines in texts.items()}


def _camera_line(number: str, model: str, camera: Camera) -> str:
    K, k = camera.matrix, camera.distortion
    fisheye = camera.model == "fisheye"
    given = {"f": K[0, 0], "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    lens = dict(zip(_FISHEYE if fisheye else _RADTAN, k))
    for name in (model, "OPENCV_FISHEYE") if fisheye else (model, "PINHOLE", "OPENCV", "FULL_OPENCV"):
        keys = _MODELS[name].split()
        square = "f" not in keys or given["fx"] == given["fy"]
        if square and all(key in keys for key, value in lens.items() if value) and ("FISHEYE" in name) == fisheye:
            break
    values = [repr(float((given | lens).get(key, 0.0))) for key in keys]
    return " ".join([number, name, *map(str, camera.size), *values])


def _cameras(path: Path) -> dict[str, Intrinsics]:
    found = {}
    for number, line in _lines(path):
        if not (parts := line.split()):
            continue
        model = parts[1] if len(parts) > 1 else ""
        with located(path, f"line {number}"):
            check_choice("camera model", model, _MODELS, CalibrationError, remedy="Undistort to one of these.")
            names, values = _MODELS[model].split(), numbers(parts[2:])
            if len(values) != 2 + len(names):
                raise CalibrationError(f"{len(values) - 2} parameters", remedy=f"{model} has: {_MODELS[model]}.")
        given = dict(zip(names, values[2:]))
        fx, fy = given.get("f", given.get("fx")), given.get("f", given.get("fy"))
        K = np.array([[fx, 0, given["cx"] - 0.5], [0, fy, given["cy"] - 0.5], [0, 0, 1]], dtype=float)
        fisheye = "FISHEYE" in model
        k = np.array([given.get(key, 0.0) for key in (_FISHEYE if fisheye else _RADTAN)])
        found[parts[0]] = ((int(values[0]), int(values[1])), K, k, "fisheye" if fisheye else "radtan")
    return found


def _images(path: Path) -> list[tuple[int, str]]:
    """Lines of images with their numbers; after each, one line of its points is left out, where there is one."""
    found = []
    may_be_points = False
    for number, line in _lines(path):
        if line.strip():
            may_be_points = may_be_points and _POINTS.fullmatch(line.strip()) is not None
            found += [] if may_be_points else [(number, line)]
            may_be_points = not may_be_points
    return found


def _lines(path: Path) -> list[tuple[int, str]]:
    """Lines with their numbers, without comments."""
    try:
        text = regular(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        converter = f"colmap model_converter --input_path {path.parent} --output_path {path.parent} --output_type TXT"
        remedy = f"Convert a binary model: {converter}."
        raise CalibrationError("cannot be read as text", file=path, remedy=remedy) from None
    return [(i, line) for i, line in enumerate(text.splitlines(), 1) if not line.lstrip().startswith("#")]

