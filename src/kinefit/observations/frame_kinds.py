"""The kinds of frames, and the name of the sensor that sees a frame."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

from kinefit.observations.frames import (
    ClickFrame,
    ColourFrame,
    DepthFrame,
    KeypointFrame,
    LiftedFrame,
    LineFrame,
    MarkerFrame,
    PointCloud,
    SilhouetteFrame,
)

Frame = DepthFrame | PointCloud | KeypointFrame | MarkerFrame | SilhouetteFrame | LineFrame | ColourFrame | LiftedFrame
"""What a sensor of a known kind sees at one time; a `ClickFrame` is a `LineFrame`."""

KEYPOINTS = "keypoints"
"""Name of the one sensor of the keypoint detectors of all cameras."""

_NAMES = {
    KeypointFrame: KEYPOINTS, SilhouetteFrame: "silhouette {}", LineFrame: "lines {}", ClickFrame: "clicks {}",
    ColourFrame: "region {}", LiftedFrame: "lifted {}",
}  # fmt: skip


def sensor_of(frame: object) -> str:
    """Name of a frame's sensor: its `sensor`, with a prefix for kinds that may share a camera."""
    return _NAMES.get(type(frame), "{}").format(getattr(frame, "sensor", ""))


def by_record(frames: Iterable[Any]) -> Mapping[type, list[Any]]:
    """Frames of one time by class: `by_record(frames)[DepthFrame]`; an empty list for a class without frames."""
    out = defaultdict[type, list[Any]](list)
    for frame in frames:
        out[type(frame)].append(frame)
    return out
