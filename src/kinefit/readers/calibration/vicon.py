"""Cameras of a Vicon calibration (.xcp XML: Nexus, Shogun, Blade)."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera
from kinefit.readers.calibration.tables import build_camera, numbers, rigid, rotation_of

_MAX_LENS_ERROR_PX = 0.01  # of the lens in OpenCV's terms against Vicon's, anywhere in the image
_MAX_CENTRE_OFFSET_PX = 0.5  # of the distortion's centre from the principal point
_MAX_ASPECT_ERROR = 1e-3  # of a square pixel
_COMPARED_RADII = 400  # at which both lens models are compared


def vicon_cameras(root: Element, path: Path) -> list[Camera]:
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
    return [_camera(c, path) for c in video_cameras or cameras]


def _camera(element: Element, path: Path) -> Camera:
    name = element.get("DEVICEID") or element.get("NAME") or "?"
    place = f"camera {name}"
    frames = element.findall("KeyFrames/KeyFrame")
    if len(frames) > 1:
        raise CalibrationError(
            f"{len(frames)} key frames: the camera moves", file=path, place=place, remedy="Export a static calibration."
        )

    def values(key: str, shape: tuple[int, ...] | None, default: str | None = None) -> NDArray:
        text = frames[0].get(key, element.get(key, default))
        return numbers("missing" if text is None else text.split(), shape, path, f"{place}, {key}")

    width, height = values("SENSOR_SIZE", (2,))
    (focal,), centre = values("FOCAL_LENGTH", (1,)), values("PRINCIPAL_POINT", (2,))
    sides = [values(key, (1,), "1")[0] for key in ("PIXEL_ASPECT_RATIO", "PIXEL_ASPECT_RATIO_CORRECTION")]
    if max(abs(side - 1) for side in sides) > _MAX_ASPECT_ERROR or values("SKEW", (1,), "0")[0] != 0:
        problem = "pixels are not square: PIXEL_ASPECT_RATIO or SKEW"
        raise CalibrationError(problem, file=path, place=place, remedy="Resample the video to square pixels.")
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
    R = rotation_of(np.roll(values("ORIENTATION", (4,)), 1), path, f"{place}, ORIENTATION")
    radial = _radial(frames[0], centre, path, place)
    corner = float(np.hypot(*np.maximum(centre, np.subtract((width, height), centre))))
    k = _opencv_radial(radial, corner, float(focal), path, place) if radial.any() else np.zeros(0)
    T = rigid(R, -R @ values("POSITION", (3,)), path, place)
    return build_camera(name, (int(width), int(height)), K, k, "radtan", T, path)


def _radial(frame: Element, centre: NDArray, path: Path, place: str) -> NDArray:
    """(3,) k1, k2, k3 [px⁻², px⁻⁴, px⁻⁶] from distorted to ideal."""
    words = (frame.get("VICON_RADIAL2") or "").split()
    if not words:
        k = numbers((frame.get("VICON_RADIAL") or "0 0").split(), None, path, f"{place}, VICON_RADIAL").ravel()
    else:
        model = words.pop(0) if words[0][0].isalpha() else ""
        k = numbers(words, (5,), path, f"{place}, VICON_RADIAL2")
        known = model in ("", "Vicon3Parameter", "ViconRadial2")
        if k[2:].any() and (not known or np.abs(k[:2] - centre).max() > _MAX_CENTRE_OFFSET_PX):
            problem = "the centre of distortion is not the principal point" if known else f"a lens '{model}'"
            remedy = "Undistort the video in Vicon's program, or calibrate with a board."
            raise CalibrationError(problem, file=path, place=f"{place}, VICON_RADIAL2", remedy=remedy)
        k = k[2:]
    if k.size > 3:
        raise CalibrationError(f"{k.size} coefficients", file=path, place=place, remedy="Give k1 and k2.")
    return np.pad(k, (0, 3 - k.size))


def _opencv_radial(radial: NDArray, corner: float, focal: float, path: Path, place: str) -> NDArray:
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
        raise CalibrationError("a distortion that OpenCV's lens cannot hold", file=path, place=place, remedy=remedy)
    return k
