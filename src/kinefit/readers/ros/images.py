"""Messages of images and of cameras' lenses (ROS 2): to arrays and to `Camera`."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._pictures import check_image_size, decode_picture
from kinefit.errors import CalibrationError, FileError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.readers.ros.recordings import COMPRESSED, IMAGE, INFO, Topics

UNITS = {"16UC1": 0.001, "32FC1": 1.0}
"""[m] of a count of a depth image (REP 118)."""

COLOURS: dict[str, int | None] = {
    "rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB, "bayer_rggb8": cv2.COLOR_BayerBG2RGB, "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB, "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}  # fmt: skip
"""Encodings of images for the eye, and how OpenCV makes RGB of them (its names of Bayer patterns are shifted)."""

_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_HEADER = 12  # bytes before the PNG of a compressed depth image: its kind, and two numbers of its quantisation
_LENSES = ("plumb_bob", "rational_polynomial", "")  # those of OpenCV; none


def encoding(message: Any) -> str:
    """Of an image: "16UC1", "rgb8", ..., of a compressed colour image "jpeg", "png"; "" where there is none."""
    if message is None:
        return ""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    told = [part.strip() for part in str(message.format).split(";")]
    if any(part.startswith("compressedDepth") for part in told[1:]):
        return told[0] if not any("rvl" in part for part in told[1:]) else f"{told[0]} as RVL"
    packed = " ".join(told).lower()
    return "jpeg" if "jpeg" in packed or "jpg" in packed else "png" if "png" in packed else str(message.format)


def is_colour(message: Any) -> bool:
    """Whether a message shows what the eye sees, in an encoding that is read."""
    return encoding(message) in COLOURS or (message is not None and encoding(message) in ("jpeg", "png"))


def counts(message: Any, path: Path) -> NDArray:
    """(H, W) depth as recorded, counts or metres, 0 or NaN where nothing was measured.

    Raises
    ------
    FileError
        A damaged image.
    """
    if hasattr(message, "encoding"):
        return _raw(message, np.dtype({"16UC1": "u2", "32FC1": "f4"}[message.encoding]), 1, path)[..., 0]
    data = bytes(message.data)
    image = decode_picture(data[_HEADER:], cv2.IMREAD_UNCHANGED, file=path, place="a compressed depth image")
    if image.ndim != 2 or image.dtype != np.uint16:
        raise FileError("a compressed depth image that is no PNG of 16 bits", file=path, remedy="Record it raw.")
    if encoding(message) == "32FC1":  # inverse depth in steps (compressed_depth_image_transport)
        _, a, b = struct.unpack_from("<iff", data)
        with np.errstate(divide="ignore"):
            return np.where(image > 0, a / (image.astype(np.float32) - np.float32(b)), 0.0).astype(np.float32)
    return image


def colours(message: Any, path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB.

    Raises
    ------
    FileError
        A damaged image.
    """
    if not hasattr(message, "encoding"):
        return decode_picture(bytes(message.data), file=path, place=f"a compressed image ({message.format})")
    kind = str(message.encoding)
    image = _raw(message, np.dtype("u1"), _CHANNELS.get(kind, 1), path)
    change = COLOURS[kind]
    image = image if image.shape[2] > 1 else image[..., 0]
    return image if change is None else np.asarray(cv2.cvtColor(image, change), np.uint8)


def _raw(message: Any, kind: np.dtype, channels: int, path: Path) -> NDArray:
    """(H, W, channels) of an image that is not compressed."""
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    check_image_size((width, height), path, "an image")
    data, row = bytes(message.data), width * channels * kind.itemsize
    if not (height and width and step >= row and len(data) == height * step):
        told = f"{len(data)} bytes for {width}x{height} px, {step} bytes a row"
        raise FileError(told, file=path, remedy="The recording is damaged: copy it again.")
    rows = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(height, step)[:, :row])
    return rows.view(kind).reshape(height, width, channels)


def info_topic(topics: Topics, image: str) -> str | None:
    """The topic with CameraInfo in the folder of the image's, or in one above; None where there is none."""
    folder = image.rpartition("/")[0]
    while folder:
        if f"{folder}/camera_info" in topics.of(INFO):
            return f"{folder}/camera_info"
        folder = folder.rpartition("/")[0]
    return None


def info_of(topics: Topics, image: str) -> Any:
    """The first CameraInfo of an image's camera; None where there is none."""
    topic = info_topic(topics, image)
    return None if topic is None else topics.first(topic)


def camera(info: Any, name: str, size: tuple[int, ...], path: Path, *, rectified: bool = False) -> Camera | None:
    """The camera of a CameraInfo, at the origin; None where it is not calibrated.

    Parameters
    ----------
    info : message
    name : str
    size : (width, height) [px] of its images
    rectified : whether its images had their lens taken out: then P holds, and no lens.

    Raises
    ------
    CalibrationError
        A lens that OpenCV does not have, or a part of its image.
    """
    K = np.array(info.k, float).reshape(3, 3)
    P = np.array(info.p, float).reshape(3, 4)[:, :3]
    lens = tuple(float(value) for value in info.d)
    if rectified and P.any():
        K, lens = P, ()
    if not K.any():
        return None
    part = info.binning_x > 1 or info.binning_y > 1 or info.roi.width or info.roi.height
    if (lens and info.distortion_model not in _LENSES) or part or (info.width, info.height) != tuple(size):
        told = f"its CameraInfo has {info.width}x{info.height} px and the lens model '{info.distortion_model}'"
        why = f"{told}{', of a part of the image' if part else ''}; its images have {size[0]}x{size[1]} px"
        raise CalibrationError(why, file=path, remedy="Give intrinsics, and rectified images.")
    return Camera(name, (int(size[0]), int(size[1])), K, lens if any(lens) else ())  # type: ignore[arg-type]


def is_rectified(topic: str) -> bool:
    """Whether a topic's name says that its images have no lens any more: image_rect, image_rect_color, ..."""
    return any(part.startswith("image_rect") for part in topic.split("/"))


def refuse_encoding(topics: Topics, topic: str | None, wanted: str, known: tuple[str, ...]) -> None:
    """Say so where the topic that is asked for has images in an encoding that is not read.

    Raises
    ------
    ObservationError
    """
    if topic is not None and topics.kinds.get(topic) in (IMAGE, COMPRESSED):
        told = encoding(topics.first(topic)) or "nothing"
        if told not in known:
            remedy = f"{wanted} is read from {', '.join(known)}."
            raise ObservationError(f"topic {topic} has images of {told}, no {wanted}", file=topics.path, remedy=remedy)
