"""Cameras in tables of keys and values: OpenCV FileStorage (YAML, XML, JSON), Pose2Sim, aniposelib, caliscope."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._files import parse_toml
from kinefit.errors import CalibrationError, located
from kinefit.geometry.camera import Camera
from kinefit.geometry.se3 import exp_so3, inverse, transform
from kinefit.readers.calibration.file_storage import storage_of_xml, storage_of_yaml

Table = dict[str, Any]
Sizes = tuple[int, int] | Callable[[str], tuple[int, int] | None]
"""(width, height) [px] of all images, or a function of the camera's name, None where it knows none."""

# Names of each quantity in the formats, lower case, without underscores and blanks.
_KEYS = {
    "matrix": (
        "matrix", "cameramatrix", "cammatrix", "intrinsicmatrix", "intrinsics", "intrinsic", "intrinsicparameters",
        "k", "m", "mtx",
    ),
    "distortion": (
        "distortions", "distortion", "distortioncoefficients", "distortioncoeffs", "distortionparameters",
        "distcoeffs", "distcoeff", "distcoef", "distcoefs", "dist", "d",
    ),
    "size": ("size", "imagesize", "imgsize", "resolution", "imageresolution", "framesize"),
    "shape": ("imageshape", "imgshape", "frameshape"),  # as numpy has it: (height, width)
    "width": ("imagewidth", "imgwidth", "framewidth", "width", "w"),
    "height": ("imageheight", "imgheight", "frameheight", "height", "h"),
    "rotation": ("rotation", "rotationmatrix", "rotationvector", "r", "rvec", "rot", "rmat", "rotmat"),
    "translation": ("translation", "translationvector", "t", "tvec"),
    "pose": (
        "tcameraworld", "extrinsic", "extrinsics", "extrinsicmatrix", "extrinsicparameters", "rt", "tcw", "w2c",
        "worldtocamera", "worldtocam", "world2camera", "world2cam",
    ),
    "inverse pose": ("tworldcamera", "twc", "c2w", "cameratoworld", "camtoworld", "camera2world", "cam2world"),
    "model": ("distortionmodel", "model", "cameramodel"),
    **{key: (key, f"{key[0]}l{key[1]}" if key[0] == "f" else f"pp{key[1]}") for key in ("fx", "fy", "cx", "cy")},
}  # fmt: skip
_MAX_NUMBER = 1e12
"""Coefficients of distortion reach millions, and squares must not overflow."""
_FISHEYE = ("fisheye", "equidistant", "kannalabrandt")
_OTHER_MODELS = (
    "omni", "mei", "unified", "doublesphere", "eucm", "division", "fov", "scaramuzza", "ocam", "thinprism", "ftheta",
    "inverse",
)  # fmt: skip
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
_OF_PAIR = re.compile(r"(?:(M|K|mtx|camera_?[mM]atrix)|(D|dist|dist_?[cC]oeffs))_?([12])")
_PARSERS: dict[str, Callable[[str], Any]] = {"json": json.loads, "yaml": storage_of_yaml, "xml": storage_of_xml}


def read_table(text: str, kind: str, path: Path) -> Table:
    """Parse "toml", "json", "yaml" or "xml" (the last two: OpenCV FileStorage); raises CalibrationError if broken."""
    try:
        if kind == "toml":
            return dict(_matrices(parse_toml(text, path, CalibrationError)))
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
    """Nested lists of a stored OpenCV matrix (OpenCV 5 writes vectors with `sizes`); other tables unchanged."""
    of_ros = {"rows", "cols"} <= table.keys() and isinstance(table.get("data"), list)  # without dt
    if not (of_ros or {"dt", "data"} <= table.keys()):
        return table
    shape = table.get("sizes") or (table.get("rows", -1), table.get("cols", 1))  # XML gives one length as a number
    return np.array(table["data"], dtype=float).reshape([int(n) for n in np.ravel(shape).tolist()]).tolist()


def find_all(table: Table, kind: str) -> list[Any]:
    """Values in a table under any of the names of a quantity, see `_KEYS`."""
    return [value for key, value in table.items() if re.sub(r"[\W_]", "", str(key)).lower() in _KEYS[kind]]


def find(table: Table, kind: str) -> Any:
    """First value in a table under any of the names of a quantity, see `_KEYS`; None if there is none."""
    return next(iter(find_all(table, kind)), None)


def camera_tables(tree: Any, name: str) -> list[tuple[str, Table]]:
    """All tables with a camera matrix, and the camera's name (its own, else its key)."""
    if isinstance(tree, list):
        inner = [camera_tables(entry, f"{name}_{i}") for i, entry in enumerate(tree)]
        return [found for group in inner for found in group]
    if not isinstance(tree, dict):
        return []
    for part in ("intrinsics", "intrinsic", "extrinsics", "extrinsic"):  # {"intrinsics": {"K": ...}, "extrinsics": ...}
        if isinstance(tree.get(part), dict) and not _is_by_camera(tree[part]):
            tree = {key: value for key, value in tree.items() if key != part} | tree[part]
    tree = _with_scalars(_by_camera(tree))
    if find(tree, "matrix") is not None and not isinstance(find(tree, "matrix"), dict):
        own = tree.get("name") or tree.get("camera_name") or name
        return [] if tree.get("ignore") else [(str(own), tree)]
    inner = [camera_tables(value, name if key == "cameras" else str(key)) for key, value in tree.items()]
    return [found for group in inner for found in group]


def _is_by_camera(value: Any) -> bool:
    """Whether a table has a matrix for each of several cameras: {"cam1": [[...]], "cam2": ...}."""
    if not isinstance(value, dict) or not value or find(value, "matrix") is not None:
        return False
    return all(isinstance(v, list) and len(v) == 3 and isinstance(v[0], list) for v in value.values())


def _by_camera(tree: Table) -> Table:
    """Regroup a table by camera, if its keys contain the cameras' names or its values are tables by camera.

    EasyMocap's intri.yml and extri.yml have keys K_01, dist_01, Rot_01 (R_01 is the same as a vector), T_01, H_01.
    """
    matrices = find(tree, "matrix")
    if _is_by_camera(matrices):
        parts = {key: value for key, value in tree.items() if isinstance(value, dict)}
        common = {key: value for key, value in tree.items() if key not in parts}
        return {name: common | {key: part[name] for key, part in parts.items() if name in part} for name in matrices}
    names = [key[2:] for key, value in tree.items() if str(key).startswith("K_") and isinstance(value, list)]
    if not names:
        return tree
    ends = {name: f"_{name}" for name in names}
    return {
        name: {key.removesuffix(end): value for key, value in tree.items() if key.endswith(end)}
        for name, end in ends.items()
    }


def _with_scalars(table: Table) -> Table:
    """The table with fx, fy, cx, cy as a matrix and k1, k2, p1 ... as a distortion, if it has only these."""
    if "K" in table and "k" in table:  # a matrix and coefficients
        table = {"distortion" if key == "k" else key: value for key, value in table.items()}
    pinhole = [find(table, key) for key in ("fx", "fy", "cx", "cy")]
    if find(table, "matrix") is None and None not in pinhole:
        table = table | {"matrix": pinhole}
    given = find(table, "distortion")
    scalars = given if isinstance(given, dict) else table
    if (given is None or given is scalars) and "k1" in scalars:
        names = ("k1", "k2", "k3", "k4") if _is_fisheye(table) else _COEFFICIENTS
        rest = {key: value for key, value in table.items() if value is not given}
        table = rest | {"distortion": [scalars.get(key, 0.0) for key in names]}
    return table


def stereo_named(tree: Table) -> Table:
    """The table with OpenCV's names M1, D1, M2, D2, if it is a stereo pair with R and T; else unchanged."""
    named = {}
    for key, value in tree.items():
        found = _OF_PAIR.fullmatch(str(key))
        named[f"{'M' if found[1] else 'D'}{found[3]}" if found else key] = value
    return named if {"M1", "M2", "R", "T"} <= named.keys() else tree


def stereo_tables(tree: Table, path: Path, names: tuple[str, str] = ("left", "right")) -> list[tuple[str, Table]]:
    """The two cameras of OpenCV's stereo calibration; the first is the world. Lacking keys raise CalibrationError."""
    missing = [key for key in ("M1", "D1", "M2", "D2", "R", "T") if key not in tree]
    if missing:
        raise CalibrationError(
            f"{', '.join(missing)} missing in a stereo calibration",
            file=path,
            remedy="Give the folder that holds both intrinsics.yml and extrinsics.yml, or both to read_opencv_stereo.",
        )
    poses = (([0, 0, 0], [0, 0, 0]), (tree["R"], tree["T"]))
    kinds = ("size", "shape", "width", "height", "model")
    common = {key: value for kind in kinds for key, value in tree.items() if find({key: value}, kind) is not None}
    common |= {"fisheye_model": tree.get("fisheye_model", False)}
    return [
        (name, common | {"matrix": tree[f"M{i}"], "distortion": tree[f"D{i}"], "rotation": R, "translation": t})
        for i, (name, (R, t)) in enumerate(zip(names, poses), 1)
    ]


def stated_unit(tree: Table) -> str | None:
    """Unit of length that a file states, or that its program is known to use; None if neither.

    A file states `unit`, alone or under `metadata`. CMU Panoptic Studio (each camera has a `panel` and a `node`) uses
    centimetres, FreeMoCap (`metadata` has `charuco_square_size`, mostly in mm) millimetres.
    """
    metadata = tree.get("metadata")
    metadata = metadata if isinstance(metadata, dict) else {}
    for table in (tree, metadata):
        unit = table.get("unit", table.get("units"))
        if isinstance(unit, str):
            return unit
    cameras = tree.get("cameras")
    if isinstance(cameras, list) and all(isinstance(c, dict) and {"panel", "node"} <= c.keys() for c in cameras[:1]):
        return "cm" if cameras else None
    square = metadata.get("charuco_square_size")
    return "mm" if isinstance(square, int | float) and square > 1 else None  # 1: in squares of a board


def camera_from_table(
    name: str, table: Table, path: Path, *, image_size: Sizes | None, pose_needed: bool
) -> Camera:
    """Camera of one table; translation in the file's unit.

    With a transposed matrix, [[fx, 0, 0], [s, fy, 0], [cx, cy, 1]], points are rows, as in MATLAB before R2022b and in
    JARVIS: x_camera = x_world R + t, so R is transposed, too.

    Raises
    ------
    CalibrationError
        No image size; a lens model that OpenCV lacks; a missing pose; entries of a wrong shape.
    """
    place = f"camera {name}"
    K = numbers(find(table, "matrix"), None, path, f"{place}, camera matrix")
    if K.shape == (4,):
        K = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    K = numbers(K, (3, 3), path, f"{place}, camera matrix")
    of_rows = is_transposed(K)
    K = K.T if of_rows else K
    size = _size(table, path, place) or (image_size(name) if callable(image_size) else image_size)
    if size is None:
        raise CalibrationError(
            "the size of its image is missing", file=path, place=place,
            remedy="Write size = [width, height] next to its matrix, or its video or size into the take's [[camera]] "
            "(from Python: image_size=(width, height)).",
        )  # fmt: skip
    model = "fisheye" if _is_fisheye(table) else "radtan"
    named = str(find(table, "model") or "").lower().replace("_", "")
    if any(word in named for word in _OTHER_MODELS) and find(table, "distortion") is not None:
        remedy = "Undistort the videos, or calibrate again with OpenCV's model: k1, k2, p1, p2, k3, or its fisheye."
        raise CalibrationError(f"a lens of the model {find(table, 'model')}", file=path, place=place, remedy=remedy)
    given = find(table, "distortion")
    k = numbers([] if given is None else given, None, path, f"{place}, distortion").ravel()
    allowed = 8 if model == "radtan" else 4
    if k.size > allowed and not k[allowed:].any():  # OpenCV's unused thin-prism and tilt terms
        k = k[:allowed]
    return build_camera(name, size, K, k, model, _pose(table, of_rows, pose_needed, path, place), path)


def is_transposed(K: ArrayLike) -> bool:
    """Whether a camera matrix (3, 3) is transposed, for points as rows."""
    K = np.asarray(K, float) if np.shape(K) == (3, 3) else np.eye(3)
    return bool(K[2, :2].any()) and not K[:2, 2].any()


def _pose(table: Table, of_rows: bool, pose_needed: bool, path: Path, place: str) -> NDArray:
    """(4, 4) T_camera_world of a table, in the file's unit."""
    rotation, translation = find(table, "rotation"), find(table, "translation")
    for kind in ("pose", "inverse pose"):
        pose = find(table, kind)
        if pose is None:
            continue
        matrix = numbers(pose, None, path, f"{place}, pose")
        if matrix.shape not in ((3, 4), (4, 4)) or (matrix.shape == (4, 4) and np.any(matrix[3] != (0, 0, 0, 1))):
            problem = f"pose of shape {matrix.shape}" + ", whose last row is not 0 0 0 1" * (matrix.shape == (4, 4))
            raise CalibrationError(problem, file=path, place=place, remedy="Give (4, 4), a point being a column.")
        T = rigid(matrix[:3, :3], matrix[:3, 3], path, place)
        return T if kind == "pose" else inverse(T)
    if rotation is not None and translation is not None:
        R = numbers(rotation, None, path, f"{place}, rotation").squeeze()
        t = numbers(translation, (3,), path, f"{place}, translation")
        if R.shape not in ((3,), (3, 3)):
            raise CalibrationError(
                f"rotation has shape {R.shape}", file=path, place=place, remedy="Give a (3,) vector or a (3, 3) matrix."
            )
        R = exp_so3(R) if R.shape == (3,) else R.T if of_rows else R
        return rigid(R, t, path, place)
    if rotation is None and translation is None and not pose_needed:
        return np.eye(4)
    missing = " and ".join(
        key for key, value in (("rotation", rotation), ("translation", translation)) if value is None
    )
    raise CalibrationError(
        f"{missing} missing", file=path, place=place, remedy="Calibrate the extrinsics too: every camera's pose."
    )


def build_camera(
    name: str, size: tuple[int, int], K: NDArray, k: NDArray, model: str, T: NDArray, path: Path
) -> Camera:
    """Make a camera of K (3, 3), k (N,) and T_camera_world (4, 4); raises CalibrationError with the file's path."""
    with located(path):
        return Camera(name, size, K, k, model, T)


def numbers(value: Any, shape: tuple[int, ...] | None, path: Path, place: str) -> NDArray:
    """Float array of a shape such as (3, 3), None for any; raises CalibrationError if not finite or above 1e12."""
    try:
        array = np.array(value, dtype=float)
        array = array if shape is None else array.reshape(shape)
    except (TypeError, ValueError, OverflowError):
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "numbers"
        raise CalibrationError(f"expected {wanted}", file=path, place=place, remedy="Repair this entry.") from None
    if not np.isfinite(array).all() or np.abs(array).max(initial=0.0) > _MAX_NUMBER:
        problem = "a number is not finite or absurdly large"
        raise CalibrationError(problem, file=path, place=place, remedy="Repair this entry.")
    return array


def rigid(R: NDArray, t: NDArray, path: Path, place: str) -> NDArray:
    """(4, 4) transform with the nearest rotation to R (3, 3); raises CalibrationError if R is not orthonormal."""
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
    shape = find(table, "shape")
    if size is None and isinstance(shape, list) and len(shape) > 1:
        height, width = shape[:2]
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
