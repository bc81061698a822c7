"""List the topics of an MCAP recording of ROS 2 with depth and colour images, with their cameras and rates."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kinefit.readers.ros.images import UNITS, encoding, info_topic, is_colour, is_rectified
from kinefit.readers.ros.recordings import COMPRESSED, IMAGE, Topics, median_rate, reading
from kinefit.readers.ros.rig import camera_names


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
