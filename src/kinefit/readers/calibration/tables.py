"""Cameras in tables of keys and values: OpenCV FileStorage (YAML, XML, JSON), Pose2Sim, aniposelib, caliscope."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._files import parse_toml
from kinefit.errors import CalibrationError, located
from kinefit.geometry.camera import Camera
from kinefit.geometry.se3 import exp_so3, inverse, rotation_from_quaternion, transform
from kinefit.readers.calibration import keys
from kinefit.readers.calibration.file_storage import storage_of_xml, storage_of_yaml

Sizes = tuple[int, int] | Callable[[str], tuple[int, int] | None]
"""(width, height) [px] of all images, or a function of the camera's name, None where it knows none."""

_MAX_NUMBER = 1e12
"""Coefficients of distortion reach millions, and squares must not overflow."""
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
_PARTS_OF_LENS = ("radial", "tangential")
_OPENGL_AXES = np.diag([1.0, -1.0, -1.0])  # its cameras look along -z with y up
_MAX_ROTATION = 2 * np.pi + 1e-6  # [rad] of a rotation vector; the shortest one of a rotation has at most pi
_MAX_STRETCH = 1e-3  # of a rotation's singular values from 1
_MAX_QUATERNION_ERROR = 0.05  # of its length from 1: rounding to two decimals makes 0.01
_PARSERS: dict[str, Callable[[str], Any]] = {"json": json.loads, "yaml": storage_of_yaml, "xml": storage_of_xml}


def read_table(text: str, kind: str) -> keys.Table:
    """Parse "toml", "json", "yaml" or "xml" (the last two: OpenCV FileStorage); raises CalibrationError if broken."""
    try:
        if kind == "toml":
            return dict(_matrices(parse_toml(text, None, CalibrationError)))
        tree = _matrices(_PARSERS[kind](text))
        return tree if isinstance(tree, dict) else {"cameras": tree}
    except (ValueError, TypeError, RecursionError, OverflowError, ElementTree.ParseError) as error:
        reason = next(reversed(str(error).strip().splitlines()), "broken syntax")
        reason = "nested too deeply" if isinstance(error, RecursionError) else reason
        problem = f"not a readable {kind.upper()} file: {reason}"
        raise CalibrationError(problem, remedy="Write the file again; it may be cut.") from None


def _matrices(value: Any) -> Any:
    if isinstance(value, dict):
        return _matrix({key: _matrices(inner) for key, inner in value.items()})
    return [_matrices(inner) for inner in value] if isinstance(value, list) else value


def _matrix(table: keys.Table) -> Any:
    """Nested lists of a stored OpenCV matrix (OpenCV 5 writes vectors with `sizes`); other tables unchanged."""
    of_ros = {"rows", "cols"} <= table.keys() and isinstance(table.get("data"), list)  # without dt
    if not (of_ros or {"dt", "data"} <= table.keys()):
        return table
    shape = table.get("sizes") or (table.get("rows", -1), table.get("cols", 1))  # XML gives one length as a number
    return np.array(table["data"], dtype=float).reshape([int(n) for n in np.ravel(shape).tolist()]).tolist()


def camera_from_table(name: str, table: keys.Table, *, image_size: Sizes | None, pose_needed: bool | None) -> Camera:
    """Camera of one table; translation in the file's unit. `pose_needed`: None where nothing is asked of its pose.

    With a transposed matrix, [[fx, 0, 0], [s, fy, 0], [cx, cy, 1]], points are rows, as in MATLAB before R2022b and in
    JARVIS: x_camera = x_world R + t, so R is transposed, too.

    Raises
    ------
    CalibrationError
        No image size; a lens model that OpenCV lacks; a missing pose; entries of a wrong shape; a key that speaks of
        the lens, the pose or a convention and that kinefit does not read.
    """
    with located(None, f"camera {name}"):
        model = keys.lens_model(table)
        K = numbers(keys.find(table, "matrix"), None, "camera matrix")
        if K.shape == (4,):
            skew = numbers(keys.find(table, "skew") or 0.0, (), "skew")
            K = np.array([[K[0], skew, K[2]], [0, K[1], K[3]], [0, 0, 1]])
        K = numbers(K, (3, 3), "camera matrix")
        of_rows = is_transposed(K)
        size = _size(table) or (image_size(name) if callable(image_size) else image_size)
        if size is None:
            raise CalibrationError(
                "the size of its image is missing", remedy="Write size = [width, height] next to its matrix, or its "
                "video or size into the take's [[camera]] (from Python: image_size=(width, height)).",
            )  # fmt: skip
        with located(None, "distortion"):
            k = _distortion(table, model)
        T = _pose(table, of_rows, pose_needed)
        keys.refuse_unread(table, has_lens=k is not None, has_pose=T is not None or pose_needed is None)
    lens = np.zeros(0) if k is None else k
    return Camera(name, size, K.T if of_rows else K, lens, model, np.eye(4) if T is None else T)


def _distortion(table: keys.Table, model: str) -> NDArray | None:
    """Coefficients (k,) of the model in OpenCV's order; None if the table has none."""
    radial, tangential = (numbers(keys.find(table, kind) or []).ravel() for kind in _PARTS_OF_LENS)
    scalars = {keys.spelled(key): value for key, value in table.items() if keys.kind_of(str(key)) == "coefficient"}
    scalars = {key: value for key, value in scalars.items() if not isinstance(value, list | dict)}  # P1: a matrix
    names = _COEFFICIENTS if model == "radtan" else ("k1", "k2", "k3", "k4")
    odd = [key for key in scalars if scalars[key] and (key not in names or (key == "k4" and "k5" not in scalars))]
    if odd and (model == "radtan" or odd != ["k4"]):
        remedy = 'Write model = "fisheye" if it is (k1 k2 k3 k4 alone), else calibrate with k1, k2, p1, p2, k3.'
        raise CalibrationError(f"{', '.join(odd)} of a lens whose model is not OpenCV's", remedy=remedy)
    given = [numbers(value).ravel() for value in keys.find_all(table, "distortion")]
    if radial.size:
        first, second = (np.pad(part, (0, max(0, 2 - part.size))) for part in (radial, tangential))
        ordered = [first[:2], second, first[2:]] if model == "radtan" else [radial, tangential]
        given.append(np.concatenate(ordered))
    if scalars:
        given.append(numbers([scalars.get(key, 0.0) for key in names]))
    allowed = 8 if model == "radtan" else 4  # OpenCV writes unused thin-prism and tilt terms behind these
    given = [k if k[allowed:].any() else k[:allowed] for k in given]
    if any(not np.array_equal(np.trim_zeros(k, "b"), np.trim_zeros(given[0], "b")) for k in given[1:]):
        raise CalibrationError("stated twice, differently", remedy="Remove the wrong one.")
    return given[0] if given else None


def is_transposed(K: ArrayLike) -> bool:
    """Whether a camera matrix (3, 3) is transposed, for points as rows."""
    K = np.asarray(K, float) if np.shape(K) == (3, 3) else np.eye(3)
    return bool(K[2, :2].any()) and not K[:2, 2].any()


def _pose(table: keys.Table, of_rows: bool, pose_needed: bool | None) -> NDArray | None:
    """(4, 4) T_camera_world of a table, in the file's unit; None if it has none and needs none."""
    said = keys.conventions(table)
    T = _as_written(table, of_rows)
    if T is None:
        rotation, translation = (keys.find(table, kind) is None for kind in ("rotation", "translation"))
        if rotation and translation and not pose_needed:
            return None
        missing = " and ".join(["rotation"] * rotation + ["translation"] * translation)
        remedy = "Calibrate the extrinsics too: every camera's pose."
        raise CalibrationError(f"{missing} missing", remedy=remedy)
    if "c2w" in said and keys.find(table, "inverse pose") is None:
        T = inverse(T)
    return transform(_OPENGL_AXES, np.zeros(3)) @ T if "opengl" in said else T


def _as_written(table: keys.Table, of_rows: bool) -> NDArray | None:
    """(4, 4) transform of a table from world to camera, as its keys' names have it; None if it has none."""
    for kind in ("pose", "inverse pose"):
        pose = keys.find(table, kind)
        matrix = numbers([] if pose is None else pose, None, "pose")
        if pose is None or (matrix.ndim == 2 and matrix.shape[1] == 6):  # OpenCV's views of the board
            continue
        matrix = matrix.reshape(-1, 4) if matrix.size in (12, 16) and 1 in (matrix.ndim, *matrix.shape) else matrix
        if matrix.shape not in ((3, 4), (4, 4)) or (matrix.shape == (4, 4) and np.any(matrix[3] != (0, 0, 0, 1))):
            problem = f"pose of shape {matrix.shape}" + ", whose last row is not 0 0 0 1" * (matrix.shape == (4, 4))
            raise CalibrationError(problem, remedy="Give (4, 4), a point being a column.")
        T = rigid(matrix[:3, :3], matrix[:3, 3])
        return T if kind == "pose" else inverse(T)
    rotation, translation = keys.find(table, "rotation"), keys.find(table, "translation")
    if rotation is None or translation is None:
        return None
    R = numbers(rotation, None, "rotation").squeeze()
    t = numbers(translation, (3,), "translation")
    R = R.reshape(3, 3) if R.shape == (9,) else R
    if R.shape not in ((3,), (3, 3)):
        raise CalibrationError(f"rotation has shape {R.shape}", remedy="Give a (3,) vector or a (3, 3) matrix.")
    if R.shape == (3,) and np.linalg.norm(R) > _MAX_ROTATION:
        problem = f"a rotation vector of {np.linalg.norm(R):.1f} radians, which is more than one turn"
        remedy = "It may be in degrees, or be three angles: write a vector in radians, or the (3, 3) matrix."
        raise CalibrationError(problem, remedy=remedy)
    return rigid(exp_so3(R) if R.shape == (3,) else R.T if of_rows else R, t)


def numbers(value: Any, shape: tuple[int, ...] | None = None, place: str | None = None) -> NDArray:
    """Float array of a shape such as (3, 3), None for any; raises CalibrationError if not finite or above 1e12."""
    try:
        array = np.array(value, dtype=float)
        array = array if shape is None else array.reshape(shape)
    except (TypeError, ValueError, OverflowError):
        wanted = f"{' x '.join(map(str, shape))} numbers" if shape else "numbers"
        raise CalibrationError(f"expected {wanted}", place=place, remedy="Repair this entry.") from None
    if not np.isfinite(array).all() or np.abs(array).max(initial=0.0) > _MAX_NUMBER:
        problem = "missing" if value is None else "a number is not finite or absurdly large"
        raise CalibrationError(problem, place=place, remedy="Repair this entry.")
    return array


def rigid(R: NDArray, t: NDArray) -> NDArray:
    """(4, 4) transform with the nearest rotation to R (3, 3); raises CalibrationError if R is not orthonormal."""
    left, stretch, right = np.linalg.svd(R)
    problem, remedy = "", "Give the rotation world to camera, as a proper rotation."
    if np.ptp(stretch) > _MAX_STRETCH or not stretch.all():
        problem = "rotation is not orthonormal and right-handed"
    elif abs(stretch.mean() - 1) > _MAX_STRETCH:
        problem = f"rotation is scaled by {stretch.mean():.4g}, so it is not orthonormal"
        remedy = "If it is the scale of a reconstruction, divide rotation and translation by it."
    elif np.linalg.det(R) < 0:
        problem = "rotation mirrors: its determinant is -1, so it is not right-handed"
        remedy = "Are its axes left-handed (Unity, Unreal)? Negate one axis of the world, or of the camera."
    if problem:
        raise CalibrationError(problem, remedy=remedy)
    return transform(left @ right, t)


def rotation_of(quaternion: NDArray) -> NDArray:
    """Rotation (3, 3) of a quaternion (4,) w x y z; raises CalibrationError if its length is not 1."""
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > _MAX_QUATERNION_ERROR:
        remedy = "Calibrate this camera again, or export the calibration again."
        raise CalibrationError(f"a quaternion of length {length:.3g}, not 1", remedy=remedy)
    return rotation_from_quaternion(quaternion)


def _size(table: keys.Table) -> tuple[int, int] | None:
    size, width, height = keys.find(table, "size"), keys.find(table, "width"), keys.find(table, "height")
    shape = keys.find(table, "shape")
    if size is None and isinstance(shape, list) and len(shape) > 1:
        height, width = shape[:2]
    if isinstance(size, dict):
        width, height, size = keys.find(size, "width"), keys.find(size, "height"), None
    if size is None and (width is None or height is None):
        return None
    array = numbers(size if size is not None else (width, height), (2,), "image size")
    return int(array[0]), int(array[1])

