"""Images and cameras of ROS 2 as arrays and as `Camera`; their topics as depth, as videos and as a rig."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._pictures import check_image_size, decode_picture
from kinefit.errors import CalibrationError, FileError, ObservationError, names_file
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.depth.images import DepthSource
from kinefit.readers.ros.recordings import COMPRESSED, IMAGE, INFO, Messages, Topics, median_rate, reading

UNITS = {"16UC1": 0.001, "32FC1": 1.0}
"""[m] of a count of a depth image (REP 118)."""

COLOURS: dict[str, int | None] = {
    "rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB, "bayer_rggb8": cv2.COLOR_BayerBG2RGB, "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB, "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}  # fmt: skip
"""{encoding of a colour image: OpenCV's conversion to RGB} (OpenCV's names of Bayer patterns are shifted)."""

_CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_HEADER_BYTES = 12  # before the PNG of a compressed depth image: its format, and two numbers of its quantisation
_LENS_MODELS = ("plumb_bob", "rational_polynomial", "")  # of OpenCV; "" for no lens


def encoding(message: Any) -> str:
    """Encoding of an image: "16UC1", "rgb8", ...; "jpeg" or "png" if compressed; "" without a message."""
    if message is None:
        return ""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    parts = [part.strip() for part in str(message.format).split(";")]
    if any(part.startswith("compressedDepth") for part in parts[1:]):
        return parts[0] if not any("rvl" in part for part in parts[1:]) else f"{parts[0]} as RVL"
    packed = " ".join(parts).lower()
    return "jpeg" if "jpeg" in packed or "jpg" in packed else "png" if "png" in packed else str(message.format)


def is_colour(message: Any) -> bool:
    """Whether a message is a colour or grey image in a known encoding."""
    return encoding(message) in COLOURS or (message is not None and encoding(message) in ("jpeg", "png"))


def counts(message: Any) -> NDArray:
    """(H, W) depth as recorded, in counts or metres; 0 or NaN at pixels without a measurement.

    Raises
    ------
    FileError
        A damaged image.
    """
    if hasattr(message, "encoding"):
        return _raw(message, np.dtype({"16UC1": "u2", "32FC1": "f4"}[message.encoding]), 1)[..., 0]
    data = bytes(message.data)
    image = decode_picture(data[_HEADER_BYTES:], cv2.IMREAD_UNCHANGED, file="", place="a compressed depth image")
    if image.ndim != 2 or image.dtype != np.uint16:
        raise FileError("a compressed depth image that is no PNG of 16 bits", remedy="Record it raw.")
    if encoding(message) == "32FC1":  # inverse depth in steps (compressed_depth_image_transport)
        _, a, b = struct.unpack_from("<iff", data)
        with np.errstate(divide="ignore"):
            return np.where(image > 0, a / (image.astype(np.float32) - np.float32(b)), 0.0).astype(np.float32)
    return image


def colours(message: Any) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB.

    Raises
    ------
    FileError
        A damaged image.
    """
    if not hasattr(message, "encoding"):
        return decode_picture(bytes(message.data), file="", place=f"a compressed image ({message.format})")
    kind = str(message.encoding)
    image = _raw(message, np.dtype("u1"), _CHANNELS.get(kind, 1))
    change = COLOURS[kind]
    image = image if image.shape[2] > 1 else image[..., 0]
    return image if change is None else np.asarray(cv2.cvtColor(image, change), np.uint8)


def _raw(message: Any, kind: np.dtype, channels: int) -> NDArray:
    """(H, W, channels) of an uncompressed image."""
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    check_image_size((width, height), "", "an image")
    data, row = bytes(message.data), width * channels * kind.itemsize
    if not (height and width and step >= row and len(data) == height * step):
        problem = f"{len(data)} bytes for {width}x{height} px, {step} bytes a row"
        raise FileError(problem, remedy="The recording is damaged: copy it again.")
    rows = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(height, step)[:, :row])
    return rows.view(kind).reshape(height, width, channels)


def info_topic(topics: Topics, image: str) -> str | None:
    """The CameraInfo topic in the folder of an image topic, or in a parent folder; None without one."""
    folder = image.rpartition("/")[0]
    while folder:
        if f"{folder}/camera_info" in topics.of(INFO):
            return f"{folder}/camera_info"
        folder = folder.rpartition("/")[0]
    return None


def info_of(topics: Topics, image: str) -> Any:
    """The first CameraInfo of an image's camera; None without one."""
    topic = info_topic(topics, image)
    return None if topic is None else topics.first(topic)


def camera(info: Any, name: str, size: tuple[int, ...], *, rectified: bool = False) -> Camera | None:
    """The camera of a CameraInfo, at the origin; None if it is not calibrated.

    Parameters
    ----------
    info : message
    name : str
    size : (width, height) [px] of its images
    rectified : whether its images are undistorted: then P holds, without distortion.

    Raises
    ------
    CalibrationError
        A lens model that OpenCV lacks, or a cropped image.
    """
    K = np.array(info.k, float).reshape(3, 3)
    P = np.array(info.p, float).reshape(3, 4)[:, :3]
    lens = tuple(float(value) for value in info.d)
    if rectified and P.any():
        K, lens = P, ()
    if not K.any():
        return None
    part = info.binning_x > 1 or info.binning_y > 1 or info.roi.width or info.roi.height
    if (lens and info.distortion_model not in _LENS_MODELS) or part or (info.width, info.height) != tuple(size):
        stated = f"its CameraInfo has {info.width}x{info.height} px and the lens model '{info.distortion_model}'"
        problem = f"{stated}{', of a part of the image' if part else ''}; its images have {size[0]}x{size[1]} px"
        raise CalibrationError(problem, remedy="Give intrinsics, and rectified images.")
    return Camera(name, (int(size[0]), int(size[1])), K, lens if any(lens) else ())  # type: ignore[arg-type]


def is_rectified(topic: str) -> bool:
    """Whether a topic's name says that its images are undistorted: image_rect, image_rect_color, ..."""
    return any(part.startswith("image_rect") for part in topic.split("/"))


def refuse_encoding(topics: Topics, topic: str | None, wanted: str, known: tuple[str, ...]) -> None:
    """Check the encoding of the images of a requested topic.

    Raises
    ------
    ObservationError
        An encoding that is not among the `known` ones.
    """
    if topic is not None and topics.kinds.get(topic) in (IMAGE, COMPRESSED):
        found = encoding(topics.first(topic)) or "nothing"
        if found not in known:
            remedy = f"{wanted} is read from {', '.join(known)}."
            raise ObservationError(f"topic {topic} has images of {found}, no {wanted}", remedy=remedy)


def mcap_source(path: Path, name: str, topic: str | None = None) -> DepthSource:
    """Source of a depth topic; by default the only one, or the one with a part called `name`.

    Times are those of the images' headers, or of the log if these do not increase; 0 is the recording's first image of
    any topic. The intrinsics are those of the topic's CameraInfo.

    Raises
    ------
    FileError
        The extra is not installed, or the file is damaged.
    ObservationError
        No such topic, a topic without depth, or no unique depth topic.
    CalibrationError
        A lens model that OpenCV lacks, or a cropped image.
    """
    with reading(path) as reader:
        topics = Topics(reader)
        firsts = {t: topics.first(t) for t in topics.of(IMAGE, COMPRESSED)}
        deep = {t: first for t, first in firsts.items() if encoding(first) in UNITS}
        refuse_encoding(topics, topic, "depth", tuple(UNITS))
        topic = topics.chosen(topic, deep, "depth images (16UC1, 32FC1)", name)
        times, logged = topics.times(topic)
        info, first = info_of(topics, topic), deep[topic]
        size = counts(first).shape[::-1]
        seen_by = None if info is None else camera(info, name, size, rectified=is_rectified(topic))
    images = Messages(path, topic, logged, lambda message: counts(message).astype(np.float32))
    return DepthSource(len(times), images, (size[0], size[1]), UNITS[encoding(first)], True, times, seen_by)


_MAX_GAP_S = 0.5  # without an image, or three frames if that is longer
_MAX_REPEATS = 100  # mean number of frames that show one image; a tenth of it where half of all images were dropped


class McapVideo:
    """Images resampled to the recording's median rate: each frame shows the image nearest in time.

    Frame 0 is at the recording's first image of any topic, so that cameras of one recording are in step.

    Parameters
    ----------
    path : Path of the recording
    topic : str or None
        None: the only one with images in colour or grey.

    Raises
    ------
    FileError
        The extra is not installed, or the file is damaged.
    ObservationError
        No such topic, an unknown encoding, no unique image topic; a gap of more than half a second and three frames;
        times that give no rate.
    """

    note: ClassVar[str] = ""

    def __init__(self, path: Path, topic: str | None) -> None:
        with reading(path) as reader:
            topics = Topics(reader)
            fitting = [t for t in topics.of(IMAGE, COMPRESSED) if is_colour(topics.first(t))]
            refuse_encoding(topics, topic, "image", (*COLOURS, "jpeg", "png"))
            self.topic = topics.chosen(topic, fitting, "images in colour or grey")
            times, logged = topics.times(self.topic)
            first = colours(topics.first(self.topic))
            rate = median_rate(times, self.topic)
            gaps = np.flatnonzero(np.diff(times, prepend=0.0) > max(_MAX_GAP_S, 3.0 / rate))
            if len(gaps):
                begin, end = (0.0, *times)[gaps[0]], times[gaps[0]]
                problem = f"no image on the topic {self.topic} from {begin:.2f} to {end:.2f} s"
                remedy = "Cut the recording to the time that all its cameras share: `mcap filter`."
                raise ObservationError(problem, remedy=remedy)
            if times[-1] * rate > _MAX_REPEATS * len(times):
                problem = f"the images on the topic {self.topic} come in bursts at {rate:.6g} Hz, with gaps between"
                raise ObservationError(problem, remedy="Record them with the times at which they were taken.")
        self.path, self.size = path, (int(first.shape[1]), int(first.shape[0]))
        self.rate = round(rate, 6)
        at = np.arange(round(times[-1] * self.rate) + 1) / self.rate
        after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        self._shown = np.where(at - times[after - 1] <= times[after] - at + 1e-6, after - 1, after)
        self._messages, self._last = Messages(path, self.topic, logged, colours), (0, first)

    def __len__(self) -> int:
        return len(self._shown)

    def close(self) -> None:
        """Close the file."""
        self._messages.close()

    @property
    def times(self) -> NDArray:
        """(N,) [s] from the recording's first image."""
        return np.arange(len(self)) / self.rate

    def image(self, i: int) -> NDArray[np.uint8]:
        """Frame `i` as (H, W, 3) uint8 RGB; raises ObservationError for an image of another size."""
        number = int(self._shown[i])
        if number != self._last[0]:
            image = self._messages(number)
            if image.shape[1::-1] != self.size:
                problem = f"{image.shape[1]}x{image.shape[0]} px, but the first image has {self.size[0]}x{self.size[1]}"
                remedy = "All images of a camera must have one size."
                raise ObservationError(problem, file=self.path, place=f"{self.topic}, frame {i}", remedy=remedy)
            self._last = number, image
        return self._last[1].copy()


_STATIC = "/tf_static"


@names_file
def mcap_rig(path: Path) -> Rig:
    """Read every camera with a CameraInfo; its name is the shortest unique end of the topic's folder.

    /front/color/camera_info and /front/depth/camera_info are `color` and `depth`; together with /side/color/camera_info
    they are `front_color` and `depth`. Poses are those of the frames in the messages' headers, by /tf_static, in their
    common root frame; the optical axis is z, x to the right, y down (REP 103). A single camera without transforms is
    the world.

    Raises
    ------
    CalibrationError
        No camera, an uncalibrated one, one without a transform, a lens model that OpenCV lacks.
    FileError
        As `readers.ros.recordings.reading`.
    """
    with reading(path) as reader:
        topics = Topics(reader)
        infos, names = _infos(topics), camera_names(topics)
        tree = _tree(topics) if _STATIC in topics.kinds else {}
        images = topics.of(IMAGE, COMPRESSED)
        if not infos:
            remedy = "Record camera_info of each camera."
            raise CalibrationError("no topic of it has a CameraInfo", remedy=remedy)
        cameras = []
        for folder, info in infos.items():
            in_folder = [topic for topic in images if topic.startswith(f"{folder}/")]
            rectified = bool(in_folder) and all(is_rectified(topic) for topic in in_folder)
            found = camera(info, names[folder], (int(info.width), int(info.height)), rectified=rectified)
            if found is None:
                problem = f"the CameraInfo of {folder} is not calibrated"
                raise CalibrationError(problem, remedy="Calibrate the camera, or record without this topic.")
            cameras.append(found)
        frames = [str(info.header.frame_id).lstrip("/") for info in infos.values()]
    if len(frames) == 1 and frames[0] not in tree:
        return Rig(tuple(cameras))
    roots = [_root(frame, tree) for frame in frames]
    for frame, (root, _) in zip(frames, roots):
        if root != roots[0][0]:
            raise CalibrationError(
                f"no transform in {_STATIC} between the frames {frames[0]} (below {roots[0][0]}) and {frame} "
                f"(below {root})", remedy=f"Record {_STATIC}, and publish where each camera stands.",
            )  # fmt: skip
    return Rig(tuple(c.with_pose(se3.inverse(T)) for c, (_, T) in zip(cameras, roots)))


def _infos(topics: Topics) -> dict[str, Any]:
    """{folder: the first CameraInfo in it}."""
    infos = {topic.rpartition("/")[0]: topics.first(topic) for topic in topics.of(INFO)}
    return {folder: info for folder, info in infos.items() if info is not None}


def camera_names(topics: Topics) -> dict[str, str]:
    """{folder of a CameraInfo: its camera's name}, the shortest unique end of each folder."""
    out, folders = {}, list(_infos(topics))
    for folder in folders:
        parts, end = folder.strip("/").split("/"), folder
        for count in range(1, len(parts) + 1):
            end = "/".join(parts[-count:])
            if sum(f"/{other.strip('/')}".endswith(f"/{end}") for other in folders) == 1:
                break
        out[folder] = end.replace("/", "_")
    return out


def _tree(topics: Topics) -> dict[str, tuple[str, NDArray]]:
    """{frame: (its parent, T_parent_frame)}."""
    out: dict[str, tuple[str, NDArray]] = {}
    for message in topics.all(_STATIC):
        for t in message.transforms:
            out[str(t.child_frame_id).lstrip("/")] = str(t.header.frame_id).lstrip("/"), _matrix(t.transform)
    return out


def _matrix(transform: Any) -> NDArray:
    """(4, 4) of a geometry_msgs/Transform."""
    q = np.array([getattr(transform.rotation, axis) for axis in "wxyz"], float)
    R = se3.rotation_from_quaternion(q) if q.any() else np.eye(3)
    return se3.transform(R, np.array([getattr(transform.translation, axis) for axis in "xyz"], float))


def _root(frame: str, tree: dict[str, tuple[str, NDArray]]) -> tuple[str, NDArray]:
    """The root of a frame, and T_root_frame (4, 4)."""
    T, seen = np.eye(4), set[str]()
    while frame in tree and frame not in seen:
        seen.add(frame)
        frame, step = tree[frame]
        T = step @ T
    return frame, T


@dataclass(frozen=True)
class Shown:
    """A topic with images.

    Parameters
    ----------
    topic : str
    deep : whether they are depth; else colour
    camera : its name in the recording's rig (`mcap_rig`); None without a CameraInfo
    frames : int; rate : float [Hz]
    """

    topic: str
    deep: bool
    camera: str | None
    frames: int
    rate: float

    @property
    def name(self) -> str:
        """A name for the sensor: the camera's, or the topic's folder."""
        return self.camera or self.topic.rpartition("/")[0].strip("/").replace("/", "_") or self.topic.strip("/")


def shown(path: Path) -> list[Shown]:
    """Topics with two images or more in a known encoding, one for each camera and kind; raw ones first.

    Raises
    ------
    FileError
        As `readers.ros.recordings.reading`.
    ObservationError
        As `readers.ros.recordings.median_rate`.
    """
    out: dict[tuple[str, bool], Shown] = {}
    with reading(path) as reader:
        topics = Topics(reader)
        names = camera_names(topics)
        for topic in sorted(topics.of(IMAGE, COMPRESSED), key=lambda name: (is_rectified(name), len(name), name)):
            first = topics.first(topic)
            deep = encoding(first) in UNITS
            times = topics.times(topic)[0] if deep or is_colour(first) else np.zeros(0)
            if len(times) > 1:
                folder = (info_topic(topics, topic) or "").rpartition("/")[0]
                rate = round(median_rate(times, topic), 3)
                found = Shown(topic, deep, names.get(folder), len(times), rate)
                out.setdefault((found.name, deep), found)
    return sorted(out.values(), key=lambda found: found.topic)
