"""Faces in the images of one camera: the 478 points of MediaPipe's mesh and irises, found from people's heads.

Source: Kartynnik et al., Real-time facial surface geometry from monocular video on mobile GPUs, 2019; Ablavatski et
al., Real-time pupil tracking from monocular video, 2020 (irises, in regions between the corners of the eyes).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.detection import PersonDetection
from kinefit.images.detectors.face_detector import HEAD, head_circles
from kinefit.images.detectors.models import interpreter
from kinefit.images.detectors.roi import Roi, is_inside

FACES, IRISES = "face_landmark.tflite", "iris_landmark.tflite"

_SIZE, _EYE_SIZE = 192, 64  # [px] sides of the networks' images
_MIN_PRESENCE = 0.5
_MIN_FACE_PX = 40.0  # height of a face: the points of smaller ones follow the network's idea of a face
_HEAD_SIDES = 1.8  # side of the first region in radii of the circle around the head
_FACE_SIDES = 1.5  # side of a region in the extent of the mesh, as published
_EYE_SIDES = 2.3  # the same in distances between the corners of an eye
_MAX_SHIFT = 0.25  # from the circle around the head to the mesh's middle, in sides of the first region
_EYES, _MOUTH = [2, 5], [9, 10]  # of MEDIAPIPE_33
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


def around_head(points: NDArray) -> Roi | None:
    """The region of a person's face by the pose's landmarks (33, 2) [px]; None where they are not seen."""
    circle = head_circles(points[None, HEAD])
    if not len(circle):
        return None
    du, dv = points[_EYES].mean(axis=0) - points[_MOUTH].mean(axis=0)
    return Roi(circle[0, :2], _HEAD_SIDES * float(circle[0, 2]), float(np.arctan2(du, -dv)))


@dataclass(frozen=True)
class FaceFinder:
    """Finds the faces of people in an image; call it with an image and the people in it."""

    models: FaceModels

    def __call__(self, image: NDArray[np.uint8], people: Sequence[PersonDetection]) -> list[PersonDetection]:
        """The people with their faces: points (478, 2) [px] and confidence (478,); NaN and 0 where none is seen."""
        return [replace(person, face=self._face(image, person.points)) for person in people]

    def _face(self, image: NDArray[np.uint8], landmarks: NDArray) -> tuple[NDArray, NDArray]:
        """A face where the pose has the head, looked at again in its own region."""
        points, confidence = np.full((478, 2), np.nan), np.zeros(478)
        head = around_head(landmarks)
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
