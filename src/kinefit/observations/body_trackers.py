"""Trackers fixed on the body, such as magnetic ones: one frame, and a whole recording (P2 2.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.observations.arrays import check_seen, freeze, frozen
from kinefit.observations.depth import _Recording, checked_times


@dataclass(frozen=True, eq=False)
class BodyTrackerFrame:
    """Poses, or places alone, of trackers that are fixed on the body.

    Parameters
    ----------
    sensor, time : name of the system, and [s]
    names : (K,) of the trackers
    x_world : (K, 3) [m] place of each; NaN if missing
    Rs_world_tracker : (K, 3, 3) rotations, whose columns are the tracker's axes in the world; NaN if missing; default:
        all missing

    Raises
    ------
    ObservationError
        Arrays of other shapes.
    """

    sensor: str
    time: float
    names: tuple[str, ...]
    x_world: NDArray
    Rs_world_tracker: NDArray | None = None

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time, self.names)
        what, count = f"trackers of {self.sensor}", len(self.names)
        R = np.full((count, 3, 3), np.nan) if self.Rs_world_tracker is None else self.Rs_world_tracker
        R = frozen(R, float, f"rotations of {what}", (count, 3, 3))
        freeze(self, x_world=frozen(self.x_world, float, what, (count, 3)), Rs_world_tracker=R)


@dataclass(frozen=True, eq=False)
class BodyTrackerVideo(_Recording):
    """Trackers on the body over time.

    Parameters
    ----------
    sensor : str
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing
    names : (K,) of the trackers
    x_world : (F, K, 3) [m]; NaN if missing
    Rs_world_tracker : (F, K, 3, 3); NaN if missing
    source : file, for messages

    Raises
    ------
    ObservationError
        Times that do not increase; arrays of other shapes.
    """

    names: tuple[str, ...]
    x_world: NDArray
    Rs_world_tracker: NDArray
    source: str = ""

    def __post_init__(self) -> None:
        times, what = checked_times(self.times, self.sensor, self.source), f"trackers of {self.sensor}"
        shape, file = (len(times), len(self.names), 3), self.source or None
        x = frozen(self.x_world, float, what, shape, file)
        R = frozen(self.Rs_world_tracker, float, f"rotations of {what}", (*shape, 3), file)
        freeze(self, times=times, x_world=x, Rs_world_tracker=R)

    def frame(self, i: int) -> BodyTrackerFrame:
        """Frame number `i`; a negative number counts from the end."""
        i = range(len(self))[i]
        R = self.Rs_world_tracker[i]
        return BodyTrackerFrame(self.sensor, float(self.times[i]), self.names, self.x_world[i], R)
