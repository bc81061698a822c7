"""Names of the points of detectors, in each one's order, and arrays of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import kept
from kinefit.errors import ObservationError, check_choice, shortened
from kinefit.observations import MEDIAPIPE_33, MEDIAPIPE_75, MEDIAPIPE_478, Keypoints
from kinefit.observations.arrays import sealed
from kinefit.observations.detections import OPENPOSE_HAND_42
from kinefit.observations.recordings import check_pixels, confidence_of

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
    "COCO_18": tuple(name for name in _BODY_25[:19] if name != "MidHip"),
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


_MAX_GAPS = 100, 10_000
"""Frames for each that is there, and at least, beyond which their numbers are not those of a recording."""


def frame_numbers(values: Sequence[float] | NDArray, what: str = "frame", *, from_first: bool = False) -> NDArray:
    """(N,) int of a table's frame numbers, counted from the smallest if wanted.

    Raises
    ------
    ObservationError
        They are no whole numbers, or too far apart.
    """
    numbers = np.asarray(values, float)
    if (wrong := ~np.isfinite(numbers) | (numbers < 0) | (numbers > 2**31) | (numbers % 1 != 0)).any():
        problem = f"{what} = {numbers[wrong][0]:g}"
        raise ObservationError(problem, remedy="They are whole numbers from 0 on: export the table again.")
    numbers = numbers - numbers.min() if from_first and len(numbers) else numbers
    there, last = len(np.unique(numbers)), float(numbers.max(initial=0.0))
    if last > _MAX_GAPS[0] * there + _MAX_GAPS[1]:
        problem = f"{there} frames in {last + 1:.0f} of {what}"
        raise ObservationError(problem, remedy="The numbers of frames follow each other: export the table again.")
    return numbers.astype(int)


def stacked(people: Sequence[NDArray], points: int) -> NDArray:
    """(F, P, K, 3) x, y [px], confidence of the people of every frame, each (P of the frame, K, 3); else zeros."""
    data = np.zeros((len(people), max(map(len, people), default=0), points, 3))
    for row, persons in zip(data, people, strict=True):
        row[: len(persons)] = persons
    return data


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


_SIDE = re.compile(
    r"(?i:^(left|right)[\W_]*|[\W_]*(left|right)$|^([lr])[\W_]+|[\W_]+([lr])$)|^([LR])(?=[A-Z])|(?<=[a-z])([LR])$"
)  # of a name in the spellings of people and programs: left_knee, LKnee, l-knee, KneeLeft, knee_L


def _spelled(name: str) -> tuple[str, str]:
    """Side, "l", "r" or "", and the rest of a name in small letters, which are alike in all spellings."""
    side = _SIDE.search(name)
    letter = next(filter(None, side.groups()))[0].lower() if side else ""
    return letter, re.sub(r"[\W_]+", "", _SIDE.sub("", name, count=1)).lower()


def known_set(names: Sequence[str], keypoint_set: str | None, file: Path) -> tuple[str, list[int]]:
    """The keypoint set that has points of these names, in any spelling, and the index of each in it.

    Parameters
    ----------
    keypoint_set : that the user states, one of `KEYPOINT_SETS`; default: the smallest that has all of them

    Raises
    ------
    ObservationError
        Names that no set has, listed; two of one point.
    """
    best, unknown = "", list(names)
    for name in [keypoint_set] if keypoint_set else sorted(KEYPOINT_SETS, key=lambda name: len(KEYPOINT_SETS[name])):
        at = {_spelled(point): k for k, point in enumerate(keypoint_names(name))}
        missing = [own for own in names if _spelled(own) not in at]
        if not missing and len({_spelled(own) for own in names}) == len(names) > 0:
            return name, [at[_spelled(own)] for own in names]
        if not best or len(missing) < len(unknown):
            best, unknown = name, missing
    those = f"names of no point of {best}: {shortened(', '.join(unknown), 200)}"
    problem = those if unknown else "two names of one point, or no point"
    remedy = 'Write names = { OWN = "NAME of the set" } into [[keypoints]], "" to leave a point out; or set = a set of '
    raise ObservationError(problem, file=file, remedy=f"{remedy}your own body's, whose points have these names.")


def keypoint_record(
    data: NDArray, camera: str, keypoint_set: str, rate: float, source: Path, *, start: int = 0,
    names: Sequence[str] = (),
) -> Keypoints:  # fmt: skip
    """Make a record of (F, P, K, 3) x, y [px], confidence 0..1; zeros where a point was not detected.

    rate [Hz], number of the first frame, names of the points if the set is the user's own; raises ObservationError for
    a rate that is not positive, and what `Keypoints` raises.
    """
    if not rate > 0 or not np.isfinite(rate):
        raise ObservationError(f"rate {rate} Hz", file=source, remedy="Give a positive frame rate.")
    what = f"keypoints of camera {camera}"
    points, confidence = data[..., :2], confidence_of(data[..., 2], what, source)
    check_pixels(points, confidence, what, source)
    seen = (confidence > 0) | points.any(axis=-1)
    points = sealed(kept(np.where(seen[..., None], points, np.nan)))
    confidence = sealed(kept(np.where(seen, confidence, 0.0)))
    names = tuple(names) or keypoint_names(keypoint_set)
    first = start / rate
    return Keypoints(camera, keypoint_set, names, rate, points, confidence, time_offset=first, source=str(source))
