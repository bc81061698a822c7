"""Records of sensor data: frozen, in metres, radians, seconds and pixels.

Readers make them, correspondences use them. Nothing here opens a file or depends on a body. `frames` are records of one
time, `recordings` of a whole take of one sensor.
"""

import warnings
from importlib import import_module
from typing import Any

from kinefit.observations.detections import MEDIAPIPE_33, MEDIAPIPE_75, MEDIAPIPE_478, MEDIAPIPE_HAND_21, Detections
from kinefit.observations.frames import (
    KEYPOINTS,
    BodyTrackerFrame,
    ClickFrame,
    ColourFrame,
    DepthFrame,
    Frame,
    KeypointFrame,
    LiftedFrame,
    LineFrame,
    MarkerFrame,
    PointCloud,
    SilhouetteFrame,
    SurfacePointFrame,
    by_record,
    sensor_of,
)
from kinefit.observations.recordings import KEYPOINT_SIGMA, Keypoints, MarkerEvent, Markers, SkeletonMotion
from kinefit.observations.videos import (
    ClickVideo,
    CloudVideo,
    ColourVideo,
    DepthVideo,
    KeypointVideo,
    LineVideo,
    NamedMarkers,
    SensorRecording,
    SilhouetteVideo,
)

__all__ = [
    "KEYPOINTS", "KEYPOINT_SIGMA", "MEDIAPIPE_33", "MEDIAPIPE_75", "MEDIAPIPE_478", "MEDIAPIPE_HAND_21",
    "BodyTrackerFrame", "ClickFrame", "ClickVideo", "CloudVideo", "ColourFrame", "ColourVideo",
    "DepthFrame", "DepthVideo", "Detections", "Frame", "KeypointFrame", "KeypointVideo", "Keypoints", "LiftedFrame",
    "LineFrame", "LineVideo", "MarkerEvent", "MarkerFrame", "Markers", "NamedMarkers", "PointCloud", "SensorRecording",
    "SilhouetteFrame", "SilhouetteVideo", "SkeletonMotion", "SurfacePointFrame", "by_record",
    "sensor_of",
]


def __getattr__(name: str) -> Any:
    if name != "SurfacePointVideo":
        raise AttributeError(name)
    text = "kinefit.observations.SurfacePointVideo is sensors.kinds.surface_points.SurfacePointRecording now"
    warnings.warn(text, FutureWarning, stacklevel=2)
    return import_module("kinefit.sensors.kinds.surface_points").SurfacePointRecording
