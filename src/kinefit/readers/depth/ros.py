"""Depth in MCAP recordings of ROS 2 (extra `ros`): images, compressed or not, and what the camera says of its lens."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, FileError, KinefitError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.readers.depth.images import DepthSource

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_INFO = "sensor_msgs/msg/CameraInfo"
_UNITS = {"16UC1": 0.001, "32FC1": 1.0}  # [m] a count (REP 118)
_HEADER = 12  # bytes before the PNG of a compressed depth image
_LENSES = ("plumb_bob", "rational_polynomial", "")  # those of OpenCV; none


def mcap_source(path: Path, name: str) -> DepthSource:
    """Depth of the one topic that shows it, or of the one with a part called `name`.

    Times are those of the images' headers, or of the recording where these do not increase; 0 is the first image. The
    lens is that of the CameraInfo beside the topic.

    Raises
    ------
    FileError
        The extra is not installed, or the file is damaged.
    ObservationError
        No topic shows depth, or several do.
    CalibrationError
        A lens that OpenCV does not have, or a part of its image.
    """
    with _read(path) as reader:
        summary = reader.get_summary()
        if summary is None:
            told = "it has no index: was the recording cut short?"
            raise FileError(told, file=path, remedy="Run `mcap recover` on it.")
        kinds = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
        firsts = {topic: _first(reader, topic) for topic, kind in kinds.items() if kind in (_IMAGE, _COMPRESSED)}
        topic = _chosen({topic: first for topic, first in firsts.items() if _encoding(first) in _UNITS}, name, path)
        stamps, logged = [], []
        for _, _, message in reader.iter_messages(topics=[topic]):
            stamps.append(_stamp(message.data))
            logged.append(message.log_time)
        info = _info(reader, [t for t, kind in kinds.items() if kind == _INFO], topic)
        first = firsts[topic]
        size = _counts(first, path).shape[::-1]
    times = np.array(stamps if np.all(np.diff(stamps) > 0) else logged, np.int64)
    camera = None if info is None else _camera(info, name, size, path)
    unit = _UNITS[_encoding(first)]
    return DepthSource(
        len(times), _Frames(path, topic, logged), size, unit, True, (times - times[0]) * 1e-9, camera  # type: ignore[arg-type]
    )


class _Frames:
    """Images of a topic by number."""

    def __init__(self, path: Path, topic: str, logged: list[int]) -> None:
        self._path, self._topic, self._logged = path, topic, logged

    def __call__(self, i: int) -> NDArray:
        at = self._logged[i]
        before = i - self._logged.index(at)  # of several that were logged at once
        with _read(self._path) as reader:
            span = {"starting_at": at, "ending_at": at}
            for k, (*_, message) in enumerate(reader.iter_decoded_messages(topics=[self._topic], **span)):
                if k == before:
                    return _counts(message, self._path).astype(np.float32)
        raise FileError("frame cannot be found again", file=self._path, place=f"frame {i}", remedy="Copy it again.")


@contextmanager
def _read(path: Path) -> Iterator[Any]:
    """A reader; whatever its library raises becomes an error of the file."""
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise FileError(
            "an MCAP recording needs the package mcap-ros2-support, which is not installed", file=path,
            remedy="pip install 'kinefit[ros]'",
        ) from None  # fmt: skip
    try:
        with open(path, "rb") as file:
            yield make_reader(file, decoder_factories=[DecoderFactory()])
    except KinefitError:
        raise
    except Exception as error:  # of damaged files libraries raise anything
        told = f"no recording of ROS 2 that can be read ({type(error).__name__}: {error})"
        raise FileError(told, file=path, remedy="Copy it again; `mcap doctor` says what is wrong with it.") from error


def _first(reader: Any, topic: str) -> Any:
    return next((message for *_, message in reader.iter_decoded_messages(topics=[topic])), None)


def _encoding(message: Any) -> str:
    """Of an image, "" where it is no depth that can be read."""
    if message is None:
        return ""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    told = [part.strip() for part in str(message.format).split(";")]
    return "16UC1" if told[0] == "16UC1" and any(part.startswith("compressedDepth") for part in told[1:]) else ""


def _chosen(topics: dict[str, Any], name: str, path: Path) -> str:
    named = [topic for topic in topics if name in topic.split("/")] or list(topics)
    if len(named) == 1:
        return named[0]
    if not named:
        told = "no topic of it has depth images (16UC1, 32FC1, or 16UC1 as compressedDepth)"
        raise ObservationError(told, file=path, remedy="Record the depth camera's image topic.")
    told = f"{len(named)} topics have depth images: {', '.join(sorted(named))}"
    raise ObservationError(told, file=path, remedy="Name the sensor as a part of its topic, between slashes.")


def _stamp(data: bytes) -> int:
    """[ns] of the header that a message begins with, in CDR."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 10**9 + nanoseconds


def _counts(message: Any, path: Path) -> NDArray:
    """(H, W) as recorded."""
    if not hasattr(message, "encoding"):
        packed = np.frombuffer(bytes(message.data), np.uint8)[_HEADER:]
        image = cv2.imdecode(packed, cv2.IMREAD_UNCHANGED) if len(packed) else None
        if image is None or image.ndim != 2 or image.dtype != np.uint16:
            raise FileError("a compressed depth image that is no PNG of 16 bits", file=path, remedy="Record it raw.")
        return image
    kind = np.dtype({"16UC1": "u2", "32FC1": "f4"}[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = bytes(message.data)
    if not (height and width and step >= width * kind.itemsize and len(data) == height * step):
        told = f"{len(data)} bytes for {width}x{height} px, {step} bytes a row"
        raise FileError(told, file=path, remedy="The recording is damaged: copy it again.")
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, : width * kind.itemsize]
    return np.ascontiguousarray(rows).view(kind)


def _info(reader: Any, topics: list[str], image: str) -> Any:
    """The first CameraInfo of the topic in the folder of the image's, or in one above; None where there is none."""
    folder = image.rpartition("/")[0]
    while folder:
        for topic in topics:
            if topic == f"{folder}/camera_info":
                return _first(reader, topic)
        folder = folder.rpartition("/")[0]
    return None


def _camera(info: Any, name: str, size: tuple[int, ...], path: Path) -> Camera | None:
    K = np.array(info.k, float).reshape(3, 3)
    if not K.any():  # not calibrated
        return None
    part = info.binning_x > 1 or info.binning_y > 1 or info.roi.width or info.roi.height
    if info.distortion_model not in _LENSES or part or (info.width, info.height) != tuple(size):
        told = f"its CameraInfo has {info.width}x{info.height} px and the lens model '{info.distortion_model}'"
        why = f"{told}{', of a part of the image' if part else ''}; its images have {size[0]}x{size[1]} px"
        raise CalibrationError(why, file=path, remedy="Give intrinsics, and rectified images.")
    lens = tuple(float(value) for value in info.d)
    return Camera(name, (int(size[0]), int(size[1])), K, lens if any(lens) else ())  # type: ignore[arg-type]
