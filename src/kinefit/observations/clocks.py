"""Times of a recording's frames: even or uneven, nominal rate, and keypoints interpolated at a take's even steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.observations.recordings import Keypoints

_MAX_JITTER_STEPS = 0.15  # some containers round to milliseconds, 0.12 steps of 240 Hz
_MAX_SAME_STEPS = 0.02  # between a frame and a step at which it counts without interpolation
_MAX_ROUNDING = 0.4  # of a distance in medians to a whole number; 5 ms are 1.25 of 4 ms
_MAX_MEDIANS = 3  # of a distance that is used for the rate
_MAX_GAP_MEDIANS = 2.1  # of a gap that is interpolated: one frame is missing
_MAX_MOVE_SHARE = 0.5  # of a person's extent: mean distance of its points in two consecutive frames
_MIN_MOVE_PX = 20.0  # [px] of that distance is always allowed: some people have a point or two


def is_even(times: NDArray, rate: float) -> bool:
    """Whether frames at `times` (N,) [s] follow each other at `rate` [Hz], each within 0.15 of a step."""
    off = (times - times[:1]) * rate - np.arange(len(times))
    return bool(np.all(np.abs(off) <= _MAX_JITTER_STEPS))


def nominal_rate(times: NDArray) -> float:
    """Rate [Hz] of two or more frames at `times` (N,) [s], from distances close to one to three times their median."""
    distances = np.diff(times)
    ratios = distances / np.sort(distances)[len(distances) // 2]  # the median, or the distance above it
    steps = np.rint(ratios)
    near = (np.abs(ratios - steps) < _MAX_ROUNDING) & (steps >= 1) & (steps <= _MAX_MEDIANS)
    return float(steps[near].sum() / distances[near].sum())


def frame_times(count: int, rate: float, clock: NDArray | None = None) -> NDArray:
    """(N,) [s] from the first of `count` frames: those of a video's `clock` (N,) if it has as many, else even ones."""
    return clock if clock is not None and len(clock) == count else np.arange(count) / rate


def unevenness(times: NDArray, rate: float) -> str:
    """Describe how times (N,) [s] of a video's frames differ from even ones at its nominal rate [Hz]; "" if even."""
    if is_even(times, rate):
        return ""
    lacking = np.maximum(np.rint(np.diff(times) * rate).astype(int) - 1, 0)
    at = np.flatnonzero(lacking)
    text = f"variable frame rate, {rate:.4g} Hz nominal"
    if len(at):
        text += f", {lacking.sum()} frames lacking between {times[at[0]]:.3g} and {times[at[-1] + 1]:.3g} s"
    return text


def steps_of(times: NDArray, rate: float) -> tuple[int, int]:
    """Steps (start, stop) of a take, t = step / rate [Hz], within the frames at `times` (N,) [s]."""
    if is_even(times, rate):
        start = round(float(times[0]) * rate)
        return start, start + len(times)
    start, last = np.ceil(times[0] * rate - _MAX_JITTER_STEPS), np.floor(times[-1] * rate + _MAX_JITTER_STEPS)
    return int(start), int(last) + 1


def on_steps(keypoints: Keypoints, times: NDArray, rate: float, frames: tuple[int, int]) -> Keypoints:
    """Interpolate keypoints at the even steps of a take.

    A point is known at a step if it is detected in the frames before and after, with at most one frame missing between
    them. A person of one frame is matched to the person of the next frame with the nearest points.

    Parameters
    ----------
    times : (F,) [s] of the keypoints' frames in the take, increasing
    rate : float [Hz] of the take
    frames : (start, stop), steps of the take, t = step / rate
    """
    at = np.arange(*frames) / rate
    after = np.clip(np.searchsorted(times, at), min(1, len(times) - 1), len(times) - 1)
    before = np.maximum(after - 1, 0)
    gap = times[after] - times[before]
    share = np.divide(at - times[before], gap, out=np.zeros(len(at)), where=gap > 0)
    nearest = np.where(share > 0.5, after, before)
    same = np.abs(at - times[nearest]) * rate <= _MAX_SAME_STEPS
    median = np.median(np.diff(times)) if len(times) > 1 else 0.0
    between = ~same & (share > 0) & (share < 1) & (gap <= _MAX_GAP_MEDIANS * median)
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
    """(P,) int: the person of the next frame (P, K, 2) [px] that matches each person of a frame; -1 for none near."""
    distance = np.linalg.norm(points[:, None] - next_points[None], axis=-1)
    both = np.isfinite(distance)
    count = both.sum(axis=-1)
    mean = np.where(count > 0, np.where(both, distance, 0.0).sum(axis=-1) / np.maximum(count, 1), np.inf)
    known = np.isfinite(points)
    extent = np.where(known, points, -np.inf).max(axis=1) - np.where(known, points, np.inf).min(axis=1)
    best, back = mean.argmin(axis=1), mean.argmin(axis=0)
    limit = np.maximum(_MAX_MOVE_SHARE * np.linalg.norm(extent, axis=-1), _MIN_MOVE_PX)
    near = mean[np.arange(len(mean)), best] <= limit
    return np.where(near & (back[best] == np.arange(len(mean))), best, -1)
