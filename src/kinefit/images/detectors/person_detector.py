"""Finding people in a whole picture: a single-shot detector of BlazePose's family, with its anchors and suppression.

Source: Bazarevsky et al., BlazePose, 2020, and BlazeFace, 2019 (anchors of one size, weighted suppression).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.roi import Roi

SIZE = 224  # [px] side of the network's picture
_STRIDES = (8, 16, 32, 32, 32)  # [px] of the feature maps, two anchors in each cell of each
_SURE = 0.5  # least probability of a person: at 0.25 machines in an empty room are taken for one
_SAME = 0.3  # boxes that overlap by more are one person


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """Somebody in a picture.

    Parameters
    ----------
    points : (2, 2) [px]
        Middle of the hips, and a point above it on the circle around the body.
    score : float, 0..1
    """

    points: NDArray
    score: float

    @property
    def roi(self) -> Roi:
        """Region around the whole body."""
        return Roi.around_person(*self.points)

    def turned_back(self, quarters: int, shape: tuple[int, int]) -> DetectedPerson:
        """The person in a picture (height, width) who was found in `numpy.rot90` of it by so many quarter turns."""
        points, (height, width) = self.points, shape
        if quarters % 2:
            height, width = width, height
        for _ in range(quarters):
            points = np.column_stack([height - 1 - points[:, 1], points[:, 0]])
            height, width = width, height
        return DetectedPerson(points, self.score)


def anchors() -> NDArray:
    """(2254, 2) centres of the anchors, in sides of the network's picture; all are of size 1."""
    maps = []
    for stride in _STRIDES:
        at = (np.arange(SIZE // stride) + 0.5) * stride / SIZE
        u, v = np.meshgrid(at, at)
        maps.append(np.repeat(np.column_stack([u.ravel(), v.ravel()]), 2, axis=0))
    # feature maps of one stride are interleaved: all anchors of a cell follow each other
    first, last = maps[:2], maps[2].reshape(-1, 2, 2)
    return np.concatenate([*first, np.tile(last, (1, 3, 1)).reshape(-1, 2)])


_ANCHORS = anchors()


class PersonDetector:
    """People in a whole picture.

    Parameters
    ----------
    interpreter
        Of `pose_detection.tflite`: (1, 224, 224, 3) in -1..1 to 2254 boxes with four points each, and their scores.
    """

    def __init__(self, interpreter: Any) -> None:
        self._interpreter = interpreter
        self._input = interpreter.get_input_details()[0]["index"]
        outputs = {int(o["shape"][-1]): o["index"] for o in interpreter.get_output_details()}
        self._boxes, self._scores = outputs[12], outputs[1]

    def __call__(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """People in an RGB picture (H, W, 3), the surest first."""
        square, side, offset = _letterboxed(image)
        self._interpreter.set_tensor(self._input, square[None])
        self._interpreter.invoke()
        raw = self._interpreter.get_tensor(self._boxes)[0]
        logits = self._interpreter.get_tensor(self._scores)[0, :, 0]
        return [
            DetectedPerson(points[:2] * side - offset, score) for points, score in decode(raw, logits)
        ]


def decode(raw: NDArray, logits: NDArray) -> list[tuple[NDArray, float]]:
    """People from the network's numbers: their four points (4, 2) in sides of its picture, and their scores.

    Parameters
    ----------
    raw : (2254, 12)
        Centre, width and height of the box, then four points; in pixels from the anchor.
    logits : (2254,)
    """
    kept = np.flatnonzero(logits > np.log(_SURE / (1 - _SURE)))
    kept = kept[np.argsort(-logits[kept], kind="stable")]
    scores = 1 / (1 + np.exp(-np.clip(logits[kept], -100, 100)))
    values = raw[kept].reshape(-1, 6, 2).astype(float) / SIZE
    values[:, [0, 2, 3, 4, 5]] += _ANCHORS[kept][:, None]
    low, high = values[:, 0] - values[:, 1] / 2, values[:, 0] + values[:, 1] / 2
    people = []
    while len(scores):
        inner = np.prod(np.clip(np.minimum(high, high[0]) - np.maximum(low, low[0]), 0, None), axis=1)
        areas = np.prod(high - low, axis=1)
        same = inner > _SAME * (areas + areas[0] - inner)
        same[0] = True
        people.append((np.average(values[same, 2:], axis=0, weights=scores[same]), float(scores[0])))
        low, high, values, scores = low[~same], high[~same], values[~same], scores[~same]
    return people


def _letterboxed(image: NDArray[np.uint8]) -> tuple[NDArray, float, NDArray]:
    """The whole picture in the middle of a black square as the network wants it; the square's side and offset [px]."""
    height, width = image.shape[:2]
    side = max(height, width)
    offset = np.array([side - width, side - height]) / 2
    scale = side / SIZE
    A = np.array([[scale, 0, -offset[0]], [0, scale, -offset[1]]])
    square = cv2.warpAffine(image, A, (SIZE, SIZE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return square.astype(np.float32) / 127.5 - 1, float(side), offset
