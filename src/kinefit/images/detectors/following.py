"""Track the people from image to image of a video; each has a column of its own.

The detector searches the whole image at the start, every half second, and when a person is lost. In between, each
person is tracked: the last landmarks give the region of the next image in which the network looks for landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import DetectedPerson, Models
from kinefit.images.detectors.networks import TopDownModels
from kinefit.images.detectors.roi import (
    MIN_MASK,
    Roi,
    Steady,
    cover,
    extent_mask,
    mask_runs,
    moved_mask,
    without_others,
)

_MAX_MASK_OVERLAP = 0.5  # share of a new person's mask that a tracked person may cover
_MAX_DUPLICATE_DISTANCE = 0.05  # [sides of the region] median over the head, or all landmarks, of one person
_MAX_RETURN_DISTANCE = 0.3  # [sides of the region] of the head from where the person was lost
_MIN_ROI_PX = 16  # smaller regions show too little to recognise a person
_MAX_ROI_SIDES = 8  # of the image; larger regions show too little as well
_SEARCH_INTERVAL = 0.5  # [s] between searches of the whole image
_LOST_INTERVAL = 0.1  # [s] the same, while a person is lost
_MAX_TIME_LOST = 2.0  # [s] for which a lost person keeps the column


@dataclass(frozen=True, eq=False)
class _DetectionTrack:
    """Track of one person: the next region, and the last detection."""

    column: int
    steady: Steady
    points: NDArray | None = None  # (K, 2) [px]
    last: int = -1  # frame
    shape: tuple[Roi, NDArray] | None = None  # last region, and the mask in it


@dataclass(frozen=True, eq=False)
class PersonDetection:
    """One person in one image: column, landmarks (K, 2) [px], confidence (K,), runs of the mask, lifted (K, 3) [m].

    lifted: None where the network gives none. hands: points (2, 21, 2) [px] and confidence (2, 21) of the left and the
    right hand; face: points (478, 2) [px] and confidence (478,); None unless they were looked for.
    """

    column: int
    points: NDArray
    confidence: NDArray
    runs: NDArray
    lifted: NDArray | None
    hands: tuple[NDArray, NDArray] | None = None
    face: tuple[NDArray, NDArray] | None = None


@dataclass
class Follower:
    """Detects and tracks people in the images of one camera.

    Parameters
    ----------
    models : Models or TopDownModels
    rate : float [Hz]
    people : int
        Largest number of people at a time.
    masks : bool
        Whether masks are computed, by networks that give them.
    """

    models: Models | TopDownModels
    rate: float
    people: int = 3
    masks: bool = True
    _tracks: list[_DetectionTrack] = field(default_factory=list)
    _lost: list[_DetectionTrack] = field(default_factory=list)
    _frame: int = -1
    _before: int = -1
    _columns: int = 0

    def copy(self) -> Follower:
        """A follower that goes on from here by itself."""
        return replace(self, _tracks=list(self._tracks), _lost=list(self._lost))

    @property
    def sides(self) -> dict[int, float]:
        """{column: side [px] of the region} of the people who were seen in the last image."""
        return {t.column: t.steady.roi.side for t in self._tracks}

    def between(self, before: Follower, image: NDArray[np.uint8], share: float) -> list[PersonDetection]:
        """Detect those people in an image who were seen before it, as `before` knows them, and after it, as this does.

        share : 0..1 of the way from the image before to the one after.
        """
        earlier, found = {t.column: t.steady.value for t in before._tracks}, []
        for track in self._tracks:
            ends = (1.0 - share) * earlier[track.column] + share * track.steady.value
            others = [t.shape for t in self._tracks if t is not track and t.shape]
            mask = self.masks or len(self._tracks) > 1
            there = replace(track, steady=Steady.at(ends), last=self._frame)
            found.append(self._look_at(image, there, others=others, mask=mask))
        return [one[1] for one in found if one is not None]

    def update(self, image: NDArray[np.uint8], frames: int = 1) -> list[PersonDetection]:
        """Detect the people in an image (H, W, 3) uint8 RGB, so many frames after the last one."""
        self._before, self._frame = self._frame, self._frame + frames
        self._lost = [t for t in self._lost if self._frame - t.last <= _MAX_TIME_LOST * self.rate]
        crowd = len(self._tracks) > 1 or (self.people > 1 and self._is_due)  # their masks are needed
        detected = self._follow(image, self.masks or crowd)
        due = self._is_due
        look = due or len(detected) < len(self._tracks) or not detected
        self._tracks = [track for track, _ in detected]
        if look and len(detected) < self.people:
            detected += self._find(image, thorough=due)
            self._tracks = [track for track, _ in detected]
        return [sighting for _, sighting in detected]

    @property
    def _is_due(self) -> bool:
        """Whether a search of the whole image is due."""
        every = max(round((_LOST_INTERVAL if self._lost else _SEARCH_INTERVAL) * self.rate), 1)
        return self._frame // every > self._before // every

    def _follow(self, image: NDArray[np.uint8], mask: bool) -> list[tuple[_DetectionTrack, PersonDetection]]:
        """Update the tracks. Of two tracks of the same person, the one that moved less is kept."""
        detected: list[tuple[_DetectionTrack, PersonDetection, float]] = []
        for track in self._tracks:
            others = [t.shape for t in self._tracks if t is not track and t.shape]
            found = self._look_at(image, track, others=others, mask=mask)
            if found is None:
                self._lost.append(track)
                continue
            assert track.points is not None
            moved = float(np.median(np.linalg.norm(found[1].points - track.points, axis=1)))
            duplicate = next((k for k, s in enumerate(detected) if self._is_same(s[0], found[0])), None)
            if duplicate is None:
                detected.append((*found, moved))
                continue
            if moved < detected[duplicate][2]:
                self._lost.append(next(t for t in self._tracks if t.column == detected[duplicate][0].column))
                detected[duplicate] = (*found, moved)
            else:
                self._lost.append(track)
        return [s[:2] for s in detected]

    def _find(self, image: NDArray[np.uint8], *, thorough: bool) -> list[tuple[_DetectionTrack, PersonDetection]]:
        """Detect people without a track, in order of decreasing score, up to the largest number."""
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
        """The first new person that the landmark network confirms twice. The tiled search needs higher scores."""
        layout = self.models.layout
        score, visibility = layout.search_limits if searched else layout.limits
        for person in people:
            first = self._look_at(image, _DetectionTrack(-1, Steady.at(person.points)), score, mask=False)
            new = first and self._look_at(image, first[0], score, mask=self.masks or self.people > 1)
            if new and _mean_visibility(new[1], image) >= visibility:
                if not any(self._is_tracked(new[0], t) for t in known):
                    return new
        return None

    def _column_of(self, new: _DetectionTrack) -> int:
        """Column of the nearest lost person, if close enough; else a new column."""
        head = self.models.layout.head
        lost = min(self._lost, key=lambda t: _distance(t, new, head), default=None)
        if lost is not None and _distance(lost, new, head) < _MAX_RETURN_DISTANCE:
            self._lost.remove(lost)
            return lost.column
        self._columns += 1
        return self._columns - 1

    def _look_at(
        self, image: NDArray[np.uint8], track: _DetectionTrack, score: float | None = None, *, mask: bool,
        others: Sequence[tuple[Roi, NDArray]] = (),
    ) -> tuple[_DetectionTrack, PersonDetection] | None:  # fmt: skip
        """Detect a person's landmarks in the predicted region; None where there is no person.

        The last masks of other people in the region are painted over: they attract the person's landmarks. Where the
        network gives no masks, the extent of the points stands for one, which only finds other people and duplicates.
        """
        frames = 1 if track.points is None else max(self._frame - track.last, 1)
        roi, layout = track.steady.ahead(frames - 1).roi, self.models.layout
        if not _MIN_ROI_PX < roi.side < _MAX_ROI_SIDES * max(image.shape[:2]):
            return None
        if layout.has_masks:
            crop = without_others(roi.crop(image, layout.size), roi, track.shape, others)
        else:
            crop = roi.crop(image, layout.size, cv2.BORDER_CONSTANT)
        pose = self.models.pose(crop, mask=mask)
        if pose.score < (layout.limits[0] if score is None else score):
            return None
        points = roi.to_image(pose.points, layout.size)
        ends = roi.to_image(np.stack([pose.middle, pose.rim]), layout.size)
        steady = track.steady.over(ends, frames) if track.points is not None else Steady.at(ends)
        runs = np.zeros(0, np.uint32)
        if self.masks and pose.mask is not None:
            runs = mask_runs(pose.mask, roi, image.shape[:2])
        confidence = pose.visibility * pose.presence
        lifted = None if pose.lifted is None else roi.to_upright(pose.lifted)
        extent = pose.mask
        if not layout.has_masks:
            extent = extent_mask(pose.points[confidence >= layout.limits[1]], layout.size)
        shape = None if extent is None else (roi, extent)
        sighting = PersonDetection(track.column, points, confidence, runs, lifted)
        return replace(track, steady=steady, points=points, last=self._frame, shape=shape), sighting

    def _is_same(self, a: _DetectionTrack, b: _DetectionTrack) -> bool:
        head, everything = self.models.layout.head, slice(None)
        return min(_distance(a, b, head), _distance(a, b, everything)) < _MAX_DUPLICATE_DISTANCE

    def _is_tracked(self, new: _DetectionTrack, known: _DetectionTrack) -> bool:
        """Whether a new detection is a tracked person: most of its mask lies in theirs, or the landmarks agree."""
        assert new.shape and known.shape
        (roi, mask), (other_roi, other) = new.shape, known.shape
        moved = moved_mask((roi, mask), other_roi) > 0
        area = float((mask > MIN_MASK).sum()) * (roi.side / other_roi.side) ** 2
        return bool((moved & (other > MIN_MASK)).sum() > _MAX_MASK_OVERLAP * area) or self._is_same(new, known)


def _mean_visibility(detected: PersonDetection, image: NDArray) -> float:
    """Mean confidence of the landmarks inside the image."""
    inside = ((detected.points >= 0) & (detected.points < image.shape[1::-1])).all(axis=1)
    return float(detected.confidence[inside].mean()) if inside.any() else 0.0


def _distance(a: _DetectionTrack, b: _DetectionTrack, points: slice | list[int]) -> float:
    """Median distance of selected landmarks, in sides of the smaller region."""
    assert a.points is not None and b.points is not None
    side = min(a.steady.roi.side, b.steady.roi.side)
    return float(np.median(np.linalg.norm(a.points[points] - b.points[points], axis=1))) / side
