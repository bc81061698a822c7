"""Arrays of keypoints, the common form of all file formats, and their records."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import kept
from kinefit.errors import ObservationError
from kinefit.observations import Keypoints
from kinefit.observations.arrays import sealed
from kinefit.observations.keypoint_values import check_pixels, confidence_of
from kinefit.readers.keypoint_sets import keypoint_names

if TYPE_CHECKING:
    from kinefit.geometry.camera import ImageFrame

FACE_POINTS = 468, 478
"""Points of a face mesh without and with irises."""


def cut_frames(items: Any, frames: tuple[int, int] | None, file: Path) -> tuple[Any, int]:
    """Slice of the frames [start, stop) and its start; raises ObservationError if there are fewer."""
    if frames is None:
        return items, 0
    if not 0 <= frames[0] < frames[1] <= len(items):
        raise ObservationError(
            f"frames [{frames[0]}, {frames[1]}] of {len(items)}", file=file,
            remedy=f"Give frames within [0, {len(items)}].",
        )
    return items[frames[0] : frames[1]], frames[0]


def face_mesh(data: NDArray) -> NDArray:
    """(F, 478, 3) x, y [px] and 1 where detected, of a face mesh (F, 468 or 478, 3) whose third column is a depth."""
    uv = data[..., :2]
    seen = np.concatenate([uv, uv.any(axis=-1, keepdims=True)], axis=-1)
    return np.pad(seen, ((0, 0), (0, max(FACE_POINTS) - data.shape[1]), (0, 0)))


def keypoint_record(
    data: NDArray, camera: str, keypoint_set: str, rate: float, time_offset: float, start: int, source: Path,
    image_frame: ImageFrame | None,
) -> Keypoints:  # fmt: skip
    """Make a record of (F, P, K, 3) x, y [px], confidence 0..1; zeros where a point was not detected.

    rate [Hz], time_offset [s]; raises ObservationError for a rate that is not positive, and what `Keypoints` raises.
    """
    if not rate > 0 or not np.isfinite(rate):
        raise ObservationError(f"rate {rate} Hz", file=source, remedy="Give a positive frame rate.")
    what = f"keypoints of camera {camera}"
    points, confidence = data[..., :2], confidence_of(data[..., 2], what, source)
    check_pixels(points, confidence, what, source)  # before they are converted
    seen = (confidence > 0) | points.any(axis=-1)
    if image_frame is not None:
        points = image_frame.to_calibration(points)
    points = sealed(kept(np.where(seen[..., None], points, np.nan)))
    confidence = sealed(kept(np.where(seen, confidence, 0.0)))
    offset = time_offset + start / rate
    names = keypoint_names(keypoint_set)
    return Keypoints(camera, keypoint_set, names, rate, points, confidence, time_offset=offset, source=str(source))
