"""Hands in the images of one camera: 21 points of each, found from people's wrists, or alone where nobody is in view.

Source: Zhang et al., MediaPipe Hands: on-device real-time hand tracking, 2020 (palms, then landmarks in a region that
is turned with the hand, then the region of the next image from the landmarks).
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
ALONE = -1
"""Column of hands of whoever is not in view."""

_PALM_CELLS = ((8, 2), (16, 6))  # stride [px] of the feature maps, anchors in a cell
_SIZE = 224  # [px] side of the landmark network's image
_MIN_PALM_SCORE, _MIN_PRESENCE = 0.5, 0.5
_MIN_ROI_PX = 12.0  # a hand smaller than half of it shows no fingers
_PALM_SIDES, _PALM_SHIFT = 2.6, 0.5  # side of a region in sides of the palm's box, and its shift towards the fingers
_POSE_SIDES, _POSE_CENTRE = 4.0, 1.2  # the same, from a person's wrist, in distances from it to the knuckles
_FOREARM_SIDES = 0.9  # the same in forearms, where the hand points to the camera
_LANDMARK_SIDES = 1.6  # side of a region in the extent of the landmarks
_MAX_WRIST_SHIFT = 0.5  # between the pose's wrist and the hand's, in sides of the region
_SAME_HAND = 0.25  # two hands whose points are nearer in the median, in sides of the region, are one
_ELBOWS, _WRISTS, _PINKIES, _INDEXES = (13, 14), (15, 16), (17, 18), (19, 20)  # of MEDIAPIPE_33, left and right
_WRIST, _MIDDLE = 0, 9  # wrist and knuckle of the middle finger, of MEDIAPIPE_HAND_21


@dataclass(frozen=True, eq=False)
class HandLandmarks:
    """A hand in an image: points (21, 2) [px], probabilities of a hand and of a left one, and the region it lies in."""

    points: NDArray
    presence: float
    left: float
    roi: Roi


class HandModels:
    """Networks that find palms in an image and a hand's landmarks in a region; not to be shared between threads.

    Parameters
    ----------
    folder : path
        With the networks' files.
    threads : int
        That each network runs on.

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
        """Regions of the hands in an RGB image (H, W, 3), in order of decreasing score."""
        found = []
        for palm in self._palms(image, _MIN_PALM_SCORE):
            du, dv = palm.points[2] - palm.points[0]  # from the wrist to the knuckle of the middle finger
            turn, side = float(np.arctan2(du, -dv)), float(np.ptp(palm.corners, axis=0).max())
            centre = palm.corners.mean(axis=0) + _PALM_SHIFT * side * np.array([np.sin(turn), -np.cos(turn)])
            found.append(Roi(centre, _PALM_SIDES * side, turn))
        return found

    def landmarks(self, image: NDArray[np.uint8], roi: Roi) -> HandLandmarks:
        """The hand in a region of an RGB image (H, W, 3)."""
        crop = roi.crop(image, _SIZE) * np.float32(1 / 255)
        self._hand.set_tensor(self._input, crop[None])
        self._hand.invoke()
        points, presence, right = (self._hand.get_tensor(index)[0] for index in self._outputs)
        uv = roi.to_image(points.reshape(21, 3)[:, :2].astype(float), _SIZE)
        return HandLandmarks(uv, float(presence[0]), 1 - float(right[0]), around_hand(uv))


def around_hand(points: NDArray) -> Roi:
    """The region around a hand's points (21, 2) [px], its fingers upwards."""
    return Roi.around_points(points, points[_MIDDLE] - points[_WRIST], _LANDMARK_SIDES)


def around_wrist(points: NDArray, side: int) -> Roi:
    """The region of a person's left (0) or right (1) hand by the pose's landmarks (33, 2) [px]."""
    wrist, elbow = points[_WRISTS[side]], points[_ELBOWS[side]]
    palm, forearm = (points[_PINKIES[side]] + points[_INDEXES[side]]) / 2 - wrist, wrist - elbow
    du, dv = palm if np.linalg.norm(palm) > 0.15 * np.linalg.norm(forearm) else forearm
    width = max(_POSE_SIDES * np.linalg.norm(palm), _FOREARM_SIDES * np.linalg.norm(forearm))
    return Roi(wrist + _POSE_CENTRE * palm, float(width), float(np.arctan2(du, -dv)))


@dataclass
class HandFollower:
    """Follows the hands of people through the images of one camera; call it with an image and the people in it.

    The pose's wrist says which hand is left. The network's own opinion of that is a factor of the confidence.
    """

    models: HandModels
    _before: dict[tuple[int, int], HandLandmarks] = field(default_factory=dict)

    def __call__(self, image: NDArray[np.uint8], people: Sequence[PersonDetection]) -> list[PersonDetection]:
        """The people with their hands; where these have none, one more in column `ALONE` with those in view, if any."""
        now: dict[tuple[int, int], HandLandmarks] = {}
        for person in people:
            for side in (0, 1):
                found = self._of_wrist(image, person, side)
                other = now.get((person.column, 0))
                if found and other and side and _is_same(found, other):
                    if found.left < 0.5:  # it is the right one, to which both wrists led
                        del now[person.column, 0]
                    else:
                        continue
                if found:
                    now[person.column, side] = found
        alone = self._alone(image) if not now else {}
        now |= alone
        self._before = now
        people = [*people, *([_nobody()] if alone else [])]
        return [replace(person, hands=hands_of(now, person.column, image.shape)) for person in people]

    def _of_wrist(self, image: NDArray[np.uint8], person: PersonDetection, side: int) -> HandLandmarks | None:
        """A hand near a person's wrist: where it was in the image before, else where the pose says."""
        before, wrist = self._before.get((person.column, side)), person.points[_WRISTS[side]]
        pose = around_wrist(person.points, side)
        for roi in (before.roi, pose) if before else (pose,):
            found = self._look(image, roi, twice=roi is pose)
            if found and np.linalg.norm(found.points[_WRIST] - wrist) < _MAX_WRIST_SHIFT * max(pose.side, roi.side):
                return found
        return None

    def _alone(self, image: NDArray[np.uint8]) -> dict[tuple[int, int], HandLandmarks]:
        """A left and a right hand at most, followed or found by their palms."""
        now: dict[tuple[int, int], HandLandmarks] = {}
        for before in [hand for (column, _), hand in self._before.items() if column == ALONE]:
            if found := self._look(image, before.roi):
                now.setdefault((ALONE, int(found.left < 0.5)), found)
        for roi in self.models.find_palms(image) if not now else ():
            found = self._look(image, roi, twice=True)
            if found and not any(_is_same(found, hand) for hand in now.values()):
                now.setdefault((ALONE, int(found.left < 0.5)), found)
        return now

    def _look(self, image: NDArray[np.uint8], roi: Roi, *, twice: bool = False) -> HandLandmarks | None:
        """The hand in a region, None where there is none; looked at again in its own region where that was a guess."""
        if not _MIN_ROI_PX < roi.side < 4 * max(image.shape[:2]):
            return None
        found = self.models.landmarks(image, roi)
        if found.presence < _MIN_PRESENCE:
            return None
        return self._look(image, found.roi) if twice else found


def _is_same(one: HandLandmarks, other: HandLandmarks) -> bool:
    apart = float(np.median(np.linalg.norm(one.points - other.points, axis=1)))
    return apart < _SAME_HAND * min(one.roi.side, other.roi.side)


def hands_of(
    found: dict[tuple[int, int], HandLandmarks], column: int, shape: tuple[int, ...]
) -> tuple[NDArray, NDArray]:
    """Points (2, 21, 2) [px] and confidence (2, 21) of somebody's left and right hand; NaN and 0 where not seen."""
    points, confidence = np.full((2, 21, 2), np.nan), np.zeros((2, 21))
    for side in (0, 1):
        if hand := found.get((column, side)):
            points[side] = hand.points
            sure = hand.presence * (1 - hand.left if side else hand.left)
            confidence[side] = sure * is_inside(hand.points, shape)
    return points, confidence


def _nobody() -> PersonDetection:
    """A person who is not in view."""
    unseen = np.full((33, 2), np.nan), np.zeros(33), np.zeros(0, np.uint32), np.full((33, 3), np.nan)
    return PersonDetection(ALONE, *unseen)
