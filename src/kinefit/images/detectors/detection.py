"""Detect and track the people in a video: keypoints and masks of each in a column of its own."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.following import Follower, PersonDetection
from kinefit.images.detectors.looking import Adder, SparseLooks
from kinefit.images.detectors.networks import TopDownModels
from kinefit.observations import Detections

_MIN_FRAMES = 3  # that a person must be detected in; fewer are a false positive
_MIN_DURATION = 0.2  # [s] the same


def detect_people(
    images: Iterable[NDArray[np.uint8]], models: Models | TopDownModels, *, camera: str, rate: float, people: int = 3,
    masks: bool = True, adders: Mapping[Literal["hands", "face"], Adder] = MappingProxyType({}),
    looks: range | None = None,
) -> Detections:  # fmt: skip
    """Detect and track people in a video: keypoints and masks.

    Parameters
    ----------
    images : (H, W, 3) uint8 RGB each, upright, in order.
    models : Models or TopDownModels
    camera : str
    rate : float [Hz]
    people : int
        Largest number of people at a time.
    masks : bool
        Whether masks are computed, by networks that give them.
    adders : {"hands": `HandFollower`, "face": `FaceFinder`}
        Callables that add hands, or faces, to the people in an image; in this order.
    looks : range, optional
        Numbers of the images that are looked at for certain, others only where the motion or the people ask for it.
        Default: all are looked at.

    Returns
    -------
    Detections
        One column for each person. A person who returns later than two seconds after leaving gets a new column.
        Detections of less than 0.2 s in total are dropped as false positives.
    """
    size = (0, 0)

    def sized() -> Iterator[NDArray[np.uint8]]:
        nonlocal size
        for image in images:
            size = (image.shape[1], image.shape[0])
            yield image

    def add(image: NDArray[np.uint8], detected: list[PersonDetection]) -> list[PersonDetection]:
        for adder in adders.values():
            detected = adder(image, detected)
        return detected

    follower, every = Follower(models, rate, people, masks), range(sys.maxsize)
    seen = list(SparseLooks(follower, every if looks is None else looks, add).people(sized()))
    looked = np.array([frame is not None for frame in seen], bool)
    frames = [frame or [] for frame in seen]
    times: Counter[int] = Counter()  # images, those before a look that were skipped included
    for look, since in zip(np.flatnonzero(looked), np.diff(np.flatnonzero(looked), prepend=-1)):
        times.update({s.column: int(since) for s in frames[look]})
    least = min(max(_MIN_FRAMES, round(_MIN_DURATION * rate)), len(frames) // 2)
    column = {c: k for k, c in enumerate(sorted(c for c in times if times[c] >= least))}
    layout = models.layout
    confidence = np.zeros((len(frames), len(column), len(layout.names)))
    points, lifted = (np.full((*confidence.shape, axes), np.nan) for axes in (2, 3))
    counts = np.zeros((len(frames), len(column)), int)
    runs = [np.zeros(0, np.uint32)]
    for f, frame in enumerate(frames):
        for s in sorted((s for s in frame if s.column in column), key=lambda s: s.column):
            at = f, column[s.column]
            points[at], confidence[at], counts[at] = s.points, s.confidence, len(s.runs)
            if s.lifted is not None:
                lifted[at] = s.lifted
            runs.append(s.runs)
    hands, hand_confidence = _stacked(frames, column, "hands", (2, 21)) if "hands" in adders else (None, None)
    face, face_confidence = _stacked(frames, column, "face", (478,)) if "face" in adders else (None, None)
    return Detections(
        camera, rate, size, points, confidence, np.concatenate(runs), np.concatenate([[0], np.cumsum(counts)]), "",
        lifted if layout.has_masks else None, hands, hand_confidence, None, face, face_confidence,
        layout.keypoint_set, layout.names, looked=None if looked.all() else looked,
    )


def _stacked(
    frames: list[list[PersonDetection]], column: dict[int, int], part: str, shape: tuple[int, ...]
) -> tuple[NDArray, NDArray]:
    """Points (F, P, *shape, 2) [px] and confidence (F, P, *shape) of hands or faces of those who have a column."""
    points = np.full((len(frames), len(column), *shape, 2), np.nan)
    confidence = np.zeros(points.shape[:-1])
    for f, frame in enumerate(frames):
        for s in frame:
            if s.column in column and (found := getattr(s, part)):
                points[f, column[s.column]], confidence[f, column[s.column]] = found
    return points, confidence
