"""MATLAB's camera parameters, in .mat files and in JSON, as tables with OpenCV's conventions."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from kinefit._files import LENGTHS, regular, worth
from kinefit._processes import environment, python
from kinefit.errors import CalibrationError, FileError
from kinefit.readers.calibration.keys import Table, find
from kinefit.readers.calibration.tables import is_transposed, numbers

_AS_STRUCT = "In MATLAB: s = toStruct(params); save('calibration.mat', '-struct', 's', '-v7')"
_MAX_READ_S = 60.0  # of a file; one of 20 MB takes 3 s on a slow computer


def read_mat(path: Path) -> Table:
    """Variables of a .mat file as tables; matrices of cameras count pixels from one, and sizes are (rows, columns).

    Raises
    ------
    FileError
        No file of MATLAB, one that is damaged, or one of version 7.3.
    CalibrationError
        Objects in place of structs.
    """
    answer: dict[str, Any]
    words = python(str(Path(__file__).with_name("mat_file.py")), str(regular(path)))
    try:
        done = subprocess.run(words, env=environment(), capture_output=True, timeout=_MAX_READ_S)
        answer = json.loads(done.stdout) if done.returncode == 0 else {"damage": "scipy's reader crashes on it"}
    except subprocess.TimeoutExpired:
        answer = {"damage": f"scipy's reader does not end within {_MAX_READ_S:.0f} s"}
    if "version" in answer:
        remedy = "Save it again: save('calibration.mat', '-struct', 's', '-v7')."
        raise FileError("a MATLAB file of version 7.3, which kinefit does not read", remedy=remedy)
    if "object" in answer:
        raise CalibrationError("MATLAB objects, which only MATLAB reads", remedy=f"{_AS_STRUCT}.")
    if "damage" in answer:
        raise FileError(f"not a readable MATLAB file: {answer['damage']}", remedy="Save it again.")
    variables = answer["variables"]
    pair = next((v for v in variables.values() if isinstance(v, dict) and "CameraParameters1" in v), variables)
    return matlab_tree(pair, of_mat=True)


def matlab_tree(tree: Any, of_mat: bool = False) -> Any:
    """Convert MATLAB's cameras in a tree to OpenCV's conventions; all else is kept.

    MATLAB's `toStruct` gives ImageSize (rows, columns), RadialDistortion (k1 k2 [k3]), TangentialDistortion (p1 p2),
    and K, or before R2022b IntrinsicMatrix = Kᵀ; the centre of the first pixel is (1, 1) (`cameraIntrinsicsToOpenCV`
    takes one off). Of a stereo pair RotationOfCamera2 and TranslationOfCamera2 are for points as rows: x2 = x1 R + t;
    the first camera is the world. `of_mat`: tables with other names have the same pixel and size conventions.

    Raises
    ------
    CalibrationError
        MATLAB's fisheye model; entries of a wrong shape; a principal point outside of the image.
    """
    if isinstance(tree, list):
        return [matlab_tree(inner, of_mat) for inner in tree]
    if not isinstance(tree, dict):
        return tree
    if isinstance(tree.get("CameraParameters1"), dict) and isinstance(tree.get("CameraParameters2"), dict):
        unit = tree["CameraParameters1"].get("WorldUnits")
        stated = {"unit": unit} if isinstance(unit, str) and worth(unit, LENGTHS) is not None else {}
        return {"cameras": _stereo(tree)} | stated
    if "MappingCoefficients" in tree:
        remedy = "Undistort the videos in MATLAB (undistortFisheyeImage), and give the parameters that it returns."
        raise CalibrationError("MATLAB's fisheye model (Scaramuzza's)", remedy=remedy)
    matrix = find(tree, "matrix")
    if "RadialDistortion" not in tree and not (of_mat and isinstance(matrix, list)):
        return {key: matlab_tree(value, of_mat) for key, value in tree.items()}
    K = numbers(matrix, (3, 3), "camera matrix")
    shift = np.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, 0]])
    rest = {key: value for key, value in tree.items() if value is not matrix and key != "WorldUnits"}  # of the board
    out = {"matrix": (K - (shift.T if is_transposed(K) else shift)).tolist()}
    size = find(rest, "size")
    if isinstance(size, list) and len(size) == 2:
        rows, columns = numbers(size, (2,), "ImageSize")
        across, down = (K.T if is_transposed(K) else K)[:2, 2]
        if not (0 < across <= columns and 0 < down <= rows):
            where = f"({across:.0f}, {down:.0f})"
            problem = f"the principal point {where} lies outside {rows:.0f} rows x {columns:.0f} columns"
            raise CalibrationError(problem, remedy="Write ImageSize as [rows, columns], as MATLAB does.")
        rest = {key: value for key, value in rest.items() if value is not size}
        out["size"] = [columns, rows]
    return rest | out


def _stereo(tree: Table) -> list[Table]:
    """Both cameras of `toStruct(stereoParams)`; the first is the world."""
    first, second = (matlab_tree(tree[f"CameraParameters{i}"]) for i in (1, 2))
    pose = tree.get("PoseCamera2")
    if isinstance(pose, dict):
        R, t = pose.get("R"), pose.get("Translation")
    else:
        R = np.transpose(numbers(tree.get("RotationOfCamera2"), (3, 3), "RotationOfCamera2")).tolist()
        t = tree.get("TranslationOfCamera2")
    if is_transposed(find(second, "matrix")):
        second = second | {"matrix": np.transpose(find(second, "matrix")).tolist()}
    zero = {"rotation": [0, 0, 0], "translation": [0, 0, 0]}
    return [{"name": "left"} | first | zero, {"name": "right"} | second | {"rotation": R, "translation": t}]
