"""Names of the points of detectors, in each detector's own order; files of other programs, which are not read."""

from __future__ import annotations

import re
from pathlib import Path

from kinefit.errors import ObservationError, check_choice
from kinefit.observations import MEDIAPIPE_33, MEDIAPIPE_75, MEDIAPIPE_478

_FACE_ARMS_LEGS = (
    "Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee RKnee LAnkle RAnkle"
)

_FEET = "LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel"
_FINGERS = "Thumb Index Middle Ring Little"
_HANDS = tuple(
    f"{side}Hand{point}" for side in "LR"
    for point in ("Wrist", *(f"{finger}{k}" for finger in _FINGERS.split() for k in range(1, 5)))
)  # fmt: skip
_BODY_25 = tuple(
    "Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip RKnee RAnkle LHip LKnee LAnkle "
    "REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel".split()
)

KEYPOINT_SETS: dict[str, tuple[str, ...]] = {
    "BODY_25B": (
        *_FACE_ARMS_LEGS.split(),
        "UpperNeck", "HeadTop", *_FEET.split(),
    ),
    "BODY_25": _BODY_25,
    "BODY_25_HANDS": (*_BODY_25, *_HANDS),
    "COCO_17": tuple(_FACE_ARMS_LEGS.split()),
    "COCO_WHOLEBODY_133": (
        *_FACE_ARMS_LEGS.split(), *_FEET.split(), *(f"Face{k}" for k in range(68)), *_HANDS,
    ),
    "HALPE_26": (
        *_FACE_ARMS_LEGS.split(),
        *"Head Neck Hip LBigToe RBigToe LSmallToe RSmallToe LHeel RHeel".split(),
    ),
    "MEDIAPIPE_33": MEDIAPIPE_33,
    "MEDIAPIPE_75": MEDIAPIPE_75,
    "MEDIAPIPE_478": MEDIAPIPE_478,
}  # names in each detector's own order; of OpenPose both hands come after the body, left first

SET_OF_COUNT = {len(KEYPOINT_SETS[name]): name for name in sorted(KEYPOINT_SETS)}
"""The set of a number of points; of 25 BODY_25B."""

HAND_POINTS = 21
"""Number of points of one hand, the same for every detector."""

OPENPOSE_HANDS = "BODY_25_HANDS"
"""The set whose hands OpenPose writes separately from the body."""

MEDIAPIPE_SETS = ("MEDIAPIPE_33", "MEDIAPIPE_75")
"""Sets of MediaPipe, without and with hands."""

FACE_SET = "MEDIAPIPE_478"
"""The face mesh with irises."""

SETS_WITH_HANDS = (OPENPOSE_HANDS, "COCO_WHOLEBODY_133", "MEDIAPIPE_75")
"""Keypoint sets that have the points of both hands."""


def keypoint_names(keypoint_set: str) -> tuple[str, ...]:
    """Names of a keypoint set in the detector's order; raises ObservationError for an unknown set."""
    check_choice("keypoint set", keypoint_set, KEYPOINT_SETS, ObservationError)
    return KEYPOINT_SETS[keypoint_set]


_OTHER_FILES = {  # what such a file has near its start, after spaces: what it is
    rb"\[\s*\{(?=.*\"image_id\")(?=.*\"keypoints\")": "AlphaPose's or COCO's results, a list of all frames' people",
    rb"\{\s*\"[^\"]*\.(?:jpg|jpeg|png)\"\s*:": "AlphaPose's results, all frames' people by image",
    rb"(?=.*\"(?:instances|instance_info)\")": "MMPose's predictions, all frames' people",
    rb"\{(?=.*\"(?:annotations|categories|file_name)\")": "COCO's annotations of many images",
    rb"scorer,.*\nbodyparts,|scorer,.*\nindividuals,": "DeepLabCut's keypoints, a table of all frames",
    rb"\x89HDF\r\n": "keypoints of DeepLabCut or SLEAP, or another HDF5 file",
}
_MAX_START_BYTES = 4096  # in which these are
SPLIT = 'Write one file a frame, NAME_0000.json: {"people": [{"pose_keypoints_2d": [x, y, confidence, ...]}]}.'
"""How keypoints of other programs are to be written."""


def other_keypoints(path: Path) -> str:
    """What a file of another program's keypoints is; "" for any other file."""
    with path.open("rb") as file:
        start = file.read(_MAX_START_BYTES).lstrip()
    return next((what for pattern, what in _OTHER_FILES.items() if re.match(pattern, start, re.DOTALL)), "")


def refuse_other_keypoints(path: Path) -> None:
    """Raise ObservationError for a file of another program's keypoints."""
    if other := other_keypoints(path):
        raise ObservationError(f"{other}, which are not read", file=path, remedy=SPLIT)
