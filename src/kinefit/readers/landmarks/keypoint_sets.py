"""Names of the points of detectors, in each one's order, and arrays of them; files of other programs, refused."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import kept
from kinefit.errors import ObservationError, check_choice
from kinefit.observations import MEDIAPIPE_33, MEDIAPIPE_75, MEDIAPIPE_478, Keypoints
from kinefit.observations.arrays import sealed
from kinefit.observations.detections import OPENPOSE_HAND_42
from kinefit.observations.recordings import check_pixels, confidence_of

if TYPE_CHECKING:
    from kinefit.geometry.camera import ImageFrame

_FACE_ARMS_LEGS = (
    "Nose LEye REye LEar REar LShoulder RShoulder LElbow RElbow LWrist RWrist LHip RHip LKnee RKnee LAnkle RAnkle"
)

_FEET = "LBigToe LSmallToe LHeel RBigToe RSmallToe RHeel"
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
    "BODY_25_HANDS": (*_BODY_25, *OPENPOSE_HAND_42),
    "COCO_17": tuple(_FACE_ARMS_LEGS.split()),
    "COCO_WHOLEBODY_133": (
        *_FACE_ARMS_LEGS.split(), *_FEET.split(), *(f"Face{k}" for k in range(68)), *OPENPOSE_HAND_42,
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


_BONES = (
    ("Nose", "LEye"), ("Nose", "REye"), ("LEye", "LEar"), ("REye", "REar"), ("LHip", "RHip"),
    ("LShoulder", "RShoulder"), *((f"{side}{a}", f"{side}{b}") for side in "LR" for a, b in (
        ("Shoulder", "Elbow"), ("Elbow", "Wrist"), ("Shoulder", "Hip"), ("Hip", "Knee"), ("Knee", "Ankle"),
    )),
)  # fmt: skip
_MAX_COMPARED_FRAMES = 60  # spread over the recording
_MIN_COMPARED_PEOPLE = 5  # in these, with half of their points: fewer do not contradict what is stated
_MAX_LENGTH_RATIO = 0.7
"""Mean length of the bones in the right order of points to that in the other one: 0.37 to 0.52 for BODY_25 and BODY_25B
in recordings."""

FACE_POINTS = 468, 478
"""Points of a face mesh without and with irises."""


def cut_frames(items: Any, frames: tuple[int, int] | None, file: Path) -> tuple[Any, int]:
    """Slice of the frames [start, stop) and its start; raises ObservationError if there are fewer."""
    if frames is None:
        return items, 0
    if not 0 <= frames[0] < frames[1] <= len(items):
        problem = f"frames [{frames[0]}, {frames[1]}] of {len(items)}"
        raise ObservationError(problem, file=file, remedy=f"Give frames within [0, {len(items)}].")
    return items[frames[0] : frames[1]], frames[0]


def face_mesh(data: NDArray) -> NDArray:
    """(F, 478, 3) x, y [px] and 1 where detected, of a face mesh (F, 468 or 478, 3) whose third column is a depth."""
    uv = data[..., :2]
    seen = np.concatenate([uv, uv.any(axis=-1, keepdims=True)], axis=-1)
    return np.pad(seen, ((0, 0), (0, max(FACE_POINTS) - data.shape[1]), (0, 0)))


def in_right_order(record: Keypoints, *, stated: bool) -> Keypoints:
    """The record as the keypoint set of as many points that it fits: in the right order bones are short.

    Parameters
    ----------
    stated : whether the user states the record's set, else it is a guess.

    Raises
    ------
    ObservationError
        The points are clearly in another order than stated.
    """
    own, rows = record.keypoint_set, slice(None, None, len(record) // _MAX_COMPARED_FRAMES + 1)
    uv = np.where((record.confidence[rows] > 0.0)[..., None], record.points[rows], np.nan)
    uv = uv[np.isfinite(uv[..., 0]).mean(axis=-1) > 0.5]
    orders = [name for name, names in KEYPOINT_SETS.items() if len(names) == len(record.names)]
    lengths = {name: _mean_bone(uv, KEYPOINT_SETS[name]) for name in orders} if len(orders) > 1 else {own: 0.0}
    best = min(lengths, key=lambda name: lengths[name])
    if not 0.0 < lengths[best] < _MAX_LENGTH_RATIO * lengths[own] or (stated and len(uv) < _MIN_COMPARED_PEOPLE):
        return record
    if stated:
        longer = lengths[own] / lengths[best]
        problem = f"the points are in the order of {best}: as {own}, bones are {longer:.1f} times as long"
        raise ObservationError(problem, file=record.source, remedy=f'Write set = "{best}" into [[keypoints]].')
    return record.first_points(best, KEYPOINT_SETS[best])


def _mean_bone(uv: NDArray, names: Sequence[str]) -> float:
    """Mean length of the bones of people (N, K, 2) [px], as a share of their extent; infinite without bones."""
    start, end = np.array([(names.index(a), names.index(b)) for a, b in _BONES]).T
    extent = np.linalg.norm(np.fmax.reduce(uv, axis=1) - np.fmin.reduce(uv, axis=1), axis=-1)
    lengths = np.linalg.norm(uv[:, start] - uv[:, end], axis=-1) / np.maximum(extent, 1.0)[:, None]
    known = np.isfinite(lengths).any(axis=0)
    return float(np.nanmedian(lengths[:, known], axis=0).mean()) if known.any() else np.inf


def keypoint_record(
    data: NDArray, camera: str, keypoint_set: str, rate: float, time_offset: float, start: int, source: Path,
    image_frame: ImageFrame | None,
) -> Keypoints:  # fmt: skip
    """Make a record of (F, P, K, 3) x, y [px], confidence 0..1; zeros where a point was not detected.

    rate [Hz], time_offset [s]; raises ObservationError for a rate that is not positive, and what `Keypoints` raises.
    """
    if not rate > 0 or not np.isfinite(rate):
        raise ObservationError(f"rate {rate} Hz", file=source, remedy="Give a positive frame rate.")
    what = f"keypoints of camera {camera}"
    points, confidence = data[..., :2], confidence_of(data[..., 2], what, source)
    check_pixels(points, confidence, what, source)  # before they are converted
    seen = (confidence > 0) | points.any(axis=-1)
    if image_frame is not None:
        points = image_frame.to_calibration(points)
    points = sealed(kept(np.where(seen[..., None], points, np.nan)))
    confidence = sealed(kept(np.where(seen, confidence, 0.0)))
    offset = time_offset + start / rate
    names = keypoint_names(keypoint_set)
    return Keypoints(camera, keypoint_set, names, rate, points, confidence, time_offset=offset, source=str(source))
