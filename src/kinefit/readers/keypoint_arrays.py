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
from kinefit.readers.keypoint_sets import keypoint_names

if TYPE_CHECKING:
    from kinefit.geometry.camera import ImageFrame

FACE_POINTS = 468, 478
"""Points of a face mesh without and with irises."""

_MAX_NORMALISED = 2.0  # coordinate as a share of the image size, which may lie outside of the image


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


def face_mesh(data: NDArray, path: Path) -> NDArray:
    """(F, 478, 3) x, y [px] and 1 where detected, of a face mesh (F, 468 or 478, 3) whose third column is a depth.

    Raises
    ------
    ObservationError
        Coordinates in shares of the image's size.
    """
    uv = data[..., :2]
    if 0.0 < np.abs(uv).max(initial=0.0) <= _MAX_NORMALISED:
        remedy = "Multiply x by the image's width and y by its height."
        raise ObservationError("coordinates of a face run from 0 to 1, not over pixels", file=path, remedy=remedy)
    seen = np.concatenate([uv, uv.any(axis=-1, keepdims=True)], axis=-1)
    return np.pad(seen, ((0, 0), (0, max(FACE_POINTS) - data.shape[1]), (0, 0)))


def keypoint_record(
    data: NDArray, camera: str, keypoint_set: str, rate: float, time_offset: float, start: int, source: Path,
    image_frame: ImageFrame | None,
) -> Keypoints:  # fmt: skip
    """Make a record of (F, P, K, 3) x, y [px], confidence 0..1; zeros where a point was not detected.

    rate [Hz], time_offset [s]; raises ObservationError for a rate that is not positive.
    """
    if not rate > 0 or not np.isfinite(rate):
        raise ObservationError(f"rate {rate} Hz", file=source, remedy="Give a positive frame rate.")
    confidence = np.clip(data[..., 2], 0, 1)
    points = data[..., :2]
    seen = (confidence > 0) | points.any(axis=-1)
    if image_frame is not None:
        points = image_frame.to_calibration(points)
    points = sealed(kept(np.where(seen[..., None], points, np.nan)))
    confidence = sealed(kept(np.where(seen, confidence, 0.0)))
    offset = time_offset + start / rate
    names = keypoint_names(keypoint_set)
    return Keypoints(camera, keypoint_set, names, rate, points, confidence, time_offset=offset, source=str(source))
