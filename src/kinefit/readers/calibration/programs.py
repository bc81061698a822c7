"""Cameras in files of programs: COLMAP's text model, MATLAB's parameters, Qualisys, Theia3D and Vicon.

COLMAP: a folder with cameras.txt and images.txt. MATLAB: .mat files and JSON, as tables with OpenCV's conventions.
Qualisys (.qca XML), Theia3D, which has the same tags, and Vicon (.xcp XML: Nexus, Shogun, Blade).
"""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from kinefit._files import LENGTHS, regular, worth
from kinefit._processes import environment, python
from kinefit.errors import CalibrationError, FileError, check_choice, located
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import quaternion
from kinefit.readers.calibration.keys import Table, find
from kinefit.readers.calibration.tables import is_transposed, numbers, rigid, rotation_of

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
