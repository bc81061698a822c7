"""Time of a frame of the tracker: of each frame the least of some rounds, of those the median."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import timed
from kinefit.bodies import Body, BodyState
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig


class Rounds(NamedTuple):
    """Processor's time [ms] of a frame, mean error [deg] of a joint, and the body's quality in the last frame."""

    ms: float
    degrees: float
    quality: float


def tracked_rounds(
    body: Body, rig: Rig, truth: Sequence[BodyState], seen: Sequence[Sequence[Any]], *, rate: float, rounds: int,
    warm: int, empty: Sequence[NDArray] = (),
) -> Rounds:  # fmt: skip
    """Track what sensors saw of known states, so many rounds from the first state on.

    Parameters
    ----------
    warm : first frames, whose time does not count
    empty : (H, W) [m] what each depth camera saw before
    """
    spent, off = [], []
    for _ in range(rounds):
        tracker, times = Tracker(body, rig, rate=rate, up="y"), list[float]()
        for camera, image in zip(rig, empty):
            tracker.know_background(camera.name, image)
        tracker.start_at(truth[0])
        for state, frames in zip(truth, seen):
            with timed(times, 1e3):
                result = tracker.update(frames)
            assert result is not None
            off.append(np.degrees(np.abs(result.state.angles - state.angles)).mean())
        spent.append(times)
    return Rounds(float(np.median(np.min(spent, axis=0)[warm:])), float(np.mean(off)), result.quality)
