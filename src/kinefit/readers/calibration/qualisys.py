"""Cameras of a Qualisys calibration (.qca XML), and of Theia3D's, which has the same tags."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.calibration.tables import build_camera, numbers, rigid

_SUBPIXELS = 64.0  # focal lengths and centres are in 1/64 px; distortion coefficients are not scaled
_MAX_SIDE = 16384.0  # [px] of an image: a larger number is in 1/64 px
_FLIP = np.diag([1.0, -1.0, -1.0])  # Qualisys' cameras look along -z with y up

_DISTORTION = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "radialDistortion3",
)


def qualisys_cameras(root: Element, path: Path) -> list[Camera]:
    """Active cameras of a parsed file; translations in the file's unit (millimetres).

    Qualisys' file gives the camera's position p and, in r11..r33, the rotation r from world to camera axes:
    T_camera_world = (F r, -F r p) with F = diag(1, -1, -1), and lengths in the image in 1/64 px. Theia3D writes the
    same tags without `fov_video`, with lengths in px and the size as `sensorDimU` or the largest `sensorMaxU`; x, y, z
    are the translation: T_camera_world = (r, (x, y, z)) (docs.theiamarkerless.com, Calibration Files).
    """
    for element in root.iter():  # QTM's own protocol writes the same names with other capitals
        element.tag = element.tag.lower()
        attributes = {key.lower().replace("tangential", "tangental"): text for key, text in element.attrib.items()}
        element.attrib.clear()
        element.attrib.update(attributes)
    return [
        _camera(element, path)
        for element in root.iterfind("cameras/camera")
        if element.get("active", "1") not in ("0", "false")
    ]


def _camera(element: Element, path: Path) -> Camera:
    name = element.get("serial") or "?"

    def value(group: str, key: str, default: float | None = None) -> float:
        found = element.find(group)
        text = default if found is None else found.get(key.lower(), default)
        return float(numbers(text, (), path, f"camera {name}, {group}, {key}"))

    left = top = 0.0
    subpixels = _SUBPIXELS
    intrinsic = element.find("intrinsic")
    if element.find("fov_video") is not None:
        left, top = value("fov_video", "left"), value("fov_video", "top")
        size = (int(value("fov_video", "right") - left) + 1, int(value("fov_video", "bottom") - top) + 1)
    elif intrinsic is not None and "sensordimu" in intrinsic.attrib:
        subpixels, size = 1.0, (int(value("intrinsic", "sensorDimU")), int(value("intrinsic", "sensorDimV")))
    else:
        largest = [value("intrinsic", f"sensorMax{axis}") for axis in "UV"]
        subpixels = _SUBPIXELS if max(largest) > _MAX_SIDE else 1.0
        size = (int(largest[0] / subpixels) + 1, int(largest[1] / subpixels) + 1)
    if subpixels == _SUBPIXELS and element.get("viewrotation", "0") not in ("0", "0.0"):
        raise CalibrationError(
            f"its view is rotated by {element.get('viewrotation')} degrees",
            file=path,
            place=f"camera {name}",
            remedy="Set the view rotation to 0, export again, and set the rotation of the video in the take file.",
        )
    focal = [value("intrinsic", f"focalLength{axis}") / subpixels for axis in "UV"]
    centre = [value("intrinsic", f"centerPoint{axis}") / subpixels for axis in "UV"]
    skew = value("intrinsic", "skew", 0.0) / subpixels
    K = np.array([[focal[0], skew, centre[0] - left], [0, focal[1], centre[1] - top], [0, 0, 1]])
    k = np.array([value("intrinsic", key, 0.0) for key in _DISTORTION])
    r = np.array([[value("transform", f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)])
    xyz = np.array([value("transform", axis) for axis in "xyz"])
    R, t = (r, xyz) if subpixels == 1.0 else (_FLIP @ r, -_FLIP @ r @ xyz)
    return build_camera(name, size, K, k, "radtan", rigid(R, t, path, f"camera {name}, transform"), path)


def qualisys_text(rig: Rig, text: str, metres_per_unit: float, path: Path) -> str:
    """The text of a file with the cameras of a rig, matched by serial number; everything else is kept.

    `metres_per_unit` [m] is of the file; raises CalibrationError for a lens model that the format lacks.
    """
    head, mark, rest = text.partition("<calibration")
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(mark + rest, parser)
    for element in root.iterfind("cameras/camera"):
        if element.get("active", "1") not in ("0", "false") and element.get("serial", "?") in rig:
            _replace(element, rig[element.get("serial", "?")], metres_per_unit, path)
    return head + ElementTree.tostring(root, encoding="us-ascii").decode("ascii") + "\n"


def _replace(element: Element, camera: Camera, metres_per_unit: float, path: Path) -> None:
    if camera.model != "radtan" or camera.distortion[5:].any():
        raise CalibrationError(
            "Qualisys files cannot hold this lens model", file=path, place=f"camera {camera.name}",
            remedy="Calibrate it with k1, k2, p1, p2, k3 alone, or write another format.",
        )
    fov, K = element.find("fov_video"), camera.matrix
    left, top = (float(fov.get(side, 0)) for side in ("left", "top")) if fov is not None else (0.0, 0.0)
    r, position = _FLIP @ camera.T_camera_world[:3, :3], camera.centre_world / metres_per_unit
    intrinsic = {
        "focalLengthU": K[0, 0] * _SUBPIXELS,
        "focalLengthV": K[1, 1] * _SUBPIXELS,
        "centerPointU": (K[0, 2] + left) * _SUBPIXELS,
        "centerPointV": (K[1, 2] + top) * _SUBPIXELS,
        "skew": K[0, 1] * _SUBPIXELS,
    }
    intrinsic |= dict(zip(_DISTORTION, np.pad(camera.distortion[:5], (0, 5 - camera.distortion[:5].size))))
    transform = {f"r{i + 1}{j + 1}": r[i, j] for i in range(3) for j in range(3)} | dict(zip("xyz", position))
    for group, values in (("intrinsic", intrinsic), ("transform", transform)):
        found = element.find(group)
        for key, value in values.items():
            if found is not None and (key in found.keys() or value != 0):
                found.set(key, repr(float(value)))
