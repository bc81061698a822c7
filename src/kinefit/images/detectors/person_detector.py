"""Detect people in a whole image.

Source: Bazarevsky et al., BlazePose, 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.images.detectors.box_detector import BoxDetector
from kinefit.images.detectors.roi import Roi

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
