"""Calibrations that users reported: lenses, conventions and poses that a file states must be read, or refused by name.

Truth of the cases is in one of their folders; siblings are written here from the same kind of rig.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Rig
from kinefit.geometry.se3 import exp_so3, log_so3, quaternion, transform
from kinefit.readers.calibration.read import read_calibration

_TRUTH = "calibration-lens-distortion_vector"
_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's camera to OpenCV's
_TOLERANCE = 1e-9
Table = dict[str, Any]

# ---------------------------------------------------------------- a rig of three cameras

_K = np.array([[[1100.0 + 10 * i, 0, 950 + i], [0, 1090 + 5 * i, 530 - i], [0, 0, 1]] for i in range(3)])
_D = np.array([[-0.2, 0.06, 0.001, -0.002, 0.01]]) * np.array([[1.0], [1.1], [1.2]])
_T = np.array([transform(exp_so3(np.array([1.2, 0.4 * i, -0.3])), np.array([0.1 * i, 0.2, 3.0])) for i in range(3)])


def _lens(i: int) -> Table:
    return {"K": _K[i].tolist(), "dist": _D[i].tolist(), "size": [1920, 1080]}


def _pose(T: NDArray) -> Table:
    return {"R": T[:3, :3].tolist(), "t": T[:3, 3].tolist()}


def _is_right(rig: Rig, K: NDArray, D: NDArray, T: NDArray) -> bool:
    """Whether all cameras have these matrices, coefficients and poses."""
    return len(rig) == len(K) and all(
        np.allclose(camera.matrix, K[i], atol=_TOLERANCE)
        and np.allclose(np.pad(camera.distortion, (0, 8 - camera.distortion.size))[: D.shape[1]], D[i], atol=_TOLERANCE)
        and np.allclose(camera.T_camera_world, T[i], atol=_TOLERANCE)
        for i, camera in enumerate(rig)
    )


def _relative(T: NDArray) -> NDArray:
    return np.array([one @ np.linalg.inv(T[0]) for one in T])


def _read(folder: Path, tree: Any, T: NDArray = _T) -> bool:
    """Whether a JSON of a tree gives the rig."""
    path = folder / "rig.json"
    path.write_text(json.dumps(tree))
    return _is_right(read_calibration(path), _K, _D, T)


def _refused(read: Callable[[], Any], words: str) -> bool:
    """Whether reading ends with an error that names the cause and says what to do."""
    try:
        read()
    except CalibrationError as error:
        return re.search(words, str(error)) is not None and bool(error.remedy)
    return False


# ---------------------------------------------------------------- cases


def _case(name: str, folder: Path, *, relative: bool = False, coefficients: int = 5) -> bool:
    """Whether a case's file gives the cameras of the truth, of which `coefficients` of distortion are in the file."""
    truth = np.load(folder.parent / _TRUTH / "truth.npz")
    T = _relative(truth["T"]) if relative else truth["T"]
    return _is_right(read_calibration(folder / name), truth["K"], truth["D"][:, :coefficients], T)


def _mc_calib(folder: Path) -> bool:
    file = "calibrated_cameras_data.yml"
    truth, lenses = np.load(folder / "truth.npz"), read_calibration(folder / file, exteriors=False)
    same = all(np.allclose(camera.distortion, D) for camera, D in zip(lenses, truth["D"]))
    return same and _case(file, folder, relative=True)


CASES: dict[str, Callable[[Path], bool]] = {
    "calibration-lens-kc": partial(_case, "rig.json"),
    "calibration-lens-distortion_vector": _mc_calib,
    "calibration-says-opengl": partial(_case, "rig.json"),
    "calibration-world2cam-true": partial(_case, "rig.json"),
    "calibration-rotation-in-degrees": lambda folder: _refused(
        lambda: read_calibration(folder / "rig.json"), "camera cam0.*more than one turn.*degrees"
    ),
    "calibration-colmap-without-points": partial(_case, ".", coefficients=4),
    "calibration-kalibr-camchain": partial(_case, "camchain.yaml", relative=True, coefficients=4),
    "calibration-vic3d": lambda folder: _refused(lambda: read_calibration(folder / "cal.xml"), "VIC-3D"),
}

# ---------------------------------------------------------------- siblings


def _parts_of_distortion(folder: Path) -> bool:
    radial = [{"radial_distortion": d[[0, 1, 4]].tolist(), "tangential_distortion": d[2:4].tolist()} for d in _D]
    return _read(folder, [{"K": _lens(i)["K"], "size": [1920, 1080]} | _pose(_T[i]) | radial[i] for i in range(3)])


def _nested_coefficients(folder: Path) -> bool:
    tree = [_lens(i) | _pose(_T[i]) for i in range(3)]
    for table in tree:
        table["lens"] = {"model": "brown", "coeffs": table.pop("dist")}
    return _read(folder, tree)


def _groups(folder: Path) -> bool:
    """MC-Calib's groups of cameras that never saw a board together."""
    tree = {f"camera_{i}": _lens(i) | {"camera_group": i // 2} | _pose(_T[i]) for i in range(3)}
    return _refused(lambda: _read(folder, tree), "groups.*camera_group|camera_group.*groups")


def _fisheye_by_number(folder: Path) -> bool:
    path = folder / "rig.json"
    lens = [{"distortion_vector": _D[i][:4].tolist(), "distortion_type": 1} for i in range(3)]
    poses = [{"camera_pose_matrix": np.linalg.inv(T).tolist()} for T in _T]
    tree = [{"K": _lens(i)["K"], "size": [1920, 1080]} | lens[i] | poses[i] for i in range(3)]
    path.write_text(json.dumps(tree))
    rig = read_calibration(path)
    return all(camera.model == "fisheye" for camera in rig) and _is_right(rig, _K, _D[:, :4], _T)


def _blender_for_all(folder: Path) -> bool:
    cameras = {f"cam{i}": _lens(i) | _pose(_AXES @ _T[i]) for i in range(3)}
    return _read(folder, {"metadata": {"coordinate_system": "Blender"}} | cameras)


def _left_handed(folder: Path) -> bool:
    tree = [_lens(i) | _pose(_T[i]) | {"convention": "unity"} for i in range(3)]
    return _refused(lambda: _read(folder, tree), "convention.*unity")


def _to_world_by_flag(folder: Path) -> bool:
    return _read(folder, [_lens(i) | _pose(np.linalg.inv(_T[i])) | {"world2cam": False} for i in range(3)])


def _to_world_in_words(folder: Path) -> bool:
    poses = [{"extrinsic": np.linalg.inv(T)[:3].ravel().tolist()} for T in _T]  # twelve numbers, flat
    return _read(folder, [_lens(i) | poses[i] | {"extrinsics_type": "camera-to-world"} for i in range(3)])


def _degrees_in_toml(folder: Path) -> bool:
    path, text = folder / "calibration.toml", ""
    for i, T in enumerate(_T):
        lens = f"size = [1920, 1080]\nmatrix = {_K[i].tolist()}\ndistortions = {_D[i].tolist()}\n"
        turn = np.degrees(log_so3(T[:3, :3])).tolist()
        text += f"[cam_{i}]\n{lens}rotation = {turn}\ntranslation = {T[:3, 3].tolist()}\n"
    path.write_text(text)
    return _refused(lambda: read_calibration(path), "camera cam_0.*more than one turn.*degrees")


def _mirrored(folder: Path) -> bool:
    tree = [_lens(i) | _pose(_T[i] @ np.diag([1, 1, -1, 1])) for i in range(3)]
    return _refused(lambda: _read(folder, tree), "determinant is -1")


def _colmap(folder: Path, points: Callable[[int], str], lengths: float = 1.0) -> Path:
    cameras, images = "", "# images\n"
    for i, T in enumerate(_T):
        values = (_K[i, 0, 0], _K[i, 1, 1], _K[i, 0, 2] + 0.5, _K[i, 1, 2] + 0.5, *_D[i][:4])
        cameras += f"{i + 1} OPENCV 1920 1080 {' '.join(repr(float(v)) for v in values)}\n"
        pose = [*(lengths * quaternion(T[:3, :3])), *T[:3, 3]]
        images += f"{i + 1} {' '.join(repr(float(v)) for v in pose)} {i + 1} cam {i}.png\n{points(i)}"
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_text(images)
    return folder


def _some_points(folder: Path) -> bool:
    """Points after one image, nothing after another, a blank line and a comment after the third."""
    lines = ("12.5 13.0 -1 1e2 5 17\n", "", "\n\n# end\n")
    return _is_right(read_calibration(_colmap(folder, lines.__getitem__)), _K, _D[:, :4], _T)


def _long_quaternion(folder: Path) -> bool:
    return _refused(lambda: read_calibration(_colmap(folder, lambda i: "\n", 2.0)), "quaternion of length 2")


def _kalibr(folder: Path, lens: str, model: str = "pinhole", names: tuple[int, ...] = (0, 1, 2)) -> Path:
    text = ""
    chain = {n: _T[i] @ np.linalg.inv(_T[i - 1]) for i, n in enumerate(names) if i}
    for i, n in sorted(enumerate(names), key=lambda pair: str(pair[1])):  # YAML sorts cam10 before cam2
        text += f"cam{n}:\n" + (f"  T_cn_cnm1: {chain[n].tolist()}\n" if n in chain else "")
        text += f"  camera_model: {model}\n  distortion_coeffs: {_D[i][:4].tolist()}\n"
        text += f"  distortion_model: {lens}\n  resolution: [1920, 1080]\n"
        text += f"  intrinsics: {[float(v) for v in (_K[i, 0, 0], _K[i, 1, 1], _K[i, 0, 2], _K[i, 1, 2])]}\n"
    (folder / "camchain.yaml").write_text(text)
    return folder / "camchain.yaml"


def _equidistant_ten(folder: Path) -> bool:
    rig = read_calibration(_kalibr(folder, "equidistant", names=(0, 2, 10)))
    rig = rig.select(("cam0", "cam2", "cam10"))
    return all(camera.model == "fisheye" for camera in rig) and _is_right(rig, _K, _D[:, :4], _relative(_T))


def _double_sphere(folder: Path) -> bool:
    return _refused(lambda: read_calibration(_kalibr(folder, "none", "ds")), "model ds")


def _multical(folder: Path) -> bool:
    T = _relative(_T)
    cameras = {f"c{i}": _lens(i) | {"model": "standard"} for i in range(3)}
    poses = {f"c{i}_to_c0" if i else "c0": {"R": T[i][:3, :3].tolist(), "T": T[i][:3, 3].tolist()} for i in range(3)}
    return _read(folder, {"cameras": cameras, "camera_poses": poses}, T=T)


def _nerf(folder: Path) -> bool:
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "k3")
    frames = []
    for i, T in enumerate(_T):
        values = (_K[i, 0, 0], _K[i, 1, 1], _K[i, 0, 2] + 0.5, _K[i, 1, 2] + 0.5, 1920, 1080, *_D[i])
        pose = {"transform_matrix": (np.linalg.inv(T) @ _AXES).tolist()}
        frames.append({"file_path": f"images/{i}.png"} | dict(zip(names, map(float, values))) | pose)
    return _read(folder, {"camera_model": "OPENCV", "frames": frames})


def _xml(text: str, words: str, folder: Path) -> bool:
    path = folder / "cal.xml"
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>{text}')
    return _refused(lambda: read_calibration(path), words)


_METASHAPE = '<document version="2.0.0"><chunk label="c"><sensors><sensor id="0"/></sensors></chunk></document>'
_DICE = '<ParameterList><Parameter name="xml_file_format" value="DICe_xml_calibration_file"/></ParameterList>'

SIBLINGS: dict[str, Callable[[Path], bool]] = {
    "lens kc: radial and tangential parts": _parts_of_distortion,
    "lens kc: coefficients in a table of the lens": _nested_coefficients,
    "lens distortion_vector: fisheye by its number, pose from the camera": _fisheye_by_number,
    "lens distortion_vector: groups without a common world": _groups,
    "says opengl: blender, in the file's metadata": _blender_for_all,
    "says opengl: unity": _left_handed,
    "world2cam true: world2cam false": _to_world_by_flag,
    "world2cam true: in words, twelve numbers": _to_world_in_words,
    "rotation in degrees: TOML": _degrees_in_toml,
    "rotation in degrees: a mirroring matrix": _mirrored,
    "COLMAP without points: points after some images": _some_points,
    "COLMAP without points: quaternions of length two": _long_quaternion,
    "Kalibr camchain: equidistant, cam10 behind cam2": _equidistant_ten,
    "Kalibr camchain: double sphere": _double_sphere,
    "Kalibr camchain: multical": _multical,
    "VIC-3D: transforms.json of nerfstudio": _nerf,
    "VIC-3D: Agisoft Metashape": partial(_xml, _METASHAPE, "Agisoft Metashape.*COLMAP"),
    "VIC-3D: DICe": partial(_xml, _DICE, "DICe"),
}
