"""Finding people in a whole picture.

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
_MIN_PERSON_SCORE = 0.5  # at 0.25 machines in an empty room are taken for a person


@dataclass(frozen=True, eq=False)
class DetectedPerson:
    """Somebody in a picture.

    Parameters
    ----------
    points : (2, 2) [px]
        Middle of the hips, and a point above it on the circle around the body.
    score : float, 0..1
    head : (2, 2) [px], optional
        Corners, upper left and lower right, of a box around the face, or where it would be.
    """

    points: NDArray
    score: float
    head: NDArray | None = None

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


class PersonDetector:
    """People in a whole picture.

    Parameters
    ----------
    interpreter
        Of `pose_detection.tflite`: (1, 224, 224, 3) in -1..1 to 2254 boxes with four points each, and their scores.
    """

    def __init__(self, interpreter: Any) -> None:
        self._boxes = BoxDetector(interpreter, CELLS)

    def __call__(self, image: NDArray[np.uint8]) -> list[DetectedPerson]:
        """People in an RGB picture (H, W, 3), the surest first."""
        return [DetectedPerson(b.points[:2], b.score, b.corners) for b in self._boxes(image, _MIN_PERSON_SCORE)]
