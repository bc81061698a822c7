"""People in one camera's view: identities from the detector's tracks, positions from their assumed size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.triangulation import placed
from kinefit.multiview.association import confidences
from kinefit.multiview.medians import heights, medians
from kinefit.multiview.people import SPEED_INTERVAL_S, PersonTrack, min_person_frames
from kinefit.observations import Keypoints


def only_lifted(keypoints: Sequence[Keypoints]) -> Keypoints | None:
    """The keypoints lifted to space by a network, if there is only one camera; None otherwise."""
    of_one = len({k.camera for k in keypoints}) == 1
    return next((k for k in keypoints if k.lifted is not None), None) if of_one else None


def people_of_one_camera(rig: Rig, keypoints: Sequence[Keypoints], record: Keypoints) -> list[PersonTrack]:
    """People visible for a second in one camera, in order of decreasing confidence.

    Each column of the record is a person, as tracked by the built-in detector. Positions hold for people of the size
    that the network assumes.

    Parameters
    ----------
    keypoints : records of the camera
    record : the lifted one of them
    """
    frames = len(record)
    confidence, people = confidences(record, frames), []
    for column in range(record.points.shape[1]):
        visible = confidence[:, column] > 0
        if visible.sum() < max(min_person_frames(record.rate, frames), 1):
            continue
        chosen = np.where(visible, column, -1)
        x = _points_world(rig[record.camera], record, column)
        speed, size = _speed(x, record.rate), np.nanmean(heights(record.points[visible, column]))
        place = np.nanmedian(np.nanmean(x[visible], axis=1), axis=0)
        choices = tuple(chosen if k is record else np.full(frames, -1) for k in keypoints)
        total = float(confidence[:, column].sum())
        people.append(PersonTrack(choices, visible.astype(int), total, speed, float(size), place))
    return sorted(people, key=lambda one: -one.confidence)


def _points_world(camera: Camera, record: Keypoints, column: int) -> NDArray:
    """(F, K, 3) [m] points of one person in the world frame."""
    assert record.lifted is not None
    return placed(camera, record.lifted[:, column], record.points[:, column])


def _speed(x: NDArray, rate: float) -> float:
    """[m/s] speed of points (F, K, 3) [m]: mean over time of their median; 0 if visible too briefly."""
    interval = max(round(SPEED_INTERVAL_S * rate), 1)
    moved = np.linalg.norm(x[interval:] - x[:-interval], axis=2)
    middles = medians(moved)
    known = np.isfinite(middles)
    return float(middles[known].mean() * rate / interval) if known.any() else 0.0
