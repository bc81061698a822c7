"""Cameras of an MCAP recording (ROS 2): intrinsics from CameraInfo, poses from /tf_static; which topics have images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.ros.images import UNITS, camera, encoding, info_topic, is_colour, is_rectified
from kinefit.readers.ros.recordings import COMPRESSED, IMAGE, INFO, Topics, median_rate, reading

_STATIC = "/tf_static"


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
        topics = Topics(reader, path)
        infos, names = _infos(topics), camera_names(topics)
        tree = _tree(topics) if _STATIC in topics.kinds else {}
        images = topics.of(IMAGE, COMPRESSED)
        if not infos:
            remedy = "Record camera_info of each camera."
            raise CalibrationError("no topic of it has a CameraInfo", file=path, remedy=remedy)
        cameras = []
        for folder, info in infos.items():
            in_folder = [topic for topic in images if topic.startswith(f"{folder}/")]
            rectified = bool(in_folder) and all(is_rectified(topic) for topic in in_folder)
            found = camera(info, names[folder], (int(info.width), int(info.height)), path, rectified=rectified)
            if found is None:
                problem = f"the CameraInfo of {folder} is not calibrated"
                raise CalibrationError(problem, file=path, remedy="Calibrate the camera, or record without this topic.")
            cameras.append(found)
        frames = [str(info.header.frame_id).lstrip("/") for info in infos.values()]
    if len(frames) == 1 and frames[0] not in tree:
        return Rig(tuple(cameras))
    roots = [_root(frame, tree) for frame in frames]
    for frame, (root, _) in zip(frames, roots):
        if root != roots[0][0]:
            raise CalibrationError(
                f"no transform in {_STATIC} between the frames {frames[0]} (below {roots[0][0]}) and {frame} "
                f"(below {root})", file=path, remedy=f"Record {_STATIC}, and publish where each camera stands.",
            )  # fmt: skip
    return Rig(tuple(_placed(c, T) for c, (_, T) in zip(cameras, roots)))


def _placed(c: Camera, T_world_camera: NDArray) -> Camera:
    lens = () if c.distortion is None else tuple(c.distortion)
    return Camera(c.name, c.size, c.matrix, lens, T_camera_world=se3.inverse(T_world_camera))  # type: ignore[arg-type]


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
        topics = Topics(reader, path)
        names = camera_names(topics)
        for topic in sorted(topics.of(IMAGE, COMPRESSED), key=lambda name: (is_rectified(name), len(name), name)):
            first = topics.first(topic)
            deep = encoding(first) in UNITS
            times = topics.times(topic)[0] if deep or is_colour(first) else np.zeros(0)
            if len(times) > 1:
                folder = (info_topic(topics, topic) or "").rpartition("/")[0]
                rate = round(median_rate(times, topic, path), 3)
                found = Shown(topic, deep, names.get(folder), len(times), rate)
                out.setdefault((found.name, deep), found)
    return sorted(out.values(), key=lambda found: found.topic)
