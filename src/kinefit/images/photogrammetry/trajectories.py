"""Trajectories of surface points: velocity, acceleration, and filters against implausible motion.

The filters are those of D'Apuzzo et al. (1999), section 2.4.2: bounds on velocity and acceleration, and uniformity of
the velocity in a small region of space and time. `filtered` applies both. Optionally it applies the neighbourhood
heuristics that the paper names as its next step: it repeats the second filter and removes isolated points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError

_OUTLIER_SIGMAS = 5.0  # robust standard deviations of a velocity from its neighbourhood
_MIN_NEIGHBOURS = 3
_BATCH_SIZE = 256  # points per neighbourhood search
_MAX_ROUNDS = 10  # of the second filter: removed paths change the neighbourhoods of others


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Trajectories of P surface points over F frames.

    Parameters
    ----------
    times : (F,) [s]
    x_world : (F, P, 3) [m]; NaN where a point is missing
    std : (F, P, 3) [m] standard deviations along the world's axes
    uv : (F, P, C, 2) [px]
    """

    times: NDArray
    x_world: NDArray
    std: NDArray
    uv: NDArray

    @property
    def live(self) -> NDArray[np.bool_]:
        """(F, P) which points exist in which frame."""
        return np.isfinite(self.x_world).all(axis=2)

    @property
    def velocity(self) -> NDArray:
        """(F, P, 3) [m/s] by central differences; one-sided at the ends of a path, NaN for single points."""
        x, t = self.x_world, self.times[:, None, None]
        step = np.full_like(x, np.nan)
        step[:-1] = np.diff(x, axis=0) / np.diff(t, axis=0)
        back = np.full_like(x, np.nan)
        back[1:] = step[:-1]
        step, back = np.where(np.isfinite(step), step, back), np.where(np.isfinite(back), back, step)
        return 0.5 * (step + back)

    @property
    def acceleration(self) -> NDArray:
        """(F, P, 3) [m/s²] by second differences; NaN at the ends of a path."""
        x, t = self.x_world, self.times
        out = np.full_like(x, np.nan)
        if len(t) > 2:
            step = np.diff(x, axis=0) / np.diff(t)[:, None, None]
            out[1:-1] = np.diff(step, axis=0) / (0.5 * (t[2:] - t[:-2]))[:, None, None]
        return out

    def kept(self, keep: NDArray[np.bool_], shortest: int = 3) -> Trajectories:
        """Cut paths at their first point outside `keep` (F, P), and remove those with fewer than `shortest` points."""
        live = self.live
        good = live & ~np.logical_or.accumulate(live & ~keep, axis=0)
        good &= good.sum(axis=0) >= shortest
        cut = ~good
        x, std, uv = self.x_world.copy(), self.std.copy(), self.uv.copy()
        x[cut], std[cut], uv[cut] = np.nan, np.nan, np.nan
        return replace(self, x_world=x, std=std, uv=uv)


def within_bounds(paths: Trajectories, *, speed: float, acceleration: float) -> NDArray[np.bool_]:
    """(F, P) which points have a speed [m/s] and acceleration [m/s²] within bounds: the first filter.

    Raises
    ------
    ObservationError
        A bound is not positive.
    """
    if not (speed > 0 and acceleration > 0):
        raise ObservationError(f"bounds {speed} m/s, {acceleration} m/s²", remedy="Give positive bounds.")
    fast = np.linalg.norm(paths.velocity, axis=2) > speed
    harsh = np.linalg.norm(paths.acceleration, axis=2) > acceleration
    return paths.live & ~fast & ~harsh


def uniform(paths: Trajectories, *, radius: float, frames: int = 1, limit: float | None = None) -> NDArray[np.bool_]:
    """(F, P) which velocities are near the median of their neighbourhood: the second filter.

    Parameters
    ----------
    radius : [m] of the neighbourhood
    frames : number of frames before and after that belong to it
    limit : [m/s] of the difference; default: five robust standard deviations of all differences
    """
    off = _velocity_deviations(paths, radius, frames)
    return paths.live & ~(off > (_outlier_limit(off) if limit is None else limit))


def _outlier_limit(off: NDArray) -> float:
    """[m/s] five robust standard deviations of differences."""
    known = off[np.isfinite(off)]
    return float(_OUTLIER_SIGMAS * 1.4826 * np.median(known)) if len(known) else np.inf


def _velocity_deviations(paths: Trajectories, radius: float, frames: int) -> NDArray:
    """(F, P) [m/s] deviation of each velocity from the median of its neighbours; NaN with fewer than three."""
    velocity, live = paths.velocity, paths.live
    deviations = np.full(live.shape, np.nan)
    for k in range(len(live)):
        moving = np.flatnonzero(live[k] & np.isfinite(velocity[k]).all(axis=1))
        span = range(max(0, k - frames), min(len(live), k + frames + 1))
        neighbourhood = [(paths.x_world[j], velocity[j]) for j in span]
        places = np.concatenate([x for x, _ in neighbourhood])
        speeds = np.concatenate([v for _, v in neighbourhood])
        names = np.tile(np.arange(live.shape[1]), len(neighbourhood))
        good = np.isfinite(speeds).all(axis=1)
        places, speeds, names = places[good], speeds[good], names[good]
        for p, near in _neighbours(paths.x_world[k], moving, places, radius):
            near = near[names[near] != p]
            if len(near) >= _MIN_NEIGHBOURS:
                deviations[k, p] = np.linalg.norm(velocity[k, p] - _median(speeds[near]))
    return deviations


def _neighbours(x_world: NDArray, chosen: NDArray, places: NDArray, radius: float) -> Iterator[tuple[int, NDArray]]:
    """Yield each chosen point of (P, 3) [m] with the indices of the places (N, 3) in a box around it."""
    for part in np.split(chosen, range(_BATCH_SIZE, len(chosen), _BATCH_SIZE)):
        is_near = np.ones((len(part), len(places)), bool)
        for axis in range(3):
            is_near &= np.abs(places[None, :, axis] - x_world[part, None, axis]) <= radius
        for p, row in zip(part, is_near):
            yield int(p), np.flatnonzero(row)


def _median(values: NDArray) -> NDArray:
    """(3,) medians of (N, 3), five times as fast as `np.median` for few rows."""
    ordered, middle = np.sort(values, axis=0), len(values) // 2
    return np.asarray(0.5 * (ordered[middle] + ordered[(len(values) - 1) // 2]))


def has_neighbours(paths: Trajectories, *, radius: float) -> NDArray[np.bool_]:
    """(F, P) which points have three or more neighbours within a radius [m] in the same frame."""
    live = paths.live
    out = np.zeros_like(live)
    for k in range(len(live)):
        index = np.flatnonzero(live[k])
        for p, near in _neighbours(paths.x_world[k], index, paths.x_world[k, index], radius):
            out[k, p] = len(near) > _MIN_NEIGHBOURS  # itself among them
    return out


def filtered(
    paths: Trajectories, *, radius: float, bounds: tuple[float, float] | None = None, neighbours: bool = False,
    uniformity: bool = True,
) -> tuple[Trajectories, dict[str, int]]:  # fmt: skip
    """Filter paths; returns them and the number of points that each filter removed.

    Parameters
    ----------
    radius : [m] of the neighbourhood
    bounds : of speed [m/s] and acceleration [m/s²]; None: without the first filter
    neighbours : whether to repeat the second filter with the limit of the first round until it removes none, and then
        remove points without neighbours; limbs with few points are lost
    uniformity : whether to apply the second filter at all

    Raises
    ------
    ObservationError
        A bound is not positive.
    """
    counts, kept = {"short paths": 0, "bounds": 0, "uniformity": 0, "neighbours": 0}, paths

    def cut(name: str, good: NDArray[np.bool_]) -> bool:
        nonlocal kept
        before, kept = int(kept.live.sum()), kept.kept(good)
        counts[name] += before - int(kept.live.sum())
        return int(kept.live.sum()) < before

    cut("short paths", kept.live)
    if bounds is not None:
        cut("bounds", within_bounds(kept, speed=bounds[0], acceleration=bounds[1]))
    limit = None
    for _ in range(_MAX_ROUNDS if neighbours else int(uniformity)):
        off = _velocity_deviations(kept, radius, 1)
        limit = _outlier_limit(off) if limit is None else limit
        if not cut("uniformity", kept.live & ~(off > limit)):
            break
    if neighbours:
        cut("neighbours", has_neighbours(kept, radius=radius))
    return kept, counts
