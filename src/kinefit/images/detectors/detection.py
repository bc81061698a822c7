"""People in a video: found, followed from picture to picture, each in a column of its own.

The detector looks at the whole picture at the start, every half second, and when somebody is lost; in between everybody
is followed by the region that the last landmarks tell.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.masks import MIN_MASK, cover, mask_runs, moved_mask, without_others
from kinefit.images.detectors.models import Models
from kinefit.images.detectors.person_detector import DetectedPerson
from kinefit.images.detectors.pose_model import SIZE
from kinefit.images.detectors.roi import Roi, Steady
from kinefit.observations import Detections

_THERE = 0.5  # least probability of a person in a region
_VISIBLE = 0.65  # least mean confidence of landmarks in the picture: 0.71 and more for people, 0.62 for a pile of boxes
_SURE, _CLEAR = 0.9, 0.75  # the same two of those who were searched for: small people 0.78, machines 0.71
_MOST = 0.5  # share of a mask
_SAME_PERSON = 0.05  # two who are followed are one where their heads, or all of them, differ by less (in sides)
_NEAR = 0.3  # somebody comes back where the head is no further from where it was (in sides)
_FEW, _BRIEF = 3, 0.2  # [frames], [s]: who is seen for less in all is a deception of the networks
_SMALLEST, _LARGEST = 16, 8  # [px], [sides of the picture]: regions beyond show nothing that could be recognised
_HEAD = slice(0, 11)  # the landmarks of the face
_LOOK, _SOON = 0.5, 0.1  # [s] between looks at the whole picture; while somebody is missing
_MEMORY = 2.0  # [s] somebody who is lost may come back near the same place under the same number


@dataclass(frozen=True, eq=False)
class _DetectionTrack:
    """One person: where to look next, and what was seen last."""

    column: int
    steady: Steady
    points: NDArray | None = None  # (33, 2) [px]
    last: int = -1  # frame
    shape: tuple[Roi, NDArray] | None = None  # where they were last, and the mask in there


@dataclass(frozen=True, eq=False)
class PersonDetection:
    """One person in one picture: column, landmarks (33, 2) [px], confidence, runs of the mask, lifted (33, 3) [m].

    And points (2, 21, 2) [px] and confidence (2, 21) of the left and the right hand, points (478, 2) [px] and
    confidence (478,) of the face, where they were looked for.
    """

    column: int
    points: NDArray
    confidence: NDArray
    runs: NDArray
    lifted: NDArray
    hands: tuple[NDArray, NDArray] | None = None
    face: tuple[NDArray, NDArray] | None = None


_Adder = Callable[[NDArray[np.uint8], list[PersonDetection]], list[PersonDetection]]


@dataclass
class Follower:
    """Follows people through the pictures of one camera.

    Parameters
    ----------
    models : Models
    rate : float [Hz]
    people : int
        How many at most at a time.
    masks : bool
        Whether outlines are wanted.
    """

    models: Models
    rate: float
    people: int = 3
    masks: bool = True
    _tracks: list[_DetectionTrack] = field(default_factory=list)
    _lost: list[_DetectionTrack] = field(default_factory=list)
    _frame: int = -1
    _columns: int = 0

    def update(self, image: NDArray[np.uint8]) -> list[PersonDetection]:
        """Everybody in the next picture (H, W, 3) RGB."""
        self._frame += 1
        self._lost = [t for t in self._lost if self._frame - t.last <= _MEMORY * self.rate]
        crowd = len(self._tracks) > 1 or (self.people > 1 and self._is_due)  # somebody is to be painted over
        seen = self._follow(image, self.masks or crowd)
        due = self._is_due
        look = due or len(seen) < len(self._tracks) or not seen
        self._tracks = [track for track, _ in seen]
        if look and len(seen) < self.people:
            seen += self._find(image, thorough=due)
            self._tracks = [track for track, _ in seen]
        return [sighting for _, sighting in seen]

    @property
    def _is_due(self) -> bool:
        """Whether the whole picture is looked at whatever is seen."""
        return self._frame % max(round((_SOON if self._lost else _LOOK) * self.rate), 1) == 0

    def _follow(self, image: NDArray[np.uint8], mask: bool) -> list[tuple[_DetectionTrack, PersonDetection]]:
        """Those who are still there; two that have become one are the one that moved less."""
        seen: list[tuple[_DetectionTrack, PersonDetection, float]] = []
        for track in self._tracks:
            others = [t.shape for t in self._tracks if t is not track and t.shape]
            found = self._look_at(image, track, others=others, mask=mask)
            if found is None:
                self._lost.append(track)
                continue
            assert track.points is not None
            moved = float(np.median(np.linalg.norm(found[1].points - track.points, axis=1)))
            twin = next((k for k, s in enumerate(seen) if _is_same(s[0], found[0])), None)
            if twin is None:
                seen.append((*found, moved))
                continue
            if moved < seen[twin][2]:
                self._lost.append(next(t for t in self._tracks if t.column == seen[twin][0].column))
                seen[twin] = (*found, moved)
            else:
                self._lost.append(track)
        return [s[:2] for s in seen]

    def _find(self, image: NDArray[np.uint8], *, thorough: bool) -> list[tuple[_DetectionTrack, PersonDetection]]:
        """Those whom nobody follows yet, the surest first, as many as there is room for."""
        found: list[tuple[_DetectionTrack, PersonDetection]] = []
        covered = image
        while len(self._tracks) + len(found) < self.people:
            known = [*self._tracks, *(t for t, _ in found)]
            covered = cover(covered, [t.shape for t in (known[-1:] if found else known) if t.shape])
            new = self._first(image, self.models.find_people(covered), known)
            if new is None and thorough and not known:
                new = self._first(image, self.models.search(covered), known, searched=True)
            if new is None:
                break
            column = self._column_of(new[0])
            found.append((replace(new[0], column=column), replace(new[1], column=column)))
        return found

    def _first(
        self,
        image: NDArray[np.uint8],
        people: list[DetectedPerson],
        known: list[_DetectionTrack],
        *,
        searched: bool = False,
    ) -> tuple[_DetectionTrack, PersonDetection] | None:
        """The first who is a person at a second look too, and nobody known; more is asked of who was searched for."""
        score, clear = (_SURE, _CLEAR) if searched else (_THERE, _VISIBLE)
        for person in people:
            once = self._look_at(image, _DetectionTrack(-1, Steady.at(person.points)), score, mask=False)
            new = once and self._look_at(image, once[0], score, mask=self.masks or self.people > 1)
            if new and _clearness(new[1], image) >= clear and not any(_is_part(new[0], t) for t in known):
                return new
        return None

    def _column_of(self, new: _DetectionTrack) -> int:
        """That of whoever was lost about here not long ago; else a column of its own."""
        back = min(self._lost, key=lambda t: _apart(t, new, _HEAD), default=None)
        if back is not None and _apart(back, new, _HEAD) < _NEAR:
            self._lost.remove(back)
            return back.column
        self._columns += 1
        return self._columns - 1

    def _look_at(
        self, image: NDArray[np.uint8], track: _DetectionTrack, score: float = _THERE, *,
        mask: bool, others: Sequence[tuple[Roi, NDArray]] = (),
    ) -> tuple[_DetectionTrack, PersonDetection] | None:  # fmt: skip
        """Landmarks of a person in the region where they are expected; None where there is nobody.

        Others in the region, where they were last, are painted over: the network draws a person's limbs towards them.
        """
        roi = track.steady.roi
        if not _SMALLEST < roi.side < _LARGEST * max(image.shape[:2]):
            return None
        pose = self.models.pose(without_others(roi.crop(image, SIZE), roi, track.shape, others), mask=mask)
        if pose.score < score:
            return None
        points = roi.to_image(pose.points, SIZE)
        ends = roi.to_image(np.stack([pose.middle, pose.rim]), SIZE)
        steady = track.steady.follow(ends) if track.points is not None else Steady.at(ends)
        runs = np.zeros(0, np.uint32)
        if self.masks and pose.mask is not None:
            runs = mask_runs(pose.mask, roi, image.shape[:2])
        sighting = PersonDetection(
            track.column, points, pose.visibility * pose.presence, runs, roi.to_upright(pose.lifted)
        )
        shape = None if pose.mask is None else (roi, pose.mask)
        return replace(track, steady=steady, points=points, last=self._frame, shape=shape), sighting


def _clearness(seen: PersonDetection, image: NDArray) -> float:
    """Mean confidence of the landmarks that lie in the picture."""
    inside = ((seen.points >= 0) & (seen.points < image.shape[1::-1])).all(axis=1)
    return float(seen.confidence[inside].mean()) if inside.any() else 0.0


def _is_same(a: _DetectionTrack, b: _DetectionTrack) -> bool:
    return min(_apart(a, b, _HEAD), _apart(a, b, slice(None))) < _SAME_PERSON


def _is_part(new: _DetectionTrack, known: _DetectionTrack) -> bool:
    """Whether most of what looks like another person is somebody who is known."""
    assert new.shape and known.shape
    (roi, mask), (other_roi, other) = new.shape, known.shape
    moved = moved_mask((roi, mask), other_roi) > 0
    area = float((mask > MIN_MASK).sum()) * (roi.side / other_roi.side) ** 2
    return bool((moved & (other > MIN_MASK)).sum() > _MOST * area) or _is_same(new, known)


def _apart(a: _DetectionTrack, b: _DetectionTrack, points: slice) -> float:
    """Median distance of some landmarks, in sides of the smaller region."""
    assert a.points is not None and b.points is not None
    side = min(a.steady.roi.side, b.steady.roi.side)
    return float(np.median(np.linalg.norm(a.points[points] - b.points[points], axis=1))) / side


def detect_people(
    images: Iterable[NDArray[np.uint8]], models: Models, *, camera: str, rate: float, people: int = 3,
    masks: bool = True, source: str = "",
    with_hands: _Adder | None = None, with_faces: _Adder | None = None,
) -> Detections:
    """Keypoints and masks of the people in a video.

    Parameters
    ----------
    images : (H, W, 3) uint8 RGB each, upright, in order.
    models : Models
    camera : str
    rate : float [Hz]
    people : int
        How many are followed at most at a time.
    masks : bool
        Whether outlines are wanted.
    with_hands, with_faces : callable, optional
        Adds hands, or faces, to the people in an image: a `HandFollower`, a `FaceFinder`.

    Returns
    -------
    Detections
        One column for each person; who leaves and comes back later may get another, who is seen for less than a fifth
        of a second has none. No column where nobody is seen.
    """
    follower = Follower(models, rate, people, masks)
    frames: list[list[PersonDetection]] = []
    size = (0, 0)
    for image in images:
        size = (image.shape[1], image.shape[0])
        seen = follower.update(image)
        for add in filter(None, (with_hands, with_faces)):
            seen = add(image, seen)
        frames.append(seen)
    times = Counter(s.column for frame in frames for s in frame)
    least = min(max(_FEW, round(_BRIEF * rate)), len(frames) // 2)
    column = {c: k for k, c in enumerate(sorted(c for c in times if times[c] >= least))}
    points = np.full((len(frames), len(column), 33, 2), np.nan)
    confidence = np.zeros((len(frames), len(column), 33))
    counts = np.zeros((len(frames), len(column)), int)
    lifted = np.full((len(frames), len(column), 33, 3), np.nan)
    runs = [np.zeros(0, np.uint32)]
    for f, frame in enumerate(frames):
        for s in sorted((s for s in frame if s.column in column), key=lambda s: s.column):
            at = f, column[s.column]
            points[at], confidence[at], counts[at], lifted[at] = s.points, s.confidence, len(s.runs), s.lifted
            runs.append(s.runs)
    hands, hand_confidence = _stacked(frames, column, "hands", (2, 21)) if with_hands else (None, None)
    face, face_confidence = _stacked(frames, column, "face", (478,)) if with_faces else (None, None)
    return Detections(
        camera, rate, size, points, confidence, np.concatenate(runs), np.concatenate([[0], np.cumsum(counts)]), source,
        lifted, hands, hand_confidence, None, face, face_confidence,
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
