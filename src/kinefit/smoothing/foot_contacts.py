"""Feet on the floor: points of the soles that stay low and hardly move, where they rest, and when they leave."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.findings import runs_of
from kinefit.motion import UP_AXES

_SOLE = 0.04  # [m] above the lowest landmark of the body at rest, up to which one counts as of a sole
_SLOW = 0.15  # [m/s]: a foot that swings reaches several m/s; one that stands seems to move by its noise
_LETS_GO = 0.30  # [m/s] at which a point that rested leaves: of 1 to 6 times `_SLOW`, in simulated jumps,
# all from 1.5 on end a foot's flicker, and none holds it in flight (seeds 0 to 2, `benchmarks.closures_contacts`)
_LOW = 0.04  # [m] above where the point rests: a foot that is lifted to step clears more within few frames
_LEAST = 0.1  # [s] that a contact lasts at least; the shortest stance of a sprinter
_GIVES = 0.01  # [m] that a resting point still moves, one standard deviation: soles and skin give


@dataclass(frozen=True, eq=False)
class Contacts:
    """Points of the body that rest at times.

    Parameters
    ----------
    points : PointSet of P points.
    places : (F, P, 3) [m] where they rest.
    weight : (F, P) [1/m²], 0 where they do not.
    """

    points: PointSet
    places: NDArray
    weight: NDArray

    def part(self, frames: slice) -> Contacts:
        """Those of a stretch of frames."""
        return replace(self, places=self.places[frames], weight=self.weight[frames])


def soles(body: Body) -> PointSet:
    """Landmarks of the body that are lowest when it stands at rest (y up)."""
    points = body.landmarks
    height = body.points_rest(points)[:, 1]
    low = np.flatnonzero(height < height.min(initial=np.inf) + _SOLE)
    return points.select(tuple(points.names[i] for i in low))


def find_contacts(
    body: Body, roots: NDArray, angles: NDArray, rate: float, up: str, eye: NDArray | None = None
) -> Contacts:
    """Contacts of the soles with a level floor in a smoothed motion.

    Contacts switch with hysteresis: a point must be slow for a while to rest, and twice as fast to leave.

    The floor's height is taken for each point on its own, since its place on the sole is not known to the centimetre:
    the median of those of its slow frames that are near the lowest. One camera alone tells neither height nor speed
    towards it: what counts there is that a point hardly moves across its ray, and it rests where it seems to be.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad]
    rate : float [Hz]
    up : vertical axis of the world.
    eye : (3,) [m] of a camera that is the only sensor
    """
    points, axis = soles(body), np.array(UP_AXES[up])
    x = body.trajectories(roots, angles, points)
    speed = _speeds(x, rate, eye)
    height = x @ axis
    places, weight = np.zeros(x.shape), np.zeros(x.shape[:2])
    for p in range(len(points)):
        slow = speed[:, p] < _SLOW
        if slow.sum() < _LEAST * rate:
            continue
        floor, near = None, np.ones(len(x), bool)
        if eye is None:
            lowest = np.quantile(height[slow, p], 0.1)
            floor = float(np.median(height[slow & (height[:, p] < lowest + _LOW), p]))
            near = np.abs(height[:, p] - floor) < _LOW
        for start, stop in runs_of((speed[:, p] < _LETS_GO) & near):
            run = slice(start, stop)
            if np.count_nonzero(slow[run]) < _LEAST * rate:
                continue
            middle = np.median(x[run, p], axis=0)
            places[run, p] = middle if floor is None else middle + (floor - middle @ axis) * axis
            weight[run, p] = _GIVES**-2
    return Contacts(points, places, weight)


def _speeds(x: NDArray, rate: float, eye: NDArray | None) -> NDArray:
    """(F, P) [m/s] of points x (F, P, 3); across their rays from an eye (3,), where there is one."""
    if len(x) < 2:
        return np.full(x.shape[:2], np.inf)
    moved = np.gradient(x, axis=0)
    if eye is not None:
        ray = (x - eye) / np.linalg.norm(x - eye, axis=2, keepdims=True)
        moved = moved - np.sum(moved * ray, axis=2, keepdims=True) * ray
    return np.asarray(np.linalg.norm(moved, axis=2) * rate)


