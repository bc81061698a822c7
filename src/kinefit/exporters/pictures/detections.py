"""Writing what the built-in detector saw (`kinefit.readers.detections` tells the format), and drawing it."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ExportError
from kinefit.exporters.atomic import writing
from kinefit.observations import MEDIAPIPE_33, Detections
from kinefit.readers.detections import FORMAT, VERSION

_COLOURS = ((255, 200, 40), (90, 220, 255), (255, 120, 220), (140, 255, 120), (200, 160, 255))  # of the people
_LIMBS = tuple(
    tuple(MEDIAPIPE_33.index(name) for name in bone.split())
    for bone in (
        "left_shoulder right_shoulder", "left_hip right_hip",
        *(
            bone.replace("*", side)
            for side in ("left", "right")
            for bone in (
                "*_shoulder *_elbow", "*_elbow *_wrist", "*_wrist *_index", "*_shoulder *_hip", "*_hip *_knee",
                "*_knee *_ankle", "*_ankle *_heel", "*_heel *_foot_index", "nose *_ear",
            )
        ),
    )
)
_SURE = 0.5  # confidence from which on a landmark is drawn full


def write_detections(detections: Detections, path: str | PathLike[str], *, key: str = "") -> None:
    """Write a file that `read_detections` reads, whole or not at all.

    Raises
    ------
    ExportError
        The name does not end in .npz, or the file cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise ExportError("a file of detections ends in .npz", file=path, remedy=f"Call it {Path(path).stem}.npz.")
    extra: dict[str, Any] = {} if detections.lifted is None else {"lifted": detections.lifted.astype(np.float32)}
    with writing(path) as temporary:
        np.savez_compressed(
            temporary, format=np.array(FORMAT), version=np.array(VERSION), key=np.array(key),
            camera=np.array(detections.camera), rate=np.array(detections.rate), size=np.array(detections.size),
            points=detections.points.astype(np.float32), confidence=detections.confidence.astype(np.float32),
            mask_runs=detections.mask_runs, mask_starts=detections.mask_starts,
            **extra,
        )


def draw_people(image: NDArray[np.uint8], detections: Detections, frame: int) -> NDArray[np.uint8]:
    """Picture (H, W, 3) RGB of a frame with everybody's outline, landmarks and number: a new array."""
    drawn = image.copy()
    scale = max(image.shape[0], image.shape[1]) / 1000
    width = max(1, round(2 * scale))
    for person in np.flatnonzero(detections.seen[frame]):
        colour = _COLOURS[person % len(_COLOURS)]
        mask = detections.mask(frame, int(person))
        if mask is not None:
            contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(drawn, contours, -1, colour, width)
        points, sure = detections.points[frame, person], detections.confidence[frame, person] >= _SURE
        for a, b in _LIMBS:
            if sure[a] and sure[b]:
                cv2.line(drawn, _pixel(points[a]), _pixel(points[b]), colour, width, cv2.LINE_AA)
        for k, point in enumerate(points):
            side = (40, 90, 255) if "right" in MEDIAPIPE_33[k] else (255, 60, 40)
            cv2.circle(drawn, _pixel(point), round(4 * scale), side, -1 if sure[k] else 1, cv2.LINE_AA)
        at = points[sure].min(axis=0) if sure.any() else points.min(axis=0)
        cv2.putText(
            drawn, str(person + 1), _pixel(at - 10 * scale), cv2.FONT_HERSHEY_SIMPLEX, 1.2 * scale, colour,
            2 * width, cv2.LINE_AA,
        )
    return drawn


def _pixel(point: NDArray) -> tuple[int, int]:
    u, v = np.clip(np.rint(point), -30000, 30000)  # OpenCV's drawing wants numbers of 16 bits
    return int(u), int(v)
