"""Match the detections of two detectors in one image by bounding boxes; suppress duplicate detections of one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.observations import MEDIAPIPE_478, Keypoints

_MAX_BOX_SHIFT = 0.3  # between two detectors' boxes of one person, relative to the height
_HEAD_WORDS = ("nose", "eye", "ear", "mouth", "face")  # in names of points that a face mesh has too
_MAX_HEAD_SHIFT = 0.5  # between boxes of a face mesh and of another detector's head, relative to their size
_MAX_COPY_SHIFT = 0.03  # between points of duplicates, relative to the height: detectors' noise
_MIN_SHARED_POINTS = 4  # common to two detections
_MIN_NEAR_SHARE = 0.5  # of the common points


def match_by_boxes(people: Sequence[NDArray], source: Keypoints, target: Keypoints) -> list[NDArray]:
    """(F,) index of each person's detection in one record, given its index in another record of the same camera.

    Parameters
    ----------
    people : (F,) int each, index of the person's detection in `source`; -1 for none
    source, target : records of one camera; a face mesh is compared with the head of the other record
    """
    heads = MEDIAPIPE_478 in (source.names, target.names)
    a, b, limit = _boxes(source, heads), _boxes(target, heads), _MAX_HEAD_SHIFT if heads else _MAX_BOX_SHIFT
    out = [np.full(len(indices), -1) for indices in people]
    for f in range(min(len(a), len(b))):
        cost = np.full((len(people), b.shape[1]), np.inf)
        for i, indices in enumerate(people):
            if indices[f] >= 0:
                size = np.maximum(a[f, indices[f], 2:].max(), b[f, :, 2:].max(axis=1)) if heads else a[f, indices[f], 3]
                distance = np.linalg.norm(b[f, :, :2] - a[f, indices[f], :2], axis=1) / np.maximum(size, 1.0)
                cost[i] = np.where(np.isfinite(distance), distance, np.inf)
        for i, p in assign(cost, limit):
            out[i][f] = p
    return out


def suppress_duplicates(record: Keypoints, confidence: NDArray) -> NDArray:
    """Set the confidence (F, P) of duplicate detections to zero, the less confident of two each.

    Two detections are duplicates if they share enough points and half of these coincide.
    """
    out = confidence.copy()
    frames, count = confidence.shape
    points = np.where((record.confidence[:frames] > 0.1)[..., None], record.points[:frames], np.nan)
    height = _boxes(record)[:frames, :, 3]
    for a in range(count):
        for b in range(a + 1, count):
            both = np.flatnonzero((confidence[:, a] > 0) & (confidence[:, b] > 0))
            if both.size:
                off = np.linalg.norm(points[both, a] - points[both, b], axis=-1)
                near = np.sum(off < _MAX_COPY_SHIFT * np.maximum(height[both, a], height[both, b])[:, None], axis=1)
                duplicate = both[near >= np.maximum(_MIN_SHARED_POINTS, _MIN_NEAR_SHARE * np.isfinite(off).sum(axis=1))]
                weaker = np.where(confidence[duplicate, a] < confidence[duplicate, b], a, b)
                out[duplicate, weaker] = 0.0
    return out


def _boxes(record: Keypoints, head: bool = False) -> NDArray:
    """(F, P, 4) [px] centre, width and height of the box around each detection or its head; NaN without points.

    The centre of the box is independent of how many points a detector has in face or hands.
    """
    visible = np.isfinite(record.points).all(axis=-1) & (record.confidence > 0.1)
    if head:
        visible = visible & [any(word in name.lower() for word in _HEAD_WORDS) for name in record.names]
    uv = np.where(visible[..., None], record.points, np.nan)
    out = np.full((*uv.shape[:2], 4), np.nan)
    has_points = visible.any(axis=2)
    low, high = np.nanmin(uv[has_points], axis=1), np.nanmax(uv[has_points], axis=1)
    out[has_points] = np.concatenate([(low + high) / 2.0, high - low], axis=1)
    return out


def assign(cost: ArrayLike, most: float = np.inf) -> list[tuple[int, int]]:
    """Assign rows to columns: pairs (row, column) that maximise Σ (most − cost), each with a cost below `most`.

    Every row and every column is in one pair at most. With `most` infinite, there are as many pairs as finite costs
    allow. Solved by `scipy.optimize.linear_sum_assignment` (Crouse 2016), in O(n³).

    Parameters
    ----------
    cost : (R, C), infinite where a pair is impossible
    most : cost of leaving a row and a column unassigned, in the unit of `cost`

    Raises
    ------
    ObservationError
        NaN among the costs, or no matrix.
    """
    cost = np.asarray(cost, float)
    if cost.ndim != 2 or np.isnan(cost).any():
        problem = f"costs of shape {cost.shape}" + (", some NaN" if np.isnan(cost).any() else "")
        raise ObservationError(problem, remedy="Give a matrix; infinity where a pair is impossible.")
    from scipy.optimize import linear_sum_assignment  # half a second, for those who follow several people

    allowed = np.isfinite(cost) & (cost < most)
    if not allowed.any():
        return []
    spread = float(np.ptp(cost[allowed])) + 1.0
    unassigned = most if np.isfinite(most) else float(cost[allowed].max()) + (min(cost.shape) + 1) * spread
    pairs = zip(*linear_sum_assignment(np.where(allowed, cost - unassigned, 0.0)))
    return [(int(r), int(c)) for r, c in pairs if allowed[r, c]]
