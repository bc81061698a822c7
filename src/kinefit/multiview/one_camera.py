"""People before one camera, told apart by the detector that followed each of them, and placed by their size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lifting import placed
from kinefit.multiview.association import surety_of
from kinefit.multiview.people import STEP, PersonTrack, lasting
from kinefit.observations import Keypoints


def lifted_alone(keypoints: Sequence[Keypoints]) -> Keypoints | None:
    """The keypoints that a network lifted to space, where no other camera has any; None where there are none."""
    of_one = len({k.camera for k in keypoints}) == 1
    return next((k for k in keypoints if k.lifted is not None), None) if of_one else None


def people_before(rig: Rig, keypoints: Sequence[Keypoints], record: Keypoints) -> list[PersonTrack]:
    """Everybody whom one camera sees for a second, the one of whom most is seen first.

    Each column of the record is a person: the built-in detector keeps them apart. Places are those of people of the
    size that the network takes for granted.

    Parameters
    ----------
    keypoints : of the camera
    record : the lifted one of them
    """
    frames = len(record)
    surety, people = surety_of(record, frames), []
    for column in range(record.points.shape[1]):
        seen = surety[:, column] > 0
        if seen.sum() < max(lasting(record.rate, frames), 1):
            continue
        chosen = np.where(seen, column, -1)
        x = _places(rig[record.camera], record, column)
        speed, size = _speed(x, record.rate), np.nanmean(np.ptp(record.points[seen, column, :, 1], axis=1))
        place = np.nanmedian(x[seen].mean(axis=1), axis=0)
        each = tuple(chosen if k is record else np.full(frames, -1) for k in keypoints)
        people.append(PersonTrack(each, seen.astype(int), float(surety[:, column].sum()), speed, float(size), place))
    return sorted(people, key=lambda one: -one.surety)


def _places(camera: Camera, record: Keypoints, column: int) -> NDArray:
    """(F, K, 3) [m] points of one person in the world."""
    assert record.lifted is not None
    return placed(camera, record.lifted[:, column], record.points[:, column])


def _speed(x: NDArray, rate: float) -> float:
    """[m/s] of points (F, K, 3), the mean over time of their median; 0 where they are seen too briefly."""
    apart = max(round(STEP * rate), 1)
    moved = np.linalg.norm(x[apart:] - x[:-apart], axis=2)
    told = moved[np.isfinite(moved).all(axis=1)]
    return float(np.median(told, axis=1).mean() * rate / apart) if len(told) else 0.0
