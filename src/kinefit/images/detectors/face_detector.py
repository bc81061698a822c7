"""Finding the heads of everybody in an image, near and far, to hide their faces: recall counts, precision does not.

Source: Bazarevsky et al., BlazeFace, 2019; BlazePose, 2020, whose person detector gives a point of the face.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import BoxDetector
from kinefit.images.detectors.models import Models, interpreter
from kinefit.images.detectors.person_detector import DetectedPerson
from kinefit.images.detectors.pose_model import SIZE

FACES_NEAR, FACES_FAR = "face_detection_short_range.tflite", "face_detection_full_range_sparse.tflite"
_CELLS_NEAR, _CELLS_FAR = ((8, 2), (16, 6)), ((4, 1),)  # stride [px] of the feature maps, anchors in a cell
_MIN_FACE_SCORE = 0.5
_MIN_NEAR_SCORE = 0.7  # of the network for near faces in large parts of an image: it takes bellies for faces
_MIN_SMALL_SCORE = 0.4  # of both in the smallest parts, where what they take for a face is small
_MIN_PERSON_SCORE = 0.5
_MIN_LANDMARK_SCORE = 0.5  # of a person: the head is where nose, eyes and ears are
_MIN_UNCONFIRMED_SCORE = 0.8  # of a person of whom no landmarks are found: the head is where the detector says
_PART_STEP = 0.65  # of a part's side from one to the next: each face lies whole in one of them
_MIN_PART_PX = 250  # side of the smallest parts: faces of 15 px are found in them
_MAX_SHARE = 0.2  # of a part's side: larger faces are found in larger parts
_MAX_RATIO, _MIN_LARGE_SCORE = 1.5, 0.85  # a face on somebody's body is no larger than the head there, or scores high
_FACE_REACH = 0.9  # radius of what is hidden, in sides of the box of a face
_PERSON_REACH = 0.25  # the same, in radii of the circle around a person
_POINTS_REACH, _MIN_RADIUS_PX = 2.2, 12.0  # the same, in distances of the outermost of nose, eyes, ears; and at least
_OUTLIER_SHARE = 8.0  # of the median distance from the median: a point further away is not on the head; ears are nearer
HEAD = slice(0, 11)
"""Landmarks of MEDIAPIPE_33 on the face."""


class FaceDetector:
    """Circles around the heads in an image; not to be shared between threads.

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
        near, far = (interpreter(Path(folder) / name, threads) for name in (FACES_NEAR, FACES_FAR))
        self._near, self._far = BoxDetector(near, _CELLS_NEAR), BoxDetector(far, _CELLS_FAR)
        self._people = Models(folder, threads)

    def __call__(self, image: NDArray[np.uint8], *, small: bool = False) -> NDArray:
        """(N, 4) [px] middle (u, v) and radius of what hides each head in an RGB image (H, W, 3), and 1 of small ones.

        The image is looked at as a whole and in squares of its shorter side; with `small`, in the parts, too, that
        heads of a hundredth of its height need, which takes several times as long.
        """
        found, shorter = [np.zeros((0, 4))], min(image.shape[:2])
        bodies = list[tuple[NDArray, float]]()  # landmarks (33, 2) [px], radius of the head [px]
        for left, top, side in parts(image.shape[1], image.shape[0], small=small):
            part, corner = np.ascontiguousarray(image[top : top + side, left : left + side]), np.array([left, top])
            whole, in_part, circles = side >= max(image.shape[:2]), side < shorter, list[list[float]]()
            for person in self._people.find_people(part) if side >= shorter // 2 else ():  # whole in no smaller part
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
                radius = _FACE_REACH * size
                if (whole or size < _MAX_SHARE * side) and (box.score > _MIN_LARGE_SCORE or not any(
                    _is_inside(middle + corner, body) and radius > _MAX_RATIO * head for body, head in bodies
                )):  # fmt: skip
                    circles.append([*middle, radius])
            found += [np.array([[u + left, v + top, radius, in_part]]) for u, v, radius in circles]
        return np.concatenate(found)

    def _head(self, part: NDArray[np.uint8], person: DetectedPerson) -> tuple[list[list[float]], NDArray]:
        """Circle, or none, around the head of somebody found in a part of an image, and landmarks (33 or 0, 2) [px]."""
        seen = self._people.pose(person.roi.crop(part, SIZE), mask=False)
        if seen.score >= _MIN_LANDMARK_SCORE:
            points = person.roi.to_image(seen.points, SIZE)
            return head_circles(points[None, HEAD]).tolist(), points
        if person.head is None or person.score < _MIN_UNCONFIRMED_SCORE:
            return [], np.zeros((0, 2))
        body = float(np.linalg.norm(np.diff(person.points, axis=0)))
        return [[*person.head.mean(axis=0), _PERSON_REACH * body]], np.zeros((0, 2))


def _is_inside(point: NDArray, body: NDArray) -> bool:
    """Whether a point [px] is in the box around somebody's landmarks (33, 2) [px]: in a part a belly is a person."""
    return bool((point > body.min(axis=0)).all() and (point < body.max(axis=0)).all())


def parts(width: int, height: int, *, small: bool) -> list[tuple[int, int, int]]:
    """Squares (left, top, side) [px] that an image is looked at in: all of it, the largest, and ever smaller ones."""
    shorter, found = min(width, height), [(0, 0, max(width, height))]
    sides = [shorter]
    while small and sides[-1] // 2 >= min(_MIN_PART_PX, shorter // 2) > 0:
        sides.append(sides[-1] // 2)
    for side in sides:
        lefts, tops = (
            np.linspace(0, n - side, int(np.ceil((n - side) / (_PART_STEP * side))) + 1).astype(int)
            for n in (width, height)
        )
        found += [(int(u), int(v), side) for v in tops for u in lefts]
    return found


def head_circles(points: NDArray) -> NDArray:
    """(N, 3) [px] circles around heads of which points (P, K, 2) [px] are seen: nose, eyes, ears; NaN: not seen."""
    points = points[np.isfinite(points).all(axis=2).any(axis=1)]
    if not points.size:
        return np.zeros((0, 3))
    off = np.linalg.norm(points - np.nanmedian(points, axis=1, keepdims=True), axis=2, keepdims=True)
    points = np.where(off > _OUTLIER_SHARE * np.nanmedian(off, axis=1, keepdims=True), np.nan, points)
    middle = np.nanmean(points, axis=1)
    spread = np.nanmax(np.linalg.norm(points - middle[:, None], axis=2), axis=1)
    return np.column_stack([middle, np.maximum(_POINTS_REACH * spread, _MIN_RADIUS_PX)])
