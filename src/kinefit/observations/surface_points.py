"""Tracked points of a surface: one frame, and a whole recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.observations.arrays import check_seen, numbers
from kinefit.observations.depth import _Recording, checked_times


@dataclass(frozen=True, eq=False)
class SurfacePointFrame:
    """Tracked points of a surface at one time, from `photogrammetry.surface_tracking.SurfaceTracker.update`.

    Parameters
    ----------
    sensor, time : name of the sensor, and [s]
    ids : (N,) int, the same for the same point at all times
    x_world : (N, 3) [m]; NaN for missing points, which are dropped
    covariance : (N, 3, 3) [m²]

    Raises
    ------
    ObservationError
        Arrays of other shapes, or a point twice.
    """

    sensor: str
    time: float
    ids: NDArray
    x_world: NDArray
    covariance: NDArray

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time)
        ids, x, c = numbers(self.ids, None), numbers(self.x_world), numbers(self.covariance)
        if ids.ndim != 1 or x.shape != (len(ids), 3) or c.shape != (len(ids), 3, 3) or ids.dtype.kind not in "iu":
            problem = f"{ids.dtype} ids {ids.shape}, points {x.shape}, covariances {c.shape} of {self.sensor}"
            raise ObservationError(problem, remedy="Give whole numbers (N,), (N, 3) and (N, 3, 3).")
        if len(np.unique(ids)) < len(ids):
            raise ObservationError(f"a point of {self.sensor} twice", remedy="Give every point its own number.")
        known = np.isfinite(x).all(axis=1) & np.isfinite(c).all(axis=(1, 2))
        for name, value in (("ids", ids[known]), ("x_world", x[known]), ("covariance", c[known])):
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class SurfacePointVideo(_Recording):
    """Tracked points of a surface over time.

    Parameters
    ----------
    sensor : str
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    first : (F + 1,) int
        Start of each frame in the columns below, and their length.
    ids : (N,) int, the same for the same point at all times
    x_world : (N, 3) [m]
    std : (N, 3) [m] standard deviations along the world's axes
    source : str
        File, for messages.

    Raises
    ------
    ObservationError
        Times that do not increase; columns of different lengths.
    """

    first: NDArray
    ids: NDArray
    x_world: NDArray
    std: NDArray
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times(self.times, self.sensor, self.source))
        lengths = {len(self.ids), len(self.x_world), len(self.std), int(self.first[-1]) if len(self.first) else -1}
        if len(lengths) > 1 or len(self.first) != len(self.times) + 1:
            problem = f"columns of {sorted(lengths)} points, {len(self.first)} starts of {len(self.times)} frames"
            remedy = "Give every point its position and standard deviation."
            raise ObservationError(problem, file=self.source or None, remedy=remedy)

    def frame(self, i: int) -> SurfacePointFrame:
        """Frame number `i`; a negative number counts from the end."""
        i = range(len(self))[i]
        part = slice(int(self.first[i]), int(self.first[i + 1]))
        covariance = self.std[part, :, None] ** 2 * np.eye(3)
        return SurfacePointFrame(self.sensor, float(self.times[i]), self.ids[part], self.x_world[part], covariance)
