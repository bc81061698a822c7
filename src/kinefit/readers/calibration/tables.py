"""Cameras out of tables of keys and values: OpenCV FileStorage (YAML, XML, JSON), Pose2Sim, aniposelib, caliscope."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from kinefit._files import parse_toml
from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera
from kinefit.geometry.se3 import exp_so3, transform
from kinefit.readers.calibration.file_storage import storage_of_xml, storage_of_yaml

Table = dict[str, Any]

# Names that the formats use for one thing, lower case and without underscores.
_KEYS = {
    "matrix": ("matrix", "cameramatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "k", "m", "mtx"),
    "distortion": (
        "distortions", "distortion", "distortioncoefficients", "distcoeffs", "distcoef", "distcoefs", "dist", "d",
    ),
    "size": ("size", "imagesize", "resolution"),
    "width": ("imagewidth", "width", "w"),
    "height": ("imageheight", "height", "h"),
    "rotation": ("rotation", "rotationmatrix", "r", "rvec", "rot", "rmat"),
    "translation": ("translation", "translationvector", "t", "tvec"),
    "pose": ("tcameraworld", "extrinsic", "extrinsics", "extrinsicmatrix"),
    "model": ("distortionmodel", "model", "cameramodel"),
}  # fmt: skip
_FISHEYE = ("fisheye", "equidistant", "kannalabrandt")
_PARSERS: dict[str, Callable[[str], Any]] = {"json": json.loads, "yaml": storage_of_yaml, "xml": storage_of_xml}


def read_table(text: str, kind: str, path: Path) -> Table:
    """Parse "toml", "json", "yaml" or "xml" (the last two: OpenCV FileStorage) into nested tables."""
    try:
        if kind == "toml":
            return parse_toml(text, path, CalibrationError)
        tree = _matrices(_PARSERS[kind](text))
        return tree if isinstance(tree, dict) else {"cameras": tree}
    except (ValueError, TypeError, RecursionError, OverflowError, ElementTree.ParseError) as error:
        reason = str(error).strip().splitlines()[-1] if str(error).strip() else "broken syntax"
        raise CalibrationError(
            f"not a readable {kind.upper()} file: {reason}", file=path, remedy="Write the file again; it may be cut."
        ) from None


def _matrices(value: Any) -> Any:
    if isinstance(value, dict):
        return _matrix({key: _matrices(inner) for key, inner in value.items()})
    return [_matrices(inner) for inner in value] if isinstance(value, list) else value


def _matrix(table: Table) -> Any:
    """Array of a stored OpenCV matrix (OpenCV 5 writes vectors with `sizes`); any other table as it is."""
    if not {"dt", "data"} <= table.keys():
        return table
    shape = table.get("sizes") or (table.get("rows", -1), table.get("cols", 1))  # XML gives one length as a number
    return np.array(table["data"], dtype=float).reshape([int(n) for n in np.ravel(shape).tolist()]).tolist()


def find(table: Table, kind: str) -> Any:
    """Value that a table gives for a kind of key, under whichever of its names; None without."""
    for key, value in table.items():
        if isinstance(key, str) and key.lower().replace("_", "") in _KEYS[kind]:
            return value
    return None


def camera_tables(tree: Any, name: str) -> list[tuple[str, Table]]:
    """All tables that hold a camera matrix, with the camera's name (its own, else its key's)."""
    if isinstance(tree, list):
        inner = [camera_tables(entry, f"{name}_{i}") for i, entry in enumerate(tree)]
        return [found for group in inner for found in group]
    if not isinstance(tree, dict):
        return []
    for part in ("intrinsics", "extrinsics"):  # {"intrinsics": {"K": ...}, "extrinsics": {"R": ..., "t": ...}}
        if isinstance(tree.get(part), dict):
            tree = {key: value for key, value in tree.items() if key != part} | tree[part]
    if find(tree, "matrix") is not None and not isinstance(find(tree, "matrix"), dict):
        return [] if tree.get("ignore") else [(str(tree.get("name") or name), tree)]
    inner = [camera_tables(value, name if key == "cameras" else str(key)) for key, value in tree.items()]
    return [found for group in inner for found in group]


def stereo_tables(tree: Table, path: Path, names: tuple[str, str] = ("left", "right")) -> list[tuple[str, Table]]:
    """The two cameras of OpenCV's stereo calibration; the first is the world."""
    missing = [key for key in ("M1", "D1", "M2", "D2", "R", "T") if key not in tree]
    if missing:
        raise CalibrationError(
            f"{', '.join(missing)} missing in a stereo calibration",
            file=path,
            remedy="Give the folder that holds both intrinsics.yml and extrinsics.yml, or both to read_opencv_stereo.",
        )
    poses = (([0, 0, 0], [0, 0, 0]), (tree["R"], tree["T"]))
    common = {key: value for key, value in tree.items() if key in ("image_width", "image_height", "fisheye_model")}
    return [
        (name, common | {"matrix": tree[f"M{i}"], "distortion": tree[f"D{i}"], "rotation": R, "translation": t})
        for i, (name, (R, t)) in enumerate(zip(names, poses), 1)
    ]


def stated_unit(tree: Table) -> str | None:
    """Unit of length that a file states: `unit`, alone or under `metadata`."""
    metadata = tree.get("metadata")
    for table in (tree, metadata if isinstance(metadata, dict) else {}):
        unit = table.get("unit", table.get("units"))
        if isinstance(unit, str):
            return unit
    return None


def camera_from_table(
    name: str, table: Table, path: Path, *, image_size: tuple[int, int] | None, pose_needed: bool
) -> Camera:
    """Camera of one table; translation in the file's unit."""
    place = f"camera {name}"
    K = numbers(find(table, "matrix"), (3, 3), path, f"{place}, camera matrix")
    size = _size(table, path, place) or image_size
    if size is None:
        raise CalibrationError(
            "the size of its image is missing", file=path, place=place, remedy="Pass image_size=(width, height)."
        )
    model = "fisheye" if _is_fisheye(table) else "radtan"
    given = find(table, "distortion")
    k = numbers([] if given is None else given, None, path, f"{place}, distortion").ravel()
    allowed = 8 if model == "radtan" else 4
    if k.size > allowed and not k[allowed:].any():  # OpenCV's unused thin-prism and tilt terms
        k = k[:allowed]
    rotation, translation, pose = find(table, "rotation"), find(table, "translation"), find(table, "pose")
    if pose is not None:
        matrix = numbers(pose, None, path, f"{place}, pose")
        if matrix.shape not in ((3, 4), (4, 4)):
            raise CalibrationError(f"pose has shape {matrix.shape}", file=path, place=place, remedy="Give (4, 4).")
        T = rigid(matrix[:3, :3], matrix[:3, 3], path, place)
    elif rotation is not None and translation is not None:
        R = numbers(rotation, None, path, f"{place}, rotation").squeeze()
        t = numbers(translation, (3,), path, f"{place}, translation")
        if R.shape not in ((3,), (3, 3)):
            raise CalibrationError(
                f"rotation has shape {R.shape}", file=path, place=place, remedy="Give a (3,) vector or a (3, 3) matrix."
            )
        T = rigid(exp_so3(R) if R.shape == (3,) else R, t, path, place)
    elif rotation is None and translation is None and not pose_needed:
        T = np.eye(4)
    else:
        missing = " and ".join(
            key for key, value in (("rotation", rotation), ("translation", translation)) if value is None
        )
        raise CalibrationError(
            f"{missing} missing", file=path, place=place, remedy="Calibrate the extrinsics too: every camera's pose."
        )
    return build_camera(name, size, K, k, model, T, path)


def build_camera(
    name: str, size: tuple[int, int], K: NDArray, k: NDArray, model: str, T: NDArray, path: Path
) -> Camera:
    """Camera whose errors name the file."""
    try:
        return Camera(name, size, K, k, model, T)
    except CalibrationError as error:
        raise CalibrationError(error.problem, file=path, place=error.place, remedy=error.remedy) from None


def numbers(value: Any, shape: tuple[int, ...] | None, path: Path, place: str) -> NDArray:
    """Finite float array of a shape (any order of one column), or a typed error."""
    try:
        array = np.array(value, dtype=float)
        array = array if shape is None else array.reshape(shape)
    except (TypeError, ValueError, OverflowError):
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "numbers"
        raise CalibrationError(f"expected {wanted}", file=path, place=place, remedy="Repair this entry.") from None
    if not np.isfinite(array).all():
        raise CalibrationError("a number is not finite", file=path, place=place, remedy="Repair this entry.")
    return array


def rigid(R: NDArray, t: NDArray, path: Path, place: str) -> NDArray:
    """(4, 4) of a rotation that a file gives with few digits: the nearest exact rotation."""
    if not np.abs(R).max() <= 2:  # not finite, too
        R = np.zeros((3, 3))
    left, stretch, right = np.linalg.svd(R)
    if np.abs(stretch - 1).max() > 1e-3 or np.linalg.det(R) < 0:
        raise CalibrationError(
            "rotation is not orthonormal and right-handed",
            file=path,
            place=place,
            remedy="Give the rotation world to camera, as a proper rotation.",
        )
    return transform(left @ right, t)


def _size(table: Table, path: Path, place: str) -> tuple[int, int] | None:
    size, width, height = find(table, "size"), find(table, "width"), find(table, "height")
    if isinstance(size, dict):
        width, height, size = find(size, "width"), find(size, "height"), None
    if size is None and (width is None or height is None):
        return None
    array = numbers(size if size is not None else (width, height), (2,), path, f"{place}, image size")
    return int(array[0]), int(array[1])


def _is_fisheye(table: Table) -> bool:
    flag = table.get("fisheye", table.get("fisheye_model", False))
    model = find(table, "model")
    named = isinstance(model, str) and any(word in model.lower().replace("_", "") for word in _FISHEYE)
    return named or flag in (True, 1, "true", "True", "1")
