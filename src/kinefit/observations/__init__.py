"""Records of sensor data: frozen, in metres, radians, seconds and pixels.

Readers make them, correspondences use them. Nothing here opens a file or depends on a body. `frames` are records of one
time, `recordings` of a whole take of one sensor.
"""

from kinefit.observations.body_trackers import BodyTrackerFrame, BodyTrackerVideo
from kinefit.observations.colours import ColourVideo
from kinefit.observations.depth import CloudVideo, DepthVideo
from kinefit.observations.detections import MEDIAPIPE_33, MEDIAPIPE_75, MEDIAPIPE_478, MEDIAPIPE_HAND_21, Detections
from kinefit.observations.features import ClickVideo, KeypointVideo, LineVideo, NamedMarkers
from kinefit.observations.frame_kinds import KEYPOINTS, Frame, by_record, sensor_of
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
from kinefit.observations.recordings import KEYPOINT_SIGMA, Keypoints, MarkerEvent, Markers, SkeletonMotion
from kinefit.observations.silhouettes import SilhouetteVideo
from kinefit.observations.surface_points import SurfacePointFrame, SurfacePointVideo

__all__ = [
    "KEYPOINTS", "KEYPOINT_SIGMA", "MEDIAPIPE_33", "MEDIAPIPE_75", "MEDIAPIPE_478", "MEDIAPIPE_HAND_21",
    "BodyTrackerFrame", "BodyTrackerVideo", "ClickFrame", "ClickVideo", "CloudVideo", "ColourFrame", "ColourVideo",
    "DepthFrame", "DepthVideo", "Detections", "Frame", "KeypointFrame", "KeypointVideo", "Keypoints", "LiftedFrame",
    "LineFrame", "LineVideo", "MarkerEvent", "MarkerFrame", "Markers", "NamedMarkers", "PointCloud", "SilhouetteFrame",
    "SilhouetteVideo", "SkeletonMotion", "SurfacePointFrame", "SurfacePointVideo", "by_record", "sensor_of",
]
