"""Depth in MCAP recordings of ROS 2: images, compressed or not, and what the camera says of its lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kinefit.readers.depth.images import DepthSource
from kinefit.readers.ros.images import UNITS, camera, counts, encoding, info_of, is_rectified, refuse_encoding
from kinefit.readers.ros.recordings import COMPRESSED, IMAGE, Messages, Topics, reading


def mcap_source(path: Path, name: str, topic: str | None = None) -> DepthSource:
    """Depth of a topic; by default of the one that shows it, or of the one with a part called `name`.

    Times are those of the images' headers, or of the recording where these do not increase; 0 is the recording's first
    image of any topic. The lens is that of the CameraInfo beside the topic.

    Raises
    ------
    FileError
        The extra is not installed, or the file is damaged.
    ObservationError
        No such topic, one without depth, or none or several that have depth.
    CalibrationError
        A lens that OpenCV does not have, or a part of its image.
    """
    with reading(path) as reader:
        topics = Topics(reader, path)
        firsts = {one: topics.first(one) for one in topics.of(IMAGE, COMPRESSED)}
        deep = {one: first for one, first in firsts.items() if encoding(first) in UNITS}
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
