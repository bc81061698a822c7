"""Single-shot detectors of the BlazeFace family: people, faces and palms in a whole image, by anchors of one size.

Source: Bazarevsky et al., BlazeFace, 2019 (anchors, weighted suppression); BlazePose, 2020.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.roi import Roi

_MAX_OVERLAP = 0.3  # intersection over union of two boxes; boxes that overlap more show the same object
_MAX_LOGIT = 100.0  # beyond it the exponential overflows


@dataclass(frozen=True, eq=False)
class DetectedBox:
    """One detection: corners (2, 2) [px] upper left and lower right, points (K, 2) [px], score 0..1."""

    corners: NDArray
    points: NDArray
    score: float


class BoxDetector:
    """Detects boxes with points in a whole image.

    Parameters
    ----------
    interpreter
        Of a network with input (1, S, S, 3) and outputs (1, N, 4 + 2 K): boxes and points in pixels from their anchors,
        and (1, N, 1): logits.
    cells : ((stride [px], anchors in a cell), ...)
        Feature maps in the order of the network's anchors.
    low : float
        Input value of black; white is 1.
    """

    def __init__(self, interpreter: Any, cells: Sequence[tuple[int, int]], low: float = -1.0) -> None:
        self._interpreter, self._low = interpreter, low
        details = interpreter.get_input_details()[0]
        self._input, self.size = details["index"], int(details["shape"][1])
        outputs = sorted(interpreter.get_output_details(), key=lambda o: int(o["shape"][-1]))
        self._scores, self._boxes = (o["index"] for o in outputs)
        self._anchors = anchors(self.size, cells)

    def __call__(self, image: NDArray[np.uint8], min_score: float = 0.5) -> list[DetectedBox]:
        """Detections in an RGB image (H, W, 3), in order of decreasing score."""
        square, side, offset = letterboxed(image, self.size)
        values = square * np.float32((1 - self._low) / 255) + np.float32(self._low)
        self._interpreter.set_tensor(self._input, values[None])
        self._interpreter.invoke()
        raw = self._interpreter.get_tensor(self._boxes)[0]
        logits = self._interpreter.get_tensor(self._scores)[0, :, 0]
        found = decode(raw, logits, self._anchors, self.size, min_score)
        return [DetectedBox(v[:2] * side - offset, v[2:] * side - offset, score) for v, score in found]


def anchors(size: int, cells: Sequence[tuple[int, int]]) -> NDArray:
    """Centres (N, 2) of the anchors, in units of the side `size` [px] of the network's image; see `BoxDetector`."""
    maps = []
    for stride, count in cells:
        at = (np.arange(size // stride) + 0.5) * stride / size
        u, v = np.meshgrid(at, at)
        maps.append(np.repeat(np.column_stack([u.ravel(), v.ravel()]), count, axis=0))
    return np.concatenate(maps)


def decode(
    raw: NDArray, logits: NDArray, centres: NDArray, size: int, min_score: float = 0.5
) -> list[tuple[NDArray, float]]:
    """Decode the network's output: corners and points (2 + K, 2) in units of its image's side, and scores.

    Overlapping boxes are merged by a mean that is weighted with their scores.

    Parameters
    ----------
    raw : (N, 4 + 2 K)
        Centre, width and height of the box, then its points; in pixels from the anchor.
    logits : (N,)
    centres : (N, 2) of the anchors
    size : int [px] side of the network's image
    min_score : float in 0..1
    """
    kept = np.flatnonzero(logits > np.log(min_score / (1 - min_score)))
    kept = kept[np.argsort(-logits[kept], kind="stable")]
    scores = 1 / (1 + np.exp(-np.clip(logits[kept], -_MAX_LOGIT, _MAX_LOGIT)))
    values = raw[kept].reshape(len(kept), raw.shape[1] // 2, 2).astype(float) / size
    half = values[:, 1] / 2
    values[:, 1] = values[:, 0]
    values += centres[kept][:, None]
    values[:, 0] -= half
    values[:, 1] += half
    found = []
    while len(scores):
        low, high = values[:, 0], values[:, 1]
        inner = np.prod(np.clip(np.minimum(high, high[0]) - np.maximum(low, low[0]), 0, None), axis=1)
        areas = np.prod(high - low, axis=1)
        duplicate = inner > _MAX_OVERLAP * (areas + areas[0] - inner)
        duplicate[0] = True
        found.append((np.average(values[duplicate], axis=0, weights=scores[duplicate]), float(scores[0])))
        values, scores = values[~duplicate], scores[~duplicate]
    return found


def letterboxed(image: NDArray[np.uint8], size: int) -> tuple[NDArray[np.uint8], float, NDArray]:
    """Letterbox an image (H, W, 3): (size, size, 3) with black bars; and the square's side and offset (2,) [px]."""
    height, width = image.shape[:2]
    side = max(height, width)
    offset = np.array([side - width, side - height]) / 2
    scale = side / size
    A = np.array([[scale, 0, -offset[0]], [0, scale, -offset[1]]])
    square = cv2.warpAffine(image, A, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(square, np.uint8), float(side), offset


CELLS = ((8, 2), (16, 2), (32, 6))  # stride [px] of the feature maps, anchors in a cell
_MIN_PERSON_SCORE = 0.5  # at 0.25 machines in an empty room are false positives


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """A person detected in an image.

    Parameters
    ----------
    points : (2, 2) [px]
        Middle of the hips, and a point above it on the circle around the body.
    score : float, 0..1
    head : (2, 2) [px], optional
        Upper left and lower right corner of a box around the face, visible or not.
    """

    points: NDArray
    score: float
    head: NDArray | None = None

    @property
    def roi(self) -> Roi:
        """Region around the whole body [px]."""
        return Roi.around_person(*self.points)

    def turned_back(self, quarters: int, shape: tuple[int, int]) -> DetectedPerson:
        """Rotate a detection back: from `numpy.rot90` by some quarter turns to the image of shape (height, width)."""
        points, (height, width) = self.points, shape
        if quarters % 2:
            height, width = width, height
        for _ in range(quarters):
            points = np.column_stack([height - 1 - points[:, 1], points[:, 0]])
            height, width = width, height
        return DetectedPerson(points, self.score)


class PersonDetector:
    """Detects people in a whole image.

    Parameters
    ----------
    interpreter
        Of `pose_detection.tflite`: from (1, 224, 224, 3) in -1..1 to 2254 boxes with four points each, and scores.
    """

    def __init__(self, interpreter: Any) -> None:
        self._boxes = BoxDetector(interpreter, CELLS)

    def __call__(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """People in an RGB image (H, W, 3), in order of decreasing score."""
        return [DetectedPerson(b.points[:2], b.score, b.corners) for b in self._boxes(image, _MIN_PERSON_SCORE)]
