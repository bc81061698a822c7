"""Detect all heads in an image, near and far, to hide the faces: high recall matters more than precision.

Source: Bazarevsky et al., BlazeFace, 2019; BlazePose, 2020, whose person detector gives a point of the face.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import BoxDetector, DetectedPerson
from kinefit.images.detectors.models import Models, interpreter
from kinefit.images.detectors.pose_model import SIZE

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
HEAD = slice(0, 11)
"""Landmarks of MEDIAPIPE_33 on the face."""


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
            return head_circles(points[None, HEAD]).tolist(), points
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
