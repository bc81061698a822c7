"""Cameras of Qualisys (.qca XML), Theia3D, which has the same tags, and Vicon (.xcp XML: Nexus, Shogun, Blade)."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, located
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.calibration.tables import numbers, rigid, rotation_of

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


def qualisys_cameras(root: Element) -> list[Camera]:
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
    return [_camera(element) for element in _active(root)]


def _active(root: Element) -> list[Element]:
    return [one for one in root.iterfind("cameras/camera") if one.get("active", "1") not in ("0", "false")]


def _camera(element: Element) -> Camera:
    name = element.get("serial") or "?"

    def value(group: str, key: str, default: float | None = None) -> float:
        found = element.find(group)
        text = default if found is None else found.get(key.lower(), default)
        return float(numbers(text, (), f"camera {name}, {group}, {key}"))

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
        problem = f"its view is rotated by {element.get('viewrotation')} degrees"
        remedy = "Set the view rotation to 0, export again, and set the rotation of the video in the take file."
        raise CalibrationError(problem, place=f"camera {name}", remedy=remedy)
    focal = [value("intrinsic", f"focalLength{axis}") / subpixels for axis in "UV"]
    centre = [value("intrinsic", f"centerPoint{axis}") / subpixels for axis in "UV"]
    skew = value("intrinsic", "skew", 0.0) / subpixels
    K = np.array([[focal[0], skew, centre[0] - left], [0, focal[1], centre[1] - top], [0, 0, 1]])
    k = np.array([value("intrinsic", key, 0.0) for key in _DISTORTION])
    r = np.array([[value("transform", f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)])
    xyz = np.array([value("transform", axis) for axis in "xyz"])
    R, t = (r, xyz) if subpixels == 1.0 else (_FLIP @ r, -_FLIP @ r @ xyz)
    with located(None, f"camera {name}, transform"):
        T = rigid(R, t)
    return Camera(name, size, K, k, "radtan", T)


def qualisys_text(rig: Rig, text: str, metres_per_unit: float) -> str:
    """The text of a file with the cameras of a rig, matched by serial number; everything else is kept.

    `metres_per_unit` [m] is of the file; raises CalibrationError for a lens model that the format lacks.
    """
    head, mark, rest = text.partition("<calibration")
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(mark + rest, parser)
    for element in _active(root):
        if (name := element.get("serial", "?")) in rig:
            _replace(element, rig[name], metres_per_unit)
    return head + ElementTree.tostring(root, encoding="us-ascii").decode("ascii") + "\n"


def _replace(element: Element, camera: Camera, metres_per_unit: float) -> None:
    if camera.model != "radtan" or camera.distortion[5:].any():
        raise CalibrationError(
            "Qualisys files cannot hold this lens model", place=f"camera {camera.name}",
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


_MAX_LENS_ERROR_PX = 0.01  # of the lens in OpenCV's terms against Vicon's, anywhere in the image
_MAX_CENTRE_OFFSET_PX = 0.5  # of the distortion's centre from the principal point
_MAX_ASPECT_ERROR = 1e-3  # of a square pixel
_COMPARED_RADII = 400  # at which both lens models are compared


def vicon_cameras(root: Element) -> list[Camera]:
    """Calibrated video cameras of a parsed file; all cameras if it has no video. Translations in mm.

    A camera is named by its DEVICEID, which Nexus writes into the names of its videos. ORIENTATION is the quaternion
    (x, y, z, w) of the rotation R world to camera, POSITION the camera's centre p: T_camera_world = (R, -R p); it looks
    along z, y down. VICON_RADIAL (k1 k2) and VICON_RADIAL2 ("Vicon3Parameter" cx cy k1 k2 k3) take an image point d
    [px] from its centre to d (1 + k1 |d|² + k2 |d|⁴ + k3 |d|⁶) of an ideal lens: from distorted to ideal, the reverse
    of OpenCV. Pixel (0, 0) is assumed to be the centre of the first.
    Source: Vicon CaraPost's reference, "About calibration data (XCP) files", for the attributes; the direction of the
    lens model is from other readers of these files, tested on known positions.
    """
    cameras = [c for c in root.iter("Camera") if c.find("KeyFrames/KeyFrame") is not None]
    video_cameras = [c for c in cameras if c.get("ISDV", "0") != "0" or "video" in c.get("TYPE", "").lower()]
    out = []
    for element in video_cameras or cameras:
        name = element.get("DEVICEID") or element.get("NAME") or "?"
        with located(None, f"camera {name}"):
            parts = _vicon_camera(element)
        out.append(Camera(name, *parts))
    return out


def _vicon_camera(element: Element) -> tuple[tuple[int, int], NDArray, NDArray, str, NDArray]:
    """What a camera is made of, but for its name."""
    frames = element.findall("KeyFrames/KeyFrame")
    if len(frames) > 1:
        problem = f"{len(frames)} key frames: the camera moves"
        raise CalibrationError(problem, remedy="Export a static calibration.")

    def values(key: str, shape: tuple[int, ...] | None, default: str | None = None) -> NDArray:
        text = frames[0].get(key, element.get(key, default))
        return numbers("missing" if text is None else text.split(), shape, key)

    width, height = values("SENSOR_SIZE", (2,))
    (focal,), centre = values("FOCAL_LENGTH", (1,)), values("PRINCIPAL_POINT", (2,))
    sides = [values(key, (1,), "1")[0] for key in ("PIXEL_ASPECT_RATIO", "PIXEL_ASPECT_RATIO_CORRECTION")]
    if max(abs(side - 1) for side in sides) > _MAX_ASPECT_ERROR or values("SKEW", (1,), "0")[0] != 0:
        problem = "pixels are not square: PIXEL_ASPECT_RATIO or SKEW"
        raise CalibrationError(problem, remedy="Resample the video to square pixels.")
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    R = rotation_of(np.roll(values("ORIENTATION", (4,)), 1))
    radial = _radial(frames[0], centre)
    corner = float(np.hypot(*np.maximum(centre, np.subtract((width, height), centre))))
    k = _opencv_radial(radial, corner, float(focal)) if radial.any() else np.zeros(0)
    return (int(width), int(height)), K, k, "radtan", rigid(R, -R @ values("POSITION", (3,)))


def _radial(frame: Element, centre: NDArray) -> NDArray:
    """(3,) k1, k2, k3 [px⁻², px⁻⁴, px⁻⁶] from distorted to ideal."""
    words = (frame.get("VICON_RADIAL2") or "").split()
    if not words:
        k = numbers((frame.get("VICON_RADIAL") or "0 0").split(), None, "VICON_RADIAL").ravel()
    else:
        model = words.pop(0) if words[0][0].isalpha() else ""
        k = numbers(words, (5,), "VICON_RADIAL2")
        known = model in ("", "Vicon3Parameter", "ViconRadial2")
        if k[2:].any() and (not known or np.abs(k[:2] - centre).max() > _MAX_CENTRE_OFFSET_PX):
            problem = "the centre of distortion is not the principal point" if known else f"a lens '{model}'"
            remedy = "Undistort the video in Vicon's program, or calibrate with a board."
            raise CalibrationError(problem, place="VICON_RADIAL2", remedy=remedy)
        k = k[2:]
    if k.size > 3:
        raise CalibrationError(f"{k.size} coefficients", remedy="Give k1 and k2.")
    return np.pad(k, (0, 3 - k.size))


def _opencv_radial(radial: NDArray, corner: float, focal: float) -> NDArray:
    """(8,) k1 k2 p1 p2 k3 k4 k5 k6 from ideal to distorted, by least squares over the image.

    Parameters
    ----------
    radial : (3,) of `_radial`
    corner : distance of the farthest corner from the principal point [px]
    """
    distorted = np.linspace(0, corner, _COMPARED_RADII + 1)[1:]
    ideal = distorted * (1 + np.stack([distorted**2, distorted**4, distorted**6], axis=1) @ radial)
    k, error = np.zeros(8), np.inf
    if np.all(np.diff(ideal, prepend=0) > 0):
        squares = (ideal / ideal[-1]) ** 2
        ratio, powers = distorted / ideal, np.stack([squares, squares**2, squares**3], axis=1)
        columns = np.hstack([powers, -ratio[:, None] * powers])  # ratio (1 + powers b) = 1 + powers a
        a = np.linalg.lstsq(columns * ideal[:, None], distorted - ideal, rcond=None)[0]
        error = float(np.abs(ideal * (1 + powers @ a[:3]) / (1 + powers @ a[3:]) - distorted).max())
        k[[0, 1, 4, 5, 6, 7]] = a / np.tile((ideal[-1] / focal) ** (2.0 * np.arange(1, 4)), 2)
    if error > _MAX_LENS_ERROR_PX:
        remedy = "Undistort the video in Vicon's program, or calibrate with a board."
        raise CalibrationError("a distortion that OpenCV's lens cannot hold", remedy=remedy)
    return k
