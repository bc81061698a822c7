"""Detect and track hands in the images of one camera: 21 landmarks each, from people's wrists or from palms alone.

Source: Zhang et al., MediaPipe Hands: on-device real-time hand tracking, 2020 (palms, then landmarks in a region that
is rotated with the hand, then the region of the next image from the landmarks).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import BoxDetector
from kinefit.images.detectors.detection import PersonDetection
from kinefit.images.detectors.models import interpreter
from kinefit.images.detectors.roi import Roi, is_inside

PALMS, HANDS = "palm_detection_full.tflite", "hand_landmark_full.tflite"
HANDS_ONLY_COLUMN = -1
"""Column of hands of a person whose body is not in view."""

_PALM_CELLS = ((8, 2), (16, 6))  # stride [px] of the feature maps, anchors in a cell
_INPUT_PX = 224  # side of the landmark network's image
_MIN_PALM_SCORE = 0.5
_MIN_PRESENCE = 0.5
_MIN_ROI_PX = 12.0  # side: a hand smaller than half of it shows no fingers
_PALM_ROI_SIDES = 2.6  # side of a region, in sides of the palm's box
_PALM_ROI_SHIFT = 0.5  # of the region towards the fingers, in sides of the palm's box
_PALM_LENGTHS = 4.0  # side of a region from a person's pose, in distances from wrist to knuckles
_PALM_CENTRE = 1.2  # of that region from the wrist, in the same unit
_MIN_FOREARMS = 0.9  # side of that region in lengths of the forearm, for hands that point to the camera
_LANDMARK_EXTENTS = 1.6  # side of a region, in the extent of the landmarks
_MAX_WRIST_DISTANCE = 0.5  # between the pose's wrist and the hand's, in sides of the region
_MAX_DUPLICATE_DISTANCE = 0.25  # median over the landmarks of one hand detected twice, in sides of the region
_ELBOWS, _WRISTS, _PINKIES, _INDEXES = (13, 14), (15, 16), (17, 18), (19, 20)  # of MEDIAPIPE_33, left and right
_WRIST, _MIDDLE = 0, 9  # wrist and knuckle of the middle finger, of MEDIAPIPE_HAND_21


@dataclass(frozen=True, eq=False)
class HandLandmarks:
    """Landmarks (21, 2) [px] of a hand, probabilities 0..1 of a hand and of a left hand, and the next region."""

    points: NDArray
    presence: float
    left: float
    roi: Roi


class HandModels:
    """Networks that detect palms in an image and a hand's landmarks in a region. Not thread-safe.

    Parameters
    ----------
    folder : path
        Of the networks' files.
    threads : int
        For each network.

    Raises
    ------
    ObservationError
        The extra `detect` is not installed.
    FileError
        A file is missing or not a network.
    """

    def __init__(self, folder: str | PathLike[str], threads: int = 1) -> None:
        self._palms = BoxDetector(interpreter(Path(folder) / PALMS, threads), _PALM_CELLS, low=0.0)
        self._hand = interpreter(Path(folder) / HANDS, threads)
        outputs = {o["name"]: o["index"] for o in self._hand.get_output_details()}
        self._outputs = [outputs[name] for name in ("Identity", "Identity_1", "Identity_2")]
        self._input = self._hand.get_input_details()[0]["index"]

    def find_palms(self, image: NDArray[np.uint8]) -> list[Roi]:
        """Detect palms in an RGB image (H, W, 3): regions of the hands, in order of decreasing score."""
        found = []
        for palm in self._palms(image, _MIN_PALM_SCORE):
            du, dv = palm.points[2] - palm.points[0]  # from the wrist to the knuckle of the middle finger
            turn, side = float(np.arctan2(du, -dv)), float(np.ptp(palm.corners, axis=0).max())
            centre = palm.corners.mean(axis=0) + _PALM_ROI_SHIFT * side * np.array([np.sin(turn), -np.cos(turn)])
            found.append(Roi(centre, _PALM_ROI_SIDES * side, turn))
        return found

    def landmarks(self, image: NDArray[np.uint8], roi: Roi) -> HandLandmarks:
        """Landmarks of the hand in a region of an RGB image (H, W, 3)."""
        crop = roi.crop(image, _INPUT_PX) * np.float32(1 / 255)
        self._hand.set_tensor(self._input, crop[None])
        self._hand.invoke()
        points, presence, right = (self._hand.get_tensor(index)[0] for index in self._outputs)
        uv = roi.to_image(points.reshape(21, 3)[:, :2].astype(float), _INPUT_PX)
        return HandLandmarks(uv, float(presence[0]), 1 - float(right[0]), around_hand(uv))


def around_hand(points: NDArray) -> Roi:
    """Region around a hand's landmarks (21, 2) [px], rotated so that the fingers point upwards."""
    return Roi.around_points(points, points[_MIDDLE] - points[_WRIST], _LANDMARK_EXTENTS)


def around_wrist(points: NDArray, side: int) -> Roi:
    """Region of a person's left (0) or right (1) hand from the landmarks (33, 2) [px] of the body."""
    wrist, elbow = points[_WRISTS[side]], points[_ELBOWS[side]]
    palm, forearm = (points[_PINKIES[side]] + points[_INDEXES[side]]) / 2 - wrist, wrist - elbow
    du, dv = palm if np.linalg.norm(palm) > 0.15 * np.linalg.norm(forearm) else forearm
    width = max(_PALM_LENGTHS * np.linalg.norm(palm), _MIN_FOREARMS * np.linalg.norm(forearm))
    return Roi(wrist + _PALM_CENTRE * palm, float(width), float(np.arctan2(du, -dv)))


@dataclass
class HandFollower:
    """Tracks the hands of people in the images of one camera: call it with an image and the people in it.

    The side of a hand is that of the body's wrist. The network's probability of that side multiplies the confidence.
    """

    models: HandModels
    _before: dict[tuple[int, int], HandLandmarks] = field(default_factory=dict)

    def __call__(self, image: NDArray[np.uint8], people: Sequence[PersonDetection]) -> list[PersonDetection]:
        """Add hands to the people in an image (H, W, 3).

        If no person has hands, one person more in column `HANDS_ONLY_COLUMN` holds the hands that the palm detector
        finds, if any.
        """
        now: dict[tuple[int, int], HandLandmarks] = {}
        for person in people:
            for side in (0, 1):
                found = self._of_wrist(image, person, side)
                other = now.get((person.column, 0))
                if found and other and side and _is_same(found, other):
                    if found.left < 0.5:  # both wrists lead to the right hand
                        del now[person.column, 0]
                    else:
                        continue
                if found:
                    now[person.column, side] = found
        alone = self._alone(image) if not now else {}
        now |= alone
        self._before = now
        people = [*people, *([_unseen_person()] if alone else [])]
        return [replace(person, hands=hands_of(now, person.column, image.shape)) for person in people]

    def _of_wrist(self, image: NDArray[np.uint8], person: PersonDetection, side: int) -> HandLandmarks | None:
        """Detect a hand near a person's wrist: in the region of the last image, else in that of the body's wrist."""
        before, wrist = self._before.get((person.column, side)), person.points[_WRISTS[side]]
        pose = around_wrist(person.points, side)
        for roi in (before.roi, pose) if before else (pose,):
            found = self._look(image, roi, twice=roi is pose)
            if found and np.linalg.norm(found.points[_WRIST] - wrist) < _MAX_WRIST_DISTANCE * max(pose.side, roi.side):
                return found
        return None

    def _alone(self, image: NDArray[np.uint8]) -> dict[tuple[int, int], HandLandmarks]:
        """Track or detect at most one left and one right hand, by their palms."""
        now: dict[tuple[int, int], HandLandmarks] = {}
        for before in [hand for (column, _), hand in self._before.items() if column == HANDS_ONLY_COLUMN]:
            if found := self._look(image, before.roi):
                now.setdefault((HANDS_ONLY_COLUMN, int(found.left < 0.5)), found)
        for roi in self.models.find_palms(image) if not now else ():
            found = self._look(image, roi, twice=True)
            if found and not any(_is_same(found, hand) for hand in now.values()):
                now.setdefault((HANDS_ONLY_COLUMN, int(found.left < 0.5)), found)
        return now

    def _look(self, image: NDArray[np.uint8], roi: Roi, *, twice: bool = False) -> HandLandmarks | None:
        """Detect the hand in a region, None if there is none; `twice`: once more in the region of its landmarks."""
        if not _MIN_ROI_PX < roi.side < 4 * max(image.shape[:2]):
            return None
        found = self.models.landmarks(image, roi)
        if found.presence < _MIN_PRESENCE:
            return None
        return self._look(image, found.roi) if twice else found


def _is_same(a: HandLandmarks, b: HandLandmarks) -> bool:
    distance = float(np.median(np.linalg.norm(a.points - b.points, axis=1)))
    return distance < _MAX_DUPLICATE_DISTANCE * min(a.roi.side, b.roi.side)


def hands_of(
    found: dict[tuple[int, int], HandLandmarks], column: int, shape: tuple[int, ...]
) -> tuple[NDArray, NDArray]:
    """Points (2, 21, 2) [px] and confidence (2, 21) of a person's left and right hand; NaN and 0 if not detected."""
    points, confidence = np.full((2, 21, 2), np.nan), np.zeros((2, 21))
    for side in (0, 1):
        if hand := found.get((column, side)):
            points[side] = hand.points
            sure = hand.presence * (1 - hand.left if side else hand.left)
            confidence[side] = sure * is_inside(hand.points, shape)
    return points, confidence


def _unseen_person() -> PersonDetection:
    """A person whose body is not in view."""
    unseen = np.full((33, 2), np.nan), np.zeros(33), np.zeros(0, np.uint32), np.full((33, 3), np.nan)
    return PersonDetection(HANDS_ONLY_COLUMN, *unseen)
