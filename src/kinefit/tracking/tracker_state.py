"""What a tracker has learnt so far: all that another one, made anew of the same body and sensors, goes on from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from kinefit._records import restore_state, save_state
from kinefit.errors import FileError
from kinefit.tracking.tracker import Tracker


def save_tracker(tracker: Tracker) -> dict[str, Any]:
    """The state of a tracker between two steps, without images: plain values, arrays and records of `record_classes`.

    The last result is not part of it: an update that comes too late right after a restored state returns None.
    """
    return {
        "tracker": save_state(tracker), "prediction": save_state(tracker._prediction),
        "recovery": save_state(tracker._recovery), "sensors": tracker.sensors.save_state(),
    }  # fmt: skip


def restore_tracker(tracker: Tracker, state: Mapping[str, Any]) -> None:
    """Set a tracker, made anew, to the state of another of the same body and sensors.

    Raises
    ------
    FileError
        What is no state of such a tracker.
    """
    try:
        restore_state(tracker, state["tracker"])
        restore_state(tracker._prediction, state["prediction"])
        restore_state(tracker._recovery, state["recovery"])
        tracker.sensors.restore_state(state["sensors"])
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        remedy = "Run again: every frame is then computed anew."
        raise FileError("a state of a tracker that kinefit did not write", remedy=remedy) from error
