"""Find foot contacts: points of the soles that are low and slow, their places, and when contact starts and ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.findings import runs_of
from kinefit.motion import UP_AXES

_SOLE_HEIGHT = 0.04  # [m] above the lowest landmark of the rest pose, below which a landmark belongs to a sole
_MAX_CONTACT_SPEED = 0.15  # [m/s]: a swinging foot reaches several m/s; a standing one seems to move by its noise
_MIN_RELEASE_SPEED = 0.30  # [m/s] that ends a contact: of 1 to 6 times `_MAX_CONTACT_SPEED`, in simulated jumps, all
# from 1.5 on end flicker, and none extends contact into flight (seeds 0 to 2, `benchmarks.closures_contacts`)
_MAX_CONTACT_HEIGHT = 0.04  # [m] above the point's contact height: a foot lifted to step exceeds it within few frames
_MIN_CONTACT_S = 0.1  # [s]: the shortest stance of a sprinter
_CONTACT_STD = 0.01  # [m] of a point in contact: soles and skin deform


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of points of the body with the floor.

    Parameters
    ----------
    points : PointSet of P points
    places : (F, P, 3) [m] of the contacts, in the world
    weight : (F, P) [1/m²], 0 without contact
    """

    points: PointSet
    places: NDArray
    weight: NDArray

    def part(self, frames: slice) -> Contacts:
        """The contacts of some frames."""
        return replace(self, places=self.places[frames], weight=self.weight[frames])


def soles(body: Body) -> PointSet:
    """Landmarks of the soles: the lowest ones of the rest pose (y up)."""
    points = body.landmarks
    height = body.points_rest(points)[:, 1]
    low = np.flatnonzero(height < height.min(initial=np.inf) + _SOLE_HEIGHT)
    return points.select(tuple(points.names[i] for i in low))


def find_contacts(
    body: Body, roots: NDArray, angles: NDArray, rate: float, up: str, eye: NDArray | None = None
) -> Contacts:
    """Find contacts of the soles with a level floor in a smoothed motion.

    Contacts have hysteresis: a point must be slow for a while to start one, and twice as fast to end it.

    The floor's height is estimated for each point, since its place on the sole is not known to the centimetre: the
    median over its slow frames near the lowest one. One camera alone observes neither height nor depth speed. There a
    point is in contact if it hardly moves across its ray, and its place is where it seems to be.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad]
    rate : float [Hz]
    up : vertical axis of the world
    eye : (3,) [m] centre of the camera, if it is the only sensor
    """
    points, axis = soles(body), np.array(UP_AXES[up])
    x = body.trajectories(roots, angles, points)
    speed = _speeds(x, rate, eye)
    height = x @ axis
    places, weight = np.zeros(x.shape), np.zeros(x.shape[:2])
    for p in range(len(points)):
        slow = speed[:, p] < _MAX_CONTACT_SPEED
        if slow.sum() < _MIN_CONTACT_S * rate:
            continue
        floor, near = None, np.ones(len(x), bool)
        if eye is None:
            lowest = np.quantile(height[slow, p], 0.1)
            floor = float(np.median(height[slow & (height[:, p] < lowest + _MAX_CONTACT_HEIGHT), p]))
            near = np.abs(height[:, p] - floor) < _MAX_CONTACT_HEIGHT
        for start, stop in runs_of((speed[:, p] < _MIN_RELEASE_SPEED) & near):
            run = slice(start, stop)
            if np.count_nonzero(slow[run]) < _MIN_CONTACT_S * rate:
                continue
            middle = np.median(x[run, p], axis=0)
            places[run, p] = middle if floor is None else middle + (floor - middle @ axis) * axis
            weight[run, p] = _CONTACT_STD**-2
    return Contacts(points, places, weight)


def _speeds(x: NDArray, rate: float, eye: NDArray | None) -> NDArray:
    """(F, P) [m/s] speed of points x (F, P, 3); across their rays if an eye (3,) is given."""
    if len(x) < 2:
        return np.full(x.shape[:2], np.inf)
    moved = np.gradient(x, axis=0)
    if eye is not None:
        ray = (x - eye) / np.linalg.norm(x - eye, axis=2, keepdims=True)
        moved = moved - np.sum(moved * ray, axis=2, keepdims=True) * ray
    return np.asarray(np.linalg.norm(moved, axis=2) * rate)


