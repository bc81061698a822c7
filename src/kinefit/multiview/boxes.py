"""Detections of one person in one picture: those of two detectors, by their boxes, and two of the same detector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.observations import MEDIAPIPE_478, Keypoints
from kinefit.solvers.assignment import assign

_BOX = 0.3  # boxes that two detectors give one person differ by less, as a share of their height
_HEAD = ("nose", "eye", "ear", "mouth", "face")  # in names of points, in any spelling, of which a face mesh has likes
_HEAD_BOX = 0.5  # boxes of a face mesh and of another detector's points of the head differ by less, in their size
_DOUBLE = 0.03  # points of two detections of one person differ by less, as a share of the height: detectors' noise
_SHARED = 4  # points that both have, at the least
_MOST = 0.5  # of them that must be so near


def same_people(people: Sequence[NDArray], theirs: Keypoints, mine: Keypoints) -> list[NDArray]:
    """(F,) for each of several people which of one record's detections they are, as known of another record.

    Parameters
    ----------
    people : (F,) each, which of the other record's detections they are; -1 for none
    theirs, mine : records of one camera; where one is a face mesh, the other's head is compared with it
    """
    heads = MEDIAPIPE_478 in (theirs.names, mine.names)
    a, b, most = _boxes(theirs, heads), _boxes(mine, heads), _HEAD_BOX if heads else _BOX
    out = [np.full(len(one), -1) for one in people]
    for f in range(min(len(a), len(b))):
        cost = np.full((len(people), b.shape[1]), np.inf)
        for i, one in enumerate(people):
            if one[f] >= 0:
                size = np.maximum(a[f, one[f], 2:].max(), b[f, :, 2:].max(axis=1)) if heads else a[f, one[f], 3]
                off = np.linalg.norm(b[f, :, :2] - a[f, one[f], :2], axis=1) / np.maximum(size, 1.0)
                cost[i] = np.where(np.isfinite(off), off, np.inf)
        for i, p in assign(cost, most):
            out[i][f] = p
    return out


def once(record: Keypoints, surety: NDArray) -> NDArray:
    """(F, P) how sure each detection is, as given, and 0 for the less sure of two detections of one person.

    They are of one person where they share points enough, half of which lie on their likes.
    """
    out = surety.copy()
    frames, count = surety.shape
    points = np.where((record.confidence[:frames] > 0.1)[..., None], record.points[:frames], np.nan)
    height = _boxes(record)[:frames, :, 3]
    for a in range(count):
        for b in range(a + 1, count):
            both = np.flatnonzero((surety[:, a] > 0) & (surety[:, b] > 0))
            if both.size:
                off = np.linalg.norm(points[both, a] - points[both, b], axis=-1)
                near = np.sum(off < _DOUBLE * np.maximum(height[both, a], height[both, b])[:, None], axis=1)
                double = both[near >= np.maximum(_SHARED, _MOST * np.isfinite(off).sum(axis=1))]
                less = np.where(surety[double, a] < surety[double, b], a, b)
                out[double, less] = 0.0
    return out


def _boxes(record: Keypoints, head: bool = False) -> NDArray:
    """(F, P, 4) [px] middle, width and height of the box about each person's points, or its head's; NaN for nothing.

    Not about their mean: detectors have more points in the face, in the hands or in neither.
    """
    seen = np.isfinite(record.points).all(axis=-1) & (record.confidence > 0.1)
    if head:
        seen = seen & [any(word in name.lower() for word in _HEAD) for name in record.names]
    uv = np.where(seen[..., None], record.points, np.nan)
    out = np.full((*uv.shape[:2], 4), np.nan)
    some = seen.any(axis=2)
    low, high = np.nanmin(uv[some], axis=1), np.nanmax(uv[some], axis=1)
    out[some] = np.concatenate([(low + high) / 2.0, high - low], axis=1)
    return out
