"""Faces and hands in an image: where faces are, to hide them, and the landmarks of the faces and hands of people.

Source: Kartynnik et al., Real-time facial surface geometry from monocular video on mobile GPUs, 2019; Ablavatski et
al., Real-time pupil tracking from monocular video, 2020 (irises, in regions between the corners of the eyes).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import BoxDetector, DetectedPerson, Models, interpreter
from kinefit.images.detectors.following import PersonDetection
from kinefit.images.detectors.layouts import BLAZEPOSE, SIZE, PointLayout
from kinefit.images.detectors.roi import Roi, is_inside

FACES_NEAR, FACES_FAR = "face_detection_short_range.tflite", "face_detection_full_range_sparse.tflite"
_CELLS_NEAR = ((8, 2), (16, 6))  # stride [px] of the feature maps, anchors in a cell
_CELLS_FAR = ((4, 1),)
_MIN_FACE_SCORE = 0.5
_MIN_NEAR_SCORE = 0.7  # of the near-face network in large tiles of an image, where it mistakes bellies for faces
_MIN_SMALL_SCORE = 0.4  # of both networks in the smallest tiles: a false positive there hides little
_MIN_PERSON_SCORE = 0.5
_MIN_LANDMARK_SCORE = 0.5  # of a person whose head is given by nose, eyes and ears
_MIN_UNCONFIRMED_SCORE = 0.8  # of a person without landmarks, whose head is given by the detector
_TILE_STEP = 0.65  # of a tile's side from one tile to the next: each face lies wholly in one of them
_MIN_TILE_PX = 250  # side: faces of 15 px are detected in it
_MAX_FACE_SHARE = 0.2  # of a tile's side: larger faces are detected in larger tiles
_MAX_HEAD_RATIO = 1.5  # of a face on a body to that body's head
_MIN_LARGE_SCORE = 0.85  # of a larger face
_FACE_RADIUS = 0.9  # of the hidden circle, in sides of the face's box
_PERSON_RADIUS = 0.25  # the same, in radii of the circle around a person
_LANDMARK_RADIUS = 2.2  # the same, in distances of the outermost of nose, eyes and ears from their middle
_MIN_RADIUS_PX = 12.0  # of the hidden circle
_MAX_OUTLIER_RATIO = 8.0  # distance of a landmark of the head from the median, to the median distance; ears are nearer


class FaceDetector:
    """Detects circles around the heads in an image. Not thread-safe.

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
        near, far = (interpreter(Path(folder) / name, threads) for name in (FACES_NEAR, FACES_FAR))
        self._near, self._far = BoxDetector(near, _CELLS_NEAR), BoxDetector(far, _CELLS_FAR)
        self._people = Models(folder, threads)

    def __call__(self, image: NDArray[np.uint8], *, small: bool = False) -> NDArray:
        """Circles (N, 4) around the heads in an RGB image (H, W, 3): centre u, v and radius [px], 1 for small heads.

        The networks search the whole image and squares of its shorter side. With `small` they also search smaller tiles
        for heads down to a hundredth of the image's height, which takes several times as long.
        """
        found, shorter = [np.zeros((0, 4))], min(image.shape[:2])
        bodies = list[tuple[NDArray, float]]()  # landmarks (33, 2) [px], radius of the head [px]
        for left, top, side in parts(image.shape[1], image.shape[0], small=small):
            part, corner = np.ascontiguousarray(image[top : top + side, left : left + side]), np.array([left, top])
            whole, in_part, circles = side >= max(image.shape[:2]), side < shorter, list[list[float]]()
            for person in self._people.find_people(part) if side >= shorter // 2 else ():  # smaller ones hold no person
                if in_part and any(_is_inside(person.points[0] + corner, body) for body, _ in bodies):
                    continue
                circle, points = self._head(part, person)
                circles += circle
                bodies += [(points + corner, head[2]) for head in circle if len(points) and not in_part]
            near, far = (_MIN_FACE_SCORE if whole else _MIN_NEAR_SCORE), _MIN_FACE_SCORE
            if side < shorter // 2:
                near = far = _MIN_SMALL_SCORE
            for box in self._near(part, near) + self._far(part, far):
                middle, size = box.corners.mean(axis=0), float(np.ptp(box.corners, axis=0).max())
                radius = _FACE_RADIUS * size
                if (whole or size < _MAX_FACE_SHARE * side) and (box.score > _MIN_LARGE_SCORE or not any(
                    _is_inside(middle + corner, body) and radius > _MAX_HEAD_RATIO * head for body, head in bodies
                )):  # fmt: skip
                    circles.append([*middle, radius])
            found += [np.array([[u + left, v + top, radius, in_part]]) for u, v, radius in circles]
        return np.concatenate(found)

    def _head(self, part: NDArray[np.uint8], person: DetectedPerson) -> tuple[list[list[float]], NDArray]:
        """Circle around the head of a person in a tile of an image, if any, and landmarks (33 or 0, 2) [px]."""
        pose = self._people.pose(person.roi.crop(part, SIZE), mask=False)
        if pose.score >= _MIN_LANDMARK_SCORE:
            points = person.roi.to_image(pose.points, SIZE)
            return head_circles(points[None, BLAZEPOSE.head]).tolist(), points
        if person.head is None or person.score < _MIN_UNCONFIRMED_SCORE:
            return [], np.zeros((0, 2))
        body = float(np.linalg.norm(np.diff(person.points, axis=0)))
        return [[*person.head.mean(axis=0), _PERSON_RADIUS * body]], np.zeros((0, 2))


def _is_inside(point: NDArray, body: NDArray) -> bool:
    """Whether a point [px] lies in the box of a body (33, 2) [px], such as a belly that is mistaken for a face."""
    return bool((point > body.min(axis=0)).all() and (point < body.max(axis=0)).all())


def parts(width: int, height: int, *, small: bool) -> list[tuple[int, int, int]]:
    """Tiles (left, top, side) [px] of an image: the whole image, the largest squares, then smaller ones if `small`."""
    shorter, found = min(width, height), [(0, 0, max(width, height))]
    sides = [shorter]
    while small and sides[-1] // 2 >= min(_MIN_TILE_PX, shorter // 2) > 0:
        sides.append(sides[-1] // 2)
    for side in sides:
        lefts, tops = (
            np.linspace(0, n - side, int(np.ceil((n - side) / (_TILE_STEP * side))) + 1).astype(int)
            for n in (width, height)
        )
        found += [(int(u), int(v), side) for v in tops for u in lefts]
    return found


def head_circles(points: NDArray) -> NDArray:
    """Circles (N, 3) [px] around heads with landmarks (P, K, 2) [px] of nose, eyes and ears; NaN: not detected."""
    points = points[np.isfinite(points).all(axis=2).any(axis=1)]
    if not points.size:
        return np.zeros((0, 3))
    distance = np.linalg.norm(points - np.nanmedian(points, axis=1, keepdims=True), axis=2, keepdims=True)
    points = np.where(distance > _MAX_OUTLIER_RATIO * np.nanmedian(distance, axis=1, keepdims=True), np.nan, points)
    middle = np.nanmean(points, axis=1)
    spread = np.nanmax(np.linalg.norm(points - middle[:, None], axis=2), axis=1)
    return np.column_stack([middle, np.maximum(_LANDMARK_RADIUS * spread, _MIN_RADIUS_PX)])


FACES, IRISES = "face_landmark.tflite", "iris_landmark.tflite"

_SIZE, _EYE_SIZE = 192, 64  # [px] sides of the networks' images
_MIN_PRESENCE = 0.5
_MIN_FACE_PX = 40.0  # height of a face: the points of smaller ones follow the network's idea of a face
_HEAD_SIDES = 1.8  # side of the first region in radii of the circle around the head
_FACE_SIDES = 1.5  # side of a region in the extent of the mesh, as published
_EYE_SIDES = 2.3  # the same in distances between the corners of an eye
_MAX_SHIFT = 0.25  # from the circle around the head to the mesh's middle, in sides of the first region
_TOP, _CHIN = 10, 152  # of MEDIAPIPE_478
_CORNERS = ((33, 133), (362, 263))  # corners of the right and the left eye, from the image's left to its right
_IRIS_ORDER = ([468, 469, 470, 471, 472], [473, 476, 475, 474, 477])  # middle, inner, top, outer, bottom


@dataclass(frozen=True, eq=False)
class FaceLandmarks:
    """A face in an image: points (478, 2) [px] of MEDIAPIPE_478, and the probability of a face."""

    points: NDArray
    presence: float


class FaceModels:
    """Networks that find the points of a face in a region; not to be shared between threads.

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
        self._mesh, self._iris = (interpreter(Path(folder) / name, threads) for name in (FACES, IRISES))

    def landmarks(self, image: NDArray[np.uint8], roi: Roi) -> FaceLandmarks:
        """The face in a region of an RGB image (H, W, 3)."""
        outputs = _run(self._mesh, roi.crop(image, _SIZE))
        points = np.empty((478, 2))
        points[:468] = roi.to_image(outputs[1404].reshape(468, 3)[:, :2], _SIZE)
        for order, corners, mirror in zip(_IRIS_ORDER, _CORNERS, (False, True)):
            points[order] = self._iris_points(image, points[list(corners)], mirror=mirror)
        return FaceLandmarks(points, float(1 / (1 + np.exp(-outputs[1][0]))))

    def _iris_points(self, image: NDArray[np.uint8], corners: NDArray, *, mirror: bool) -> NDArray:
        """(5, 2) [px] points of the iris between the corners (2, 2) [px] of an eye; a left eye is mirrored."""
        du, dv = corners[1] - corners[0]
        roi = Roi(corners.mean(axis=0), max(_EYE_SIDES * float(np.hypot(du, dv)), 1.0), float(np.arctan2(dv, du)))
        crop = roi.crop(image, _EYE_SIZE)
        points = _run(self._iris, crop[:, ::-1] if mirror else crop)[15].reshape(5, 3)[:, :2]
        if mirror:
            points[:, 0] = _EYE_SIZE - 1 - points[:, 0]
        return roi.to_image(points, _EYE_SIZE)


def _run(network: Any, crop: NDArray[np.uint8]) -> dict[int, NDArray]:
    """{number of its values: (N,) output} of a network whose input is an RGB crop from 0 to 1."""
    network.set_tensor(network.get_input_details()[0]["index"], (crop * np.float32(1 / 255))[None])
    network.invoke()
    outputs = (network.get_tensor(o["index"]).ravel().astype(float) for o in network.get_output_details())
    return {len(values): values for values in outputs}


def around_face(points: NDArray) -> Roi:
    """The region around a face's points (478, 2) [px], its forehead upwards."""
    return Roi.around_points(points, points[_TOP] - points[_CHIN], _FACE_SIDES)


def around_head(points: NDArray, layout: PointLayout = BLAZEPOSE) -> Roi | None:
    """The region of a person's face by the pose's landmarks (K, 2) [px]; None where they are not seen."""
    circle = head_circles(points[None, layout.head])
    if not len(circle) or not layout.eyes or not layout.below_eyes:
        return None
    du, dv = points[layout.eyes].mean(axis=0) - points[layout.below_eyes].mean(axis=0)
    return Roi(circle[0, :2], _HEAD_SIDES * float(circle[0, 2]), float(np.arctan2(du, -dv)))


@dataclass(frozen=True)
class FaceFinder:
    """Finds the faces of people in an image; call it with an image and the people in it."""

    models: FaceModels
    layout: PointLayout = BLAZEPOSE

    def __call__(self, image: NDArray[np.uint8], people: Sequence[PersonDetection]) -> list[PersonDetection]:
        """The people with their faces: points (478, 2) [px] and confidence (478,); NaN and 0 where none is seen."""
        return [replace(person, face=self._face(image, person.points)) for person in people]

    def _face(self, image: NDArray[np.uint8], landmarks: NDArray) -> tuple[NDArray, NDArray]:
        """A face where the pose has the head, looked at again in its own region."""
        points, confidence = np.full((478, 2), np.nan), np.zeros(478)
        head = around_head(landmarks, self.layout)
        if head is None or not _MIN_FACE_PX < head.side < 4 * max(image.shape[:2]):
            return points, confidence
        found = self.models.landmarks(image, head)
        if found.presence < _MIN_PRESENCE:
            return points, confidence
        found = self.models.landmarks(image, around_face(found.points))
        roi = around_face(found.points)
        is_there = np.linalg.norm(roi.centre - head.centre) < _MAX_SHIFT * head.side
        if found.presence >= _MIN_PRESENCE and roi.side > _FACE_SIDES * _MIN_FACE_PX and is_there:
            points = found.points
            confidence = found.presence * is_inside(points, image.shape)
        return points, confidence


PALMS, HANDS = "palm_detection_full.tflite", "hand_landmark_full.tflite"
HANDS_ONLY_COLUMN = -1
"""Column of hands of a person whose body is not in view."""

_PALM_CELLS = ((8, 2), (16, 6))  # stride [px] of the feature maps, anchors in a cell
_INPUT_PX = 224  # side of the landmark network's image
_MIN_PALM_SCORE = 0.5
_MIN_ROI_PX = 12.0  # side: a hand smaller than half of it shows no fingers
_PALM_ROI_SIDES = 2.6  # side of a region, in sides of the palm's box
_PALM_ROI_SHIFT = 0.5  # of the region towards the fingers, in sides of the palm's box
_PALM_LENGTHS = 4.0  # side of a region from a person's pose, in distances from wrist to knuckles
_PALM_CENTRE = 1.2  # of that region from the wrist, in the same unit
_MIN_FOREARMS = 0.9  # side of that region in lengths of the forearm, for hands that point to the camera
_LANDMARK_EXTENTS = 1.6  # side of a region, in the extent of the landmarks
_MAX_WRIST_DISTANCE = 0.5  # between the pose's wrist and the hand's, in sides of the region
_MAX_DUPLICATE_DISTANCE = 0.25  # median over the landmarks of one hand detected twice, in sides of the region
_PALM_FOREARMS = 0.3  # from the wrist to the knuckles in lengths of the forearm, where no points are on the hand
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


def around_wrist(points: NDArray, side: int, layout: PointLayout = BLAZEPOSE) -> Roi:
    """Region of a person's left (0) or right (1) hand from the landmarks (K, 2) [px] of the body."""
    wrist, elbow = (points[layout.sides(part)[side]] for part in ("wrist", "elbow"))
    forearm, fingers = wrist - elbow, [layout.sides(part)[side :: 2] for part in ("pinky", "index")]
    palm = points[np.concatenate(fingers)].mean(axis=0) - wrist if all(fingers) else _PALM_FOREARMS * forearm
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
    layout: PointLayout = BLAZEPOSE

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
        people = [*people, *([_unseen_person(self.layout)] if alone else [])]
        return [replace(person, hands=hands_of(now, person.column, image.shape)) for person in people]

    def _of_wrist(self, image: NDArray[np.uint8], person: PersonDetection, side: int) -> HandLandmarks | None:
        """Detect a hand near a person's wrist: in the region of the last image, else in that of the body's wrist."""
        before, wrists = self._before.get((person.column, side)), self.layout.sides("wrist")
        if not wrists or not self.layout.sides("elbow"):
            return None
        wrist, pose = person.points[wrists[side]], around_wrist(person.points, side, self.layout)
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


def _unseen_person(layout: PointLayout) -> PersonDetection:
    """A person whose body is not in view."""
    K = len(layout.names)
    unseen = np.full((K, 2), np.nan), np.zeros(K), np.zeros(0, np.uint32), np.full((K, 3), np.nan)
    return PersonDetection(HANDS_ONLY_COLUMN, *unseen)
