"""People in a video: found, followed from picture to picture, each in a column of its own.

The detector looks at the whole picture at the start, every half second, and when somebody is lost; in between everybody
is followed by the region that the last landmarks tell.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.models import Models
from kinefit.images.detectors.person_detector import DetectedPerson
from kinefit.images.detectors.pose_model import SIZE
from kinefit.images.detectors.roi import Roi, Steady
from kinefit.observations import Detections

_THERE = 0.5  # least probability of a person in a region
_VISIBLE = 0.65  # least mean confidence of landmarks in the picture: 0.71 and more for people, 0.62 for a pile of boxes
_SURE, _CLEAR = 0.9, 0.75  # the same two of those who were searched for: small people 0.78, machines 0.71
_RATHER = 0.5  # probability from which on a pixel is the person's
_MOST = 0.5  # share of a mask
_HARDLY, _RIM, _GREY = 0.3, 7, 128  # probability and rim [px of the crop] of what is painted over, and the paint
_SAME_PERSON = 0.05  # two who are followed are one where their heads, or all of them, differ by less (in sides)
_BESIDE = 0.3  # middles of the hips of two people are further apart (in sides); of one who is followed twice, nearer
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

    And points (2, 21, 2) [px] and confidence (2, 21) of the left and the right hand, where they were looked for.
    """

    column: int
    points: NDArray
    confidence: NDArray
    runs: NDArray
    lifted: NDArray
    hands: tuple[NDArray, NDArray] | None = None


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
        pose = self.models.pose(_alone(roi.crop(image, SIZE), roi, track.shape, others), mask=mask)
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


def _alone(
    crop: NDArray[np.uint8], roi: Roi, own: tuple[Roi, NDArray] | None, others: Sequence[tuple[Roi, NDArray]]
) -> NDArray[np.uint8]:
    """A region with other people in it painted over, but for pixels that were the person's own.

    Those at the very same place are not: they may be the same person, followed twice.
    """
    beside = [
        shape for shape in others
        if np.linalg.norm(shape[0].centre - roi.centre) > _BESIDE * min(shape[0].side, roi.side)
    ]  # fmt: skip
    theirs = [cv2.dilate(_moved(shape, roi, _RATHER), np.ones((_RIM, _RIM), np.uint8)) for shape in beside]
    theirs = [mask for mask in theirs if mask.any()]
    if theirs:
        mine = _moved(own, roi, _RATHER) if own else np.zeros(crop.shape[:2], np.uint8)
        crop[(np.maximum.reduce(theirs) > 0) & (mine == 0)] = _GREY
    return crop


def _moved(shape: tuple[Roi, NDArray], roi: Roi, least: float) -> NDArray[np.uint8]:
    """Pixels of a region (SIZE, SIZE), 0 or 1, that a mask of another region holds for likely."""
    A_roi_image = cv2.invertAffineTransform(roi.A_image_crop(SIZE))
    A = A_roi_image @ np.vstack([shape[0].A_image_crop(SIZE), [0, 0, 1]])
    return (cv2.warpAffine(shape[1], A, (SIZE, SIZE)) > least).astype(np.uint8)


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
    moved = _moved((roi, mask), other_roi, _RATHER) > 0
    area = float((mask > _RATHER).sum()) * (roi.side / other_roi.side) ** 2
    return bool((moved & (other > _RATHER)).sum() > _MOST * area) or _is_same(new, known)


def _apart(a: _DetectionTrack, b: _DetectionTrack, points: slice) -> float:
    """Median distance of some landmarks, in sides of the smaller region."""
    assert a.points is not None and b.points is not None
    side = min(a.steady.roi.side, b.steady.roi.side)
    return float(np.median(np.linalg.norm(a.points[points] - b.points[points], axis=1))) / side


def mask_runs(mask: NDArray[np.float32], roi: Roi, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Run lengths, down the columns of a picture (height, width), of the pixels that are likely the person's."""
    height, width = shape
    nothing = np.array([width * height], np.uint32)
    rows, columns = (np.flatnonzero((mask > _RATHER).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return nothing
    box = np.array([[u, v] for u in (columns[0] - 1, columns[-1] + 1) for v in (rows[0] - 1, rows[-1] + 1)])
    corners = roi.to_image(box, SIZE)
    u0, v0 = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, [width, height])
    u1, v1 = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 1, 0, [width, height])
    if u0 >= u1 or v0 >= v1:
        return nothing
    A = roi.A_image_crop(SIZE)[::-1]  # each row of what is drawn is a column of the picture, between two empty pixels
    A[:, 2] -= v0 - 1, u0
    soft = cv2.warpAffine(mask, A, (int(v1 - v0) + 2, int(u1 - u0)), flags=cv2.INTER_LINEAR)
    inside = soft > _RATHER
    inside[:, [0, -1]] = False
    u, v = np.divmod(np.flatnonzero(inside[:, 1:] != inside[:, :-1]), v1 - v0 + 1)
    changes = (u + u0) * height + v + v0
    return np.diff(np.concatenate([[0], changes, [width * height]])).astype(np.uint32)


def cover(image: NDArray[np.uint8], shapes: Iterable[tuple[Roi, NDArray]]) -> NDArray[np.uint8]:
    """The picture with those who are known painted over, so that the detector sees whoever else is there.

    It was made for one person in the picture and overlooks those beside another.
    """
    covered = image.copy()
    for roi, mask in shapes:
        wide = cv2.dilate((mask > _HARDLY).astype(np.uint8), np.ones((_RIM, _RIM), np.uint8))
        size = (image.shape[1], image.shape[0])
        covered[cv2.warpAffine(wide, roi.A_image_crop(SIZE), size, flags=cv2.INTER_NEAREST) > 0] = _GREY
    return covered


def detect_people(
    images: Iterable[NDArray[np.uint8]], models: Models, *, camera: str, rate: float, people: int = 3,
    masks: bool = True, source: str = "",
    with_hands: Callable[[NDArray[np.uint8], list[PersonDetection]], list[PersonDetection]] | None = None,
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
    with_hands : callable, optional
        Adds their hands to the people in an image, such as a `HandFollower`.

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
        frames.append(with_hands(image, seen) if with_hands else seen)
    times = Counter(s.column for frame in frames for s in frame)
    least = min(max(_FEW, round(_BRIEF * rate)), len(frames) // 2)
    column = {c: k for k, c in enumerate(sorted(c for c in times if times[c] >= least))}
    points = np.full((len(frames), len(column), 33, 2), np.nan)
    confidence = np.zeros((len(frames), len(column), 33))
    counts = np.zeros((len(frames), len(column)), int)
    lifted = np.full((len(frames), len(column), 33, 3), np.nan)
    runs = [np.zeros(0, np.uint32)]
    hands = np.full((*counts.shape, 2, 21, 2), np.nan), np.zeros((*counts.shape, 2, 21))
    for f, frame in enumerate(frames):
        for s in sorted((s for s in frame if s.column in column), key=lambda s: s.column):
            at = f, column[s.column]
            points[at], confidence[at], counts[at], lifted[at] = s.points, s.confidence, len(s.runs), s.lifted
            runs.append(s.runs)
            if s.hands:
                hands[0][at], hands[1][at] = s.hands
    return Detections(
        camera, rate, size, points, confidence, np.concatenate(runs), np.concatenate([[0], np.cumsum(counts)]), source,
        lifted, *(hands if with_hands else ()),
    )
