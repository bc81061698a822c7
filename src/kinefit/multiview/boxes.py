"""One person in the records of two detectors of one camera: by the boxes that they give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.observations import Keypoints
from kinefit.solvers.assignment import assign

_BOX = 0.3  # boxes that two detectors give one person differ by less, as a share of their height


def same_people(people: Sequence[NDArray], theirs: Keypoints, mine: Keypoints) -> list[NDArray]:
    """(F,) for each of several people which of one record's detections they are, as known of another record.

    Parameters
    ----------
    people : (F,) each, which of the other record's detections they are; -1 for none
    theirs, mine : records of one camera
    """
    a, b = _boxes(theirs), _boxes(mine)
    out = [np.full(len(one), -1) for one in people]
    for f in range(min(len(a), len(b))):
        cost = np.full((len(people), b.shape[1]), np.inf)
        for i, one in enumerate(people):
            if one[f] >= 0:
                off = np.linalg.norm(b[f, :, :2] - a[f, one[f], :2], axis=1) / max(a[f, one[f], 3], 1.0)
                cost[i] = np.where(np.isfinite(off), off, np.inf)
        for i, p in assign(cost, _BOX):
            out[i][f] = p
    return out


def _boxes(record: Keypoints) -> NDArray:
    """(F, P, 4) [px] middle, width and height of the box about each person's points; NaN for nothing.

    Not about their mean: detectors have more points in the face, in the hands or in neither.
    """
    seen = np.isfinite(record.points).all(axis=-1) & (record.confidence > 0.1)
    uv = np.where(seen[..., None], record.points, np.nan)
    out = np.full((*uv.shape[:2], 4), np.nan)
    some = seen.any(axis=2)
    low, high = np.nanmin(uv[some], axis=1), np.nanmax(uv[some], axis=1)
    out[some] = np.concatenate([(low + high) / 2.0, high - low], axis=1)
    return out
