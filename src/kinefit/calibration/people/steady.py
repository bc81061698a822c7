"""One person of a camera in all frames, from the images of that camera alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.observations import Keypoints


def steady_person(record: Keypoints) -> Keypoints:
    """The same person of one camera in all frames: the one seen best, and whoever is nearest to where that one was.

    Raises
    ------
    CalibrationError
        Nobody is seen in any frame.
    """
    return record.of_one(steadiest(record))


def steadiest(record: Keypoints) -> NDArray:
    """(F,) int: which of the people `steady_person` is in each frame, -1 where unseen; raises as it does."""
    frames, people = record.points.shape[:2]
    seen = np.isfinite(record.points).all(axis=-1) & (record.confidence > 0.1)
    sure = np.where(seen, record.confidence, 0.0).sum(axis=-1)
    x = np.where(seen[..., None], record.points, np.nan)
    with np.errstate(all="ignore"):
        count = np.maximum(seen.sum(axis=2), 1)[..., None]
        centre = np.nansum(x, axis=2) / count
        size = np.sqrt(np.nansum((x - centre[:, :, None]) ** 2, axis=(2, 3)) / count[..., 0])
    size = np.where(sure > 0, size, 0.0)
    best = int(np.argmax((sure * size).max(axis=1))) if people else 0
    chosen = np.full(frames, -1)
    for order in (range(best, frames), range(best, -1, -1)):
        last: NDArray | None = None
        for f in order:
            near = 1.0 if last is None else np.exp(-np.linalg.norm(centre[f] - last, axis=1) / np.maximum(size[f], 1.0))
            score = sure[f] * size[f] * near if people else np.zeros(1)
            if score.max() > 0:
                chosen[f] = int(np.argmax(score))
                last = centre[f, chosen[f]]
    if not (chosen >= 0).any():
        raise CalibrationError(
            "no frame has a person", file=record.source or None, place=f"camera {record.camera}",
            remedy="Remove this camera, or detect again.",
        )
    return chosen
