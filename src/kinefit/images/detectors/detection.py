"""Detect and track the people in a video: keypoints and masks of each in a column of its own.

Most images may be skipped (`SparseLooks`): some are looked at, and those between where the motion or the people ask for
it. Detectors err alike in neighbouring images, so that every one of them tells little more than every fourth at 60 Hz.
The fit knows how a body moves on between two looks; points are not interpolated here.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import Models
from kinefit.images.detectors.following import Follower, PersonDetection
from kinefit.images.detectors.networks import TopDownModels
from kinefit.observations import Detections

LOOK_RATE = 15.0
"""[Hz] of the images that are looked at for certain, about."""

_MAX_MISS = 0.1  # [sides of the region] off where three looks lead: noise alone is 0.02 to 0.05, 0.09 at most
_MAX_MIDDLE_MISS = 0.05  # [sides of the region] of the middle image off a parabola; noise alone is 0.01 to 0.02
_FAST_POINTS = 3  # landmarks that are that far off: a hand has four, a foot three
_MIN_CONFIDENCE = 0.5  # of these, in all looks

Adder = Callable[[NDArray[np.uint8], list[PersonDetection]], list[PersonDetection]]


@dataclass
class SparseLooks:
    """The people in the images of one camera, most of which are not looked at.

    Parameters
    ----------
    follower : Follower
    frames : range
        Images that are looked at for certain; and so are the first and the last one.
    add : adds to the people in an image, such as hands.
    """

    follower: Follower
    frames: range
    add: Adder
    _history: list[dict[int, PersonDetection]] = field(default_factory=list)  # of the last looks, a step apart

    def people(self, images: Iterable[NDArray[np.uint8]]) -> Iterator[list[PersonDetection] | None]:
        """The people in every image (H, W, 3) RGB; None for one that was not looked at."""
        gap: list[NDArray[np.uint8]] = []
        for number, image in enumerate(images):
            gap.append(image)
            if number == 0 or number in self.frames:
                yield from self._after(gap)
                gap = []
        if gap:
            yield from self._after(gap)

    def _after(self, gap: Sequence[NDArray[np.uint8]]) -> list[list[PersonDetection] | None]:
        """Look at the last image of a gap after the last look, and at others if that one asks for it."""
        before, count = self.follower.copy(), len(gap)
        people = self._update(gap[-1], count)
        last, now = (self._history or [{}])[-1], {p.column: p for p in people}
        if count > 1 and last.keys() != now.keys():  # somebody came, left or was lost
            self.follower, self._history = before, []
            each = [self._update(image) for image in gap]
            self._history = [{p.column: p for p in each[-1]}]
            return list(each)
        out: list[list[PersonDetection] | None] = [None] * (count - 1) + [people]
        if count == self.frames.step:
            nodes = [*self._history[-3:], now]
            if count > 1 and len(nodes) == 4 and self._miss(nodes, (1.0, -3.0, 3.0), now) > _MAX_MISS:
                middle = count // 2
                out[middle - 1] = seen = self._between(before, gap[middle - 1], middle / count)
                t = middle / count
                parabola = 0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)
                found = {p.column: p for p in seen}
                deep = self._miss([*nodes[1:], found], parabola, found) > _MAX_MIDDLE_MISS
                for k in range(count - 1) if deep else ():
                    if out[k] is None:
                        out[k] = self._between(before, gap[k], (k + 1) / count)
            self._history = nodes[-3:]
        else:
            self._history = [now]
        return out

    def _update(self, image: NDArray[np.uint8], frames: int = 1) -> list[PersonDetection]:
        return self.add(image, self.follower.update(image, frames))

    def _between(self, before: Follower, image: NDArray[np.uint8], share: float) -> list[PersonDetection]:
        return self.add(image, self.follower.between(before, image, share))

    def _miss(
        self, looks: Sequence[dict[int, PersonDetection]], weights: Sequence[float], of: dict[int, PersonDetection]
    ) -> float:
        """How far [sides of the region] the last of four looks is from a weighted sum of the three before.

        Of the person and the landmark, all but the two farthest, that it is largest for.
        """
        worst, sides = 0.0, self.follower.sides
        for column, person in of.items():
            known = [look[column] for look in looks[:3] if column in look]
            if len(known) < 3 or column not in sides:
                continue
            off = person.points - sum(w * p.points for w, p in zip(weights, known))
            sure = np.min([p.confidence for p in (*known, person)], axis=0) > _MIN_CONFIDENCE
            far = np.sort(np.linalg.norm(off, axis=1) * sure)[-_FAST_POINTS]
            worst = max(worst, float(far) / sides[column])
        return worst


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
