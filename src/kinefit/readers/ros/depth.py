"""Depth in MCAP recordings of ROS 2: images, compressed or not, with the camera's intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinefit.readers.depth.images import DepthSource
from kinefit.readers.ros.images import UNITS, camera, counts, encoding, info_of, is_rectified, refuse_encoding
from kinefit.readers.ros.recordings import COMPRESSED, IMAGE, Messages, Topics, reading


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
        topics = Topics(reader, path)
        firsts = {t: topics.first(t) for t in topics.of(IMAGE, COMPRESSED)}
        deep = {t: first for t, first in firsts.items() if encoding(first) in UNITS}
        refuse_encoding(topics, topic, "depth", tuple(UNITS))
        topic = topics.chosen(topic, deep, "depth images (16UC1, 32FC1)", name)
        times, logged = topics.times(topic)
        info, first = info_of(topics, topic), deep[topic]
        size = counts(first, path).shape[::-1]
        seen_by = None if info is None else camera(info, name, size, path, rectified=is_rectified(topic))
    messages = Messages(path, topic, logged)
    return DepthSource(
        len(times), lambda i: counts(messages(i), path).astype(np.float32), (size[0], size[1]), UNITS[encoding(first)],
        True, times, seen_by,
    )  # fmt: skip
