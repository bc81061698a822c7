"""What a force plate measured, in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3

LEAST_LOAD = 20.0
"""[N] on a plate that somebody stands on, as gait laboratories have it; less tells no centre of pressure."""


@dataclass(frozen=True, eq=False)
class ForcePlate:
    """Forces and moments of one plate over time.

    Parameters
    ----------
    name : str
    corners : (4, 3) [m] in the world, in the order of C3D: beyond the centre in +x +y, -x +y, -x -y, +x -y of its axes
    rate : float [Hz]
    first_time : float [s] of the first sample
    force : (N, 3) [N] on who stands on it, along the world's axes
    moment : (N, 3) [N m] on who stands on it, about the centre of the corners
    """

    name: str
    corners: NDArray
    rate: float
    first_time: float
    force: NDArray
    moment: NDArray

    @property
    def times(self) -> NDArray:
        """(N,) [s]."""
        return self.first_time + np.arange(len(self.force)) / self.rate

    @property
    def centre(self) -> NDArray:
        """(3,) [m] of the corners."""
        return np.asarray(self.corners).mean(axis=0)

    @cached_property
    def normal(self) -> NDArray:
        """(3,) unit vector out of the surface: a plate is pushed, never pulled, so large loads count most."""
        axis = np.cross(*self.axes)
        load = self.force @ axis
        return axis if np.sum(load * np.abs(load)) >= 0 else -axis

    @cached_property
    def axes(self) -> NDArray:
        """(2, 3) unit vectors x and y of the plate, as the order of its corners tells them."""
        a, b, c, d = self.corners
        x, y = a + d - b - c, a + b - c - d
        x = x / np.linalg.norm(x)
        y = y - (y @ x) * x
        return np.stack([x, y / np.linalg.norm(y)])

    @cached_property
    def load(self) -> NDArray:
        """(N,) [N] at right angles to the plate, positive where somebody presses on it."""
        return self.force @ self.normal

    def centre_of_pressure(self, least: float = LEAST_LOAD) -> NDArray:
        """(N, 3) [m] in the world, where the force acts, with a moment about the normal alone; NaN below `least`."""
        n, load = self.normal, self.load
        with np.errstate(divide="ignore", invalid="ignore"):
            out = self.centre + np.cross(n, self.moment) / load[:, None]
        return np.where((load >= least)[:, None], out, np.nan)

    def free_moment(self, least: float = LEAST_LOAD) -> NDArray:
        """(N,) [N m] about the normal through the centre of pressure; NaN below `least` [N]."""
        lever = self.centre_of_pressure(least) - self.centre
        return (self.moment - np.cross(lever, self.force)) @ self.normal

    def moved(self, T_new_world: NDArray) -> ForcePlate:
        """The same plate in another world, of pose (4, 4) [m]."""
        R = T_new_world[:3, :3]
        return replace(
            self, corners=se3.apply(T_new_world, self.corners), force=self.force @ R.T, moment=self.moment @ R.T
        )

    def at(self, times: NDArray) -> ForcePlate:
        """The same plate at evenly spaced times (N,) [s], between its samples; without load before and after them."""
        force, moment = (
            np.column_stack([np.interp(times, self.times, column, 0.0, 0.0) for column in values.T])
            for values in (self.force, self.moment)
        )
        rate = (len(times) - 1) / float(times[-1] - times[0]) if len(times) > 1 else self.rate
        return replace(self, rate=rate, first_time=float(times[0]), force=force, moment=moment)

    def shifted(self, seconds: float) -> ForcePlate:
        """The same plate by a clock that is so much ahead [s]."""
        return replace(self, first_time=self.first_time + seconds)


def total_load(plates: Sequence[ForcePlate], times: NDArray) -> NDArray:
    """(N,) [N] on all plates together at some times (N,) [s]."""
    return np.sum([np.interp(times, plate.times, plate.load, 0.0, 0.0) for plate in plates], axis=0)
