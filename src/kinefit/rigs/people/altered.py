"""Videos of a take that no camera can be found from: mirrored, in slow motion, or of people that no other one shows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from kinefit.errors import CalibrationError
from kinefit.geometry.camera import Camera
from kinefit.images.detectors.roi import MIRROR
from kinefit.observations import MEDIAPIPE_33, Detections, Keypoints
from kinefit.readers.landmarks.detections import read_detections
from kinefit.readers.take.cameras import assumed_camera, is_uncalibrated
from kinefit.readers.take.file import Take
from kinefit.rigs.people.skeletons import LiftedSkeleton, match_skeletons, skeletons_of

_RATE, _SECONDS = 15.0, 30.0  # [Hz], [s] of each video that are compared
_CLOCKS_S = 2.0  # that cameras may be early or late
_MAX_COST = 0.25  # of two right videos: 0.10 to 0.18 of a real recording; others are looked at closely
_MAX_COST_RATIO = 0.6  # of altered to direct: 0.27 to 0.38 of a mirrored video, 2.1 to 3.5 of pairs of right ones
_SLOWER = 2, 4, 8  # times that a video of 60, 120 or 240 Hz plays slower at 30 Hz
_MIN_COMMON = 10  # frames at `_RATE` in which two cameras see somebody
_FLIP = np.array([-1.0, 1.0, 1.0])


def refuse_videos(take: Take) -> None:
    """Refuse a take without calibration in which a video is mirrored, plays slower than it was filmed, or stands alone.

    The skeletons that the detector lifted in two cameras are laid on each other as `first_cameras` does it; where they
    move little alike, and far more alike once a video is mirrored back or sped up, it is said of the camera of which
    that holds against most others.

    Raises
    ------
    CalibrationError
        Such a video; one that shows somebody only while no other does, however clocks are set within two seconds.
    FileError
        Detections that cannot be read.
    """
    files = {entry.camera: entry.file for entry in take.keypoints if entry.format == "detect" and entry.file}
    cameras = [entry for entry in take.cameras if entry.name in files]
    if not is_uncalibrated(take) or len(cameras) < 2:
        return
    found = [read_detections(files[entry.name]) for entry in cameras]  # type: ignore[arg-type]
    if any(one.lifted is None or not one.seen.any() for one in found):
        return
    latest = max(entry.time_offset for entry in cameras)
    begins = [latest - entry.time_offset for entry in cameras]  # [s] into each video, when all record
    lenses = [assumed_camera(entry, one.size, take) for entry, one in zip(cameras, found, strict=True)]
    direct = [_skeleton(*one) for one in zip(lenses, found, begins, strict=True)]
    if min(len(one.x) for one in direct) < _MIN_COMMON:
        return  # `load_observations` refuses videos that are so short
    for i, own in enumerate(direct):
        if all(_frames_in_common(own, other) < _MIN_COMMON for j, other in enumerate(direct) if j != i):
            problem = f"{cameras[i].name} sees people only while no other camera does"
            remedy = "Use videos of the same moment that were started within two seconds, or remove this one."
            raise CalibrationError(problem, file=take.path, place=f"camera {cameras[i].name}", remedy=remedy)
    votes: dict[tuple[int, int], int] = {}  # camera, 0 for mirrored or the times that it plays slower
    for i, j in combinations(range(len(lenses)), 2):
        cost = _cost(direct[i], direct[j])
        if cost < _MAX_COST:
            continue
        trials = {
            (b, how): _cost(direct[a], other)
            for a, b in ((i, j), (j, i)) for how, other in _altered(lenses[b], found[b], begins[b])
        }  # fmt: skip
        trials[i, 0] = trials[j, 0]  # of a pair, either may be mirrored
        least = min(trials.values())
        for key, value in trials.items():
            votes[key] = votes.get(key, 0) + (value <= least + 1e-9 and least < _MAX_COST_RATIO * cost)
    if not votes or max(votes.values()) <= (len(lenses) - 1) / 2:
        return
    which_camera, slower = max(votes, key=lambda one: votes[one])
    name = cameras[which_camera].name
    if slower:
        problem = f"plays in slow motion: people move {slower} times as slowly as in the other videos"
        remedy = "Export it at the speed at which it was filmed, with all its frames, or remove it."
    else:
        problem = "is mirrored: people move as in the other videos with left and right swapped"
        remedy = "Mirror it back, or remove it. Some telephones mirror videos of the front camera."
    which = f"{cameras[0].name} or {cameras[1].name}" if len(lenses) == 2 and not slower else name
    raise CalibrationError(
        f"the video of {which} {problem}", file=take.path, place=f"camera {name}", remedy=remedy
    )


def _skeleton(camera: Camera, seen: Detections, begin: float, speed: int = 1, mirrored: bool = False) -> LiftedSkeleton:
    """Of the person seen best, at `_RATE` from `begin` [s] on; of a video that plays `speed` times too slowly."""
    count = len(seen.points)
    times = np.arange(count) / seen.rate if seen.times is None else seen.times
    length = min((float(times[-1]) - begin) / speed, _SECONDS)
    wanted = begin + np.arange(0.0, max(length, 0.0) + 1e-9, 1.0 / _RATE) * speed
    at = np.minimum(np.searchsorted(times, wanted - 0.5 / seen.rate), count - 1)
    assert seen.lifted is not None
    points, confidence, lifted = (np.asarray(v[at], float) for v in (seen.points, seen.confidence, seen.lifted))
    record = Keypoints(camera.name, "MEDIAPIPE_33", MEDIAPIPE_33, _RATE, points, confidence, lifted=lifted)
    if mirrored:
        record = replace(
            record, points=points[:, :, MIRROR] * _FLIP[:2] + [camera.size[0] - 1.0, 0.0],
            confidence=confidence[:, :, MIRROR], lifted=lifted[:, :, MIRROR] * _FLIP,
        )  # fmt: skip
    return skeletons_of(camera, record)[0]


def _altered(camera: Camera, seen: Detections, begin: float) -> Iterator[tuple[int, LiftedSkeleton]]:
    """What a camera saw, mirrored back (0), and as if it had played so many times slower."""
    yield 0, _skeleton(camera, seen, begin, mirrored=True)
    for speed in _SLOWER:
        if len(seen.points) / seen.rate / speed * _RATE > 10:
            yield speed, _skeleton(camera, seen, begin, speed)


def _frames_in_common(a: LiftedSkeleton, b: LiftedSkeleton) -> int:
    """Largest number of frames with a person in both, over all possible clock offsets."""
    one, other = (np.pad(s.weight.any(axis=1).astype(int), round(_CLOCKS_S * _RATE)) for s in (a, b))
    most = round(_CLOCKS_S * _RATE)
    length = min(len(one), len(other)) - 2 * most
    return max(
        int(one[most : most + length] @ other[most + lag : most + lag + length]) for lag in range(-most, most + 1)
    )


def _cost(a: LiftedSkeleton, b: LiftedSkeleton) -> float:
    match = match_skeletons(a, b, round(_CLOCKS_S * _RATE))
    return 1.0 if match is None else min(match.cost, 1.0)
