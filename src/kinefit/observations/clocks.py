"""When the frames of a recording were taken: even or not, and keypoints put onto the even steps of a take."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.observations.recordings import Keypoints

_MAX_JITTER = 0.15  # of a step: milliseconds, to which some containers round, are 0.12 steps of 240 Hz
_MAX_SAME = 0.02  # of a step, by which a frame may be off and still counts at it as it is
_MAX_OFF, _MAX_STEPS = 0.4, 3  # medians, that a distance is off a whole number, up to this one; 5 ms are 1.25 of 4
_MAX_GAP = 2.1  # usual distances of frames over which is interpolated: one frame is lacking
_MAX_MOVE = 0.5  # of a person's extent, mean distance of its points in two frames next to each other
_MIN_MOVE_PX = 20.0  # that distance is always allowed: of some persons a point or two are seen


def is_even(times: NDArray, rate: float) -> bool:
    """Whether frames at `times` (N,) [s] follow each other at `rate` [Hz], each within 0.15 of a step."""
    off = (times - times[0]) * rate - np.arange(len(times))
    return bool(np.all(np.abs(off) <= _MAX_JITTER))


def nominal_rate(times: NDArray) -> float:
    """Rate [Hz] of two or more frames at `times` (N,) [s]: by distances near to one to three times their median."""
    distances = np.diff(times)
    ratios = distances / np.sort(distances)[len(distances) // 2]  # the median, or the distance above it
    steps = np.rint(ratios)
    near = (np.abs(ratios - steps) < _MAX_OFF) & (steps >= 1) & (steps <= _MAX_STEPS)
    return float(steps[near].sum() / distances[near].sum())


def frame_times(count: int, rate: float, clock: NDArray | None = None) -> NDArray:
    """(count,) [s] from the first frame: those of a video (`clock`) that has as many frames, else even ones."""
    return clock if clock is not None and len(clock) == count else np.arange(count) / rate


def unevenness(times: NDArray, rate: float) -> str:
    """How times (N,) [s] of a video's frames differ from even ones at its nominal rate [Hz]; "" where they do not."""
    if is_even(times, rate):
        return ""
    lacking = np.maximum(np.rint(np.diff(times) * rate).astype(int) - 1, 0)
    at = np.flatnonzero(lacking)
    told = f"variable frame rate, {rate:.4g} Hz nominal"
    if len(at):
        told += f", {lacking.sum()} frames lacking between {times[at[0]]:.3g} and {times[at[-1] + 1]:.3g} s"
    return told


def steps_of(times: NDArray, rate: float) -> tuple[int, int]:
    """Steps (start, stop) of a take, t = step / rate, that frames at `times` (N,) [s] reach."""
    if is_even(times, rate):
        start = round(float(times[0]) * rate)
        return start, start + len(times)
    return int(np.ceil(times[0] * rate - _MAX_JITTER)), int(np.floor(times[-1] * rate + _MAX_JITTER)) + 1


def on_steps(keypoints: Keypoints, times: NDArray, rate: float, frames: tuple[int, int]) -> Keypoints:
    """Keypoints at the even steps of a take, interpolated between the two frames about each.

    A point is seen at a step if both frames saw it and no more than one frame is lacking between them. A person of one
    frame is the person of the next one whose points are nearest.

    Parameters
    ----------
    times : (F,) [s] of its frames in the take, increasing
    rate : float [Hz] of the take
    frames : (start, stop), steps of the take, t = step / rate
    """
    at = np.arange(*frames) / rate
    after = np.clip(np.searchsorted(times, at), min(1, len(times) - 1), len(times) - 1)
    before = np.maximum(after - 1, 0)
    gap = times[after] - times[before]
    share = np.divide(at - times[before], gap, out=np.zeros(len(at)), where=gap > 0)
    nearest = np.where(share > 0.5, after, before)
    same = np.abs(at - times[nearest]) * rate <= _MAX_SAME
    usual = np.median(np.diff(times)) if len(times) > 1 else 0.0
    between = ~same & (share > 0) & (share < 1) & (gap <= _MAX_GAP * usual)
    names = ("points", "confidence", *(() if keypoints.lifted is None else ("lifted",)))
    arrays = {name: getattr(keypoints, name)[nearest] for name in names}
    for array in arrays.values():
        array[~(same | between)] = np.nan
    for step in np.flatnonzero(between):
        a, b, s = before[step], after[step], share[step]
        next_person = _next_people(keypoints.points[a], keypoints.points[b])
        unknown = next_person < 0
        for name, array in arrays.items():
            source = getattr(keypoints, name)
            array[step] = (1.0 - s) * source[a] + s * source[b][next_person]
            array[step, unknown] = np.nan
    arrays["confidence"][~np.isfinite(arrays["points"]).all(axis=-1)] = 0.0
    return replace(keypoints, rate=rate, time_offset=frames[0] / rate, **arrays)


def _next_people(points: NDArray, next_points: NDArray) -> NDArray:
    """(P,) int: which person of the next frame (P, K, 2) [px] each person of a frame is; -1 where nobody is near."""
    distance = np.linalg.norm(points[:, None] - next_points[None], axis=-1)
    both = np.isfinite(distance)
    count = both.sum(axis=-1)
    mean = np.where(count > 0, np.where(both, distance, 0.0).sum(axis=-1) / np.maximum(count, 1), np.inf)
    seen = np.isfinite(points)
    extent = np.where(seen, points, -np.inf).max(axis=1) - np.where(seen, points, np.inf).min(axis=1)
    best, back = mean.argmin(axis=1), mean.argmin(axis=0)
    limit = np.maximum(_MAX_MOVE * np.linalg.norm(extent, axis=-1), _MIN_MOVE_PX)
    near = mean[np.arange(len(mean)), best] <= limit
    return np.where(near & (back[best] == np.arange(len(mean))), best, -1)
