"""Tables of cameras in a parsed file, also of programs that state lenses and poses apart: Kalibr, multical, NeRF."""

from __future__ import annotations

import re
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from kinefit.errors import CalibrationError
from kinefit.geometry.se3 import transform
from kinefit.readers.calibration.keys import Table, find, kind_of, spelled, statements
from kinefit.readers.calibration.programs import image_names
from kinefit.readers.calibration.tables import numbers

_KINDS_OF_PARTS = ("matrix", "distortion", "pose", "inverse pose", "lens model", "model")
_PART = re.compile(r"(?:projection|distortion|mirror)(?:parameters)?|lens")
"""Keys of tables within a camera's table, other than those of a quantity."""
_OF_PAIR = re.compile(r"(?:(M|K|mtx|camera_?[mM]atrix)|(D|dist|dist_?[cC]oeffs))_?([12])")


def tables_of(tree: Table, name: str, exteriors: bool = True) -> list[tuple[str, Table]]:
    """All tables of a parsed file that hold a camera, with the camera's name.

    Parameters
    ----------
    name : of a camera that has none
    exteriors : whether poses are needed

    Raises
    ------
    CalibrationError
        A pose of a chain that cannot be read, cameras without a common world, a stereo pair that lacks a key.
    """
    tree = _of_transforms(_of_multical(_of_kalibr(stereo_named(tree))))
    unit = unit_of_program(tree)
    tree = {"unit": unit} | tree if unit else tree
    if "M1" in tree:
        return stereo_tables(tree if exteriors else {"R": [0, 0, 0], "T": [0, 0, 0]} | tree)
    tables = camera_tables(tree, name)
    groups = {str(table.get("camera_group")) for _, table in tables}  # MC-Calib's: each has its own world
    if exteriors and len(groups) > 1:
        problem = f"cameras of {len(groups)} groups, between which no pose is known"
        raise CalibrationError(problem, place="camera_group", remedy="Let a board be seen by both groups.")
    return tables


def _of_kalibr(tree: Table) -> Table:
    """The tree with each camera's pose where T_cn_cnm1 leads from the camera before to each; cam0 is the world."""
    cameras = [key for key, value in tree.items() if isinstance(value, dict) and find(value, "matrix") is not None]
    if not any("T_cn_cnm1" in tree[name] for name in cameras):
        return tree
    cameras.sort(key=lambda name: [int(digits) for digits in re.findall(r"\d+", name)])
    T, out = np.eye(4), dict(tree)
    for name in cameras:
        step = tree[name].get("T_cn_cnm1", np.eye(4) if name == cameras[0] else None)
        T = numbers(step, (4, 4), f"camera {name}, T_cn_cnm1") @ T
        rest = {key: value for key, value in tree[name].items() if key != "T_cn_cnm1"}
        out[name] = rest | {"T_camera_world": T.tolist()}
    return out


def _of_multical(tree: Table) -> Table:
    """The tree with poses at the cameras, where `camera_poses` has one for each.

    "a" leads from the world to a; "a_to_b", whatever its name says, from b to a.
    """
    cameras, poses = tree.get("cameras"), tree.get("camera_poses")
    if not isinstance(cameras, dict) or not isinstance(poses, dict):
        return tree
    T = {"": np.eye(4)}
    for key, pose in poses.items():
        name, _, parent = str(key).partition("_to_")
        if isinstance(pose, dict) and parent in T:
            R, t = (find(pose, kind) for kind in ("rotation", "translation"))
            R, t = numbers(R, (3, 3), f"camera_poses, {key}"), numbers(t, (3,), f"camera_poses, {key}")
            T[name] = transform(R, t) @ T[parent]
    posed = {name: {"T_camera_world": T[name].tolist()} for name in cameras if name in T}
    return tree | {"cameras": {name: table | posed.get(name, {}) for name, table in cameras.items()}}


def _of_transforms(tree: Table) -> Table:
    """The cameras of a transforms.json (nerfstudio, instant-ngp), one an image; any other tree as it is.

    `transform_matrix` leads from a camera that looks along -z, y up, to the world; the centre of the first pixel is
    (0.5, 0.5), as in COLMAP. Lenses are those of the file or of each frame.
    """
    frames = tree.get("frames")
    if not isinstance(frames, list) or not all(isinstance(f, dict) and "transform_matrix" in f for f in frames):
        return tree
    cameras = []
    for name, frame in zip(image_names([PurePosixPath(str(f.get("file_path", "?"))) for f in frames]), frames):
        lens = {key: value for key, value in (tree | frame).items() if kind_of(str(key))}
        pinhole = [float(numbers(lens.get(k), (), f"camera {name}, {k}")) for k in ("fl_x", "fl_y", "cx", "cy")]
        pose = {"c2w": frame["transform_matrix"], "convention": "opengl"}
        cameras.append({"name": name, "matrix": np.subtract(pinhole, (0, 0, 0.5, 0.5)).tolist()} | lens | pose)
    return {"cameras": cameras}


def camera_tables(tree: Any, name: str, stated: Table | None = None) -> list[tuple[str, Table]]:
    """All tables with a camera matrix, and the camera's name (its own, else its key).

    `stated`: what the tables around it state of all their cameras.
    """
    if isinstance(tree, list):
        inner = [camera_tables(entry, f"{name}_{i}", stated) for i, entry in enumerate(tree)]
        return [found for group in inner for found in group]
    if not isinstance(tree, dict):
        return []
    stated = (stated or {}) | statements(tree)
    tree = _with_scalars(_by_camera(_merged(tree)))
    if find(tree, "matrix") is not None and not isinstance(find(tree, "matrix"), dict):
        own = tree.get("name") or tree.get("camera_name") or name
        return [] if tree.get("ignore") else [(str(own), stated | tree)]
    inner = [camera_tables(value, name if key == "cameras" else str(key), stated) for key, value in tree.items()]
    return [found for group in inner for found in group]


def _merged(tree: Table) -> Table:
    """The table with the entries of its parts: {"intrinsics": {"K": ...}, "extrinsics": {"R": ...}}."""
    by_camera = _is_by_camera(find(tree, "matrix"))
    for part, inner in tree.items():
        kind, name = kind_of(str(part)), spelled(part)
        if not isinstance(inner, dict) or not (kind in _KINDS_OF_PARTS or _PART.fullmatch(name)):
            continue
        named = any(kind_of(str(key)) and isinstance(value, dict) == by_camera for key, value in inner.items())
        is_camera = find(inner, "matrix") is not None  # with a name such as D
        if (name.startswith("intrinsic") and not _is_by_camera(inner)) or (named and not is_camera):
            direction = {"cam2world": True} if kind == "inverse pose" else {}
            if kind not in ("matrix", "pose", "inverse pose"):
                inner = {"distortion_model" if key in ("name", "type") else key: v for key, v in inner.items()}
            return _merged({key: value for key, value in tree.items() if key != part} | direction | inner)
    return tree


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
    """The table with fx, fy, cx, cy as a matrix, if it has only these, and `k` next to `K` as a distortion."""
    if "K" in table and "k" in table:  # a matrix and coefficients
        table = {"distortion" if key == "k" else key: value for key, value in table.items()}
    pinhole = [find(table, key) for key in ("fx", "fy", "cx", "cy")]
    if find(table, "matrix") is None and None not in pinhole:
        table = table | {"matrix": pinhole}
    return table


def stereo_named(tree: Table) -> Table:
    """The table with OpenCV's names M1, D1, M2, D2, if it is a stereo pair with R and T; else unchanged."""
    named = {}
    for key, value in tree.items():
        found = _OF_PAIR.fullmatch(str(key))
        named[f"{'M' if found[1] else 'D'}{found[3]}" if found else key] = value
    return named if {"M1", "M2", "R", "T"} <= named.keys() else tree


def stereo_tables(tree: Table, names: tuple[str, str] = ("left", "right")) -> list[tuple[str, Table]]:
    """The two cameras of OpenCV's stereo calibration; the first is the world. Lacking keys raise CalibrationError."""
    missing = [key for key in ("M1", "D1", "M2", "D2", "R", "T") if key not in tree]
    if missing:
        remedy = "Give the folder that holds both intrinsics.yml and extrinsics.yml, or both to read_opencv_stereo."
        raise CalibrationError(f"{', '.join(missing)} missing in a stereo calibration", remedy=remedy)
    poses = (([0, 0, 0], [0, 0, 0]), (tree["R"], tree["T"]))
    sizes = ("size", "shape", "width", "height")
    common = statements(tree) | {key: value for key, value in tree.items() if kind_of(str(key)) in sizes}
    return [
        (name, common | {"matrix": tree[f"M{i}"], "distortion": tree[f"D{i}"], "rotation": R, "translation": t})
        for i, (name, (R, t)) in enumerate(zip(names, poses), 1)
    ]


def unit_of_program(tree: Table) -> str | None:
    """Unit of length of a program whose files do not state it; None of any other.

    CMU Panoptic Studio (each camera has a `panel` and a `node`) uses centimetres, FreeMoCap (`metadata` has
    `charuco_square_size`, mostly in mm) millimetres.
    """
    metadata, cameras = tree.get("metadata"), tree.get("cameras")
    if isinstance(cameras, list) and all(isinstance(c, dict) and {"panel", "node"} <= c.keys() for c in cameras[:1]):
        return "cm" if cameras else None
    square = metadata.get("charuco_square_size") if isinstance(metadata, dict) else None
    return "mm" if isinstance(square, int | float) and square > 1 else None  # 1: in squares of a board
