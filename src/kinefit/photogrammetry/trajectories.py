"""Paths of surface points: velocity and acceleration, and filters that truncate what is no motion of a surface.

The filters are those of D'Apuzzo et al. (1999), section 2.4.2: bounds on velocity and acceleration, and uniformity of
the velocity in a small region of space and time. `filtered` applies both, and on demand the neighbourhood heuristics
that the paper names as its next step: paths that were cut no longer judge their neighbours, and lone points go.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError

_OUTLYING = 5.0  # robust deviations of a velocity from its surroundings
_LEAST_NEIGHBOURS = 3
_TOGETHER = 256  # points whose surroundings are sought at once
_MAX_ROUNDS = 10  # of the second filter: each may cut what the paths cut before had made look uniform


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Points of a surface over time.

    Parameters
    ----------
    times : (F,) [s]
    x_world : (F, P, 3) [m]; NaN where a point is not there
    std : (F, P, 3) [m] standard deviations along the world's axes
    uv : (F, P, C, 2) [px]
    """

    times: NDArray
    x_world: NDArray
    std: NDArray
    uv: NDArray

    @property
    def live(self) -> NDArray[np.bool_]:
        """(F, P) which points are there when."""
        return np.isfinite(self.x_world).all(axis=2)

    @property
    def velocity(self) -> NDArray:
        """(F, P, 3) [m/s] by central differences; one-sided at the ends of a path, NaN of single points."""
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
        """Paths cut at their first place that is not kept (F, P), and removed where fewer than `shortest` are left."""
        live = self.live
        good = live & ~np.logical_or.accumulate(live & ~keep, axis=0)
        good &= good.sum(axis=0) >= shortest
        cut = ~good
        x, std, uv = self.x_world.copy(), self.std.copy(), self.uv.copy()
        x[cut], std[cut], uv[cut] = np.nan, np.nan, np.nan
        return replace(self, x_world=x, std=std, uv=uv)


def within_bounds(paths: Trajectories, *, speed: float, acceleration: float) -> NDArray[np.bool_]:
    """(F, P) where speed [m/s] and acceleration [m/s²] are within bounds: the first filter.

    Raises
    ------
    ObservationError
        A bound that is not positive.
    """
    if not (speed > 0 and acceleration > 0):
        raise ObservationError(f"bounds {speed} m/s, {acceleration} m/s²", remedy="Give positive ones.")
    fast = np.linalg.norm(paths.velocity, axis=2) > speed
    harsh = np.linalg.norm(paths.acceleration, axis=2) > acceleration
    return paths.live & ~fast & ~harsh


def uniform(paths: Trajectories, *, radius: float, frames: int = 1, limit: float | None = None) -> NDArray[np.bool_]:
    """(F, P) where the velocity is near the median of its surroundings in space and time: the second filter.

    Parameters
    ----------
    radius : [m] of the surroundings; `frames` before and after belong to them
    limit : [m/s] of the difference; default: five robust deviations of all differences
    """
    off = _differences(paths, radius, frames)
    return paths.live & ~(off > (_limit(off) if limit is None else limit))


def _limit(off: NDArray) -> float:
    """[m/s] five robust deviations of differences."""
    known = off[np.isfinite(off)]
    return float(_OUTLYING * 1.4826 * np.median(known)) if len(known) else np.inf


def _differences(paths: Trajectories, radius: float, frames: int) -> NDArray:
    """(F, P) [m/s] of each velocity to the median of its surroundings; NaN where they are fewer than three."""
    velocity, live = paths.velocity, paths.live
    off = np.full(live.shape, np.nan)
    for k in range(len(live)):
        own = np.flatnonzero(live[k] & np.isfinite(velocity[k]).all(axis=1))
        span = range(max(0, k - frames), min(len(live), k + frames + 1))
        around = [(paths.x_world[j], velocity[j]) for j in span]
        places = np.concatenate([x for x, _ in around])
        speeds = np.concatenate([v for _, v in around])
        names = np.tile(np.arange(live.shape[1]), len(around))
        good = np.isfinite(speeds).all(axis=1)
        places, speeds, names = places[good], speeds[good], names[good]
        for p, near in _near(paths.x_world[k], own, places, radius):
            near = near[names[near] != p]
            if len(near) >= _LEAST_NEIGHBOURS:
                off[k, p] = np.linalg.norm(velocity[k, p] - _median(speeds[near]))
    return off


def _near(x_world: NDArray, chosen: NDArray, places: NDArray, radius: float) -> Iterator[tuple[int, NDArray]]:
    """Chosen points of (P, 3) [m], each with the indices of the places (N, 3) in a box of a radius about it."""
    for part in np.split(chosen, range(_TOGETHER, len(chosen), _TOGETHER)):
        beside = np.ones((len(part), len(places)), bool)
        for axis in range(3):
            beside &= np.abs(places[None, :, axis] - x_world[part, None, axis]) <= radius
        for p, row in zip(part, beside):
            yield int(p), np.flatnonzero(row)


def _median(values: NDArray) -> NDArray:
    """(3,) medians of (N, 3); `np.median` takes five times as long for so few."""
    ordered, middle = np.sort(values, axis=0), len(values) // 2
    return np.asarray(0.5 * (ordered[middle] + ordered[(len(values) - 1) // 2]))


def accompanied(paths: Trajectories, *, radius: float) -> NDArray[np.bool_]:
    """(F, P) where three other points or more are within a radius [m] at the same time: nothing else can be judged."""
    live = paths.live
    out = np.zeros_like(live)
    for k in range(len(live)):
        index = np.flatnonzero(live[k])
        for p, near in _near(paths.x_world[k], index, paths.x_world[k, index], radius):
            out[k, p] = len(near) > _LEAST_NEIGHBOURS  # itself among them
    return out


def filtered(
    paths: Trajectories, *, radius: float, bounds: tuple[float, float] | None = None, neighbours: bool = False
) -> tuple[Trajectories, dict[str, int]]:
    """Paths after the paper's filters, and how many places each one cut off.

    Parameters
    ----------
    radius : [m] of the surroundings
    bounds : of speed [m/s] and acceleration [m/s²]; None: the first filter is left out
    neighbours : whether the second filter is repeated with the paths that are left until it cuts none, its limit being
        that of the first round, and points without neighbours are cut off then; a limb with few points is lost by it

    Raises
    ------
    ObservationError
        A bound that is not positive.
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
    for _ in range(_MAX_ROUNDS if neighbours else 1):
        off = _differences(kept, radius, 1)
        limit = _limit(off) if limit is None else limit
        if not cut("uniformity", kept.live & ~(off > limit)):
            break
    if neighbours:
        cut("neighbours", accompanied(kept, radius=radius))
    return kept, counts
