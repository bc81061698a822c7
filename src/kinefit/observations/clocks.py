"""Times of a recording's frames: even or uneven, nominal rate, and keypoints interpolated at a take's even steps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from decimal import Decimal
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.observations.recordings import Keypoints

_MAX_JITTER_STEPS = 0.15  # some containers round to milliseconds, 0.12 steps of 240 Hz
_MAX_SAME_STEPS = 0.02  # between a frame and a step at which it counts without interpolation
_MAX_ROUNDING = 0.4  # of a distance in medians to a whole number; 5 ms are 1.25 of 4 ms
_MAX_MEDIANS = 3  # of a distance that is used for the rate
_MAX_GAP_MEDIANS = 2.1  # of a gap that is interpolated: one frame is missing
_MAX_MOVE_SHARE = 0.5  # of a person's extent: mean distance of its points in two consecutive frames
_MIN_MOVE_PX = 20.0  # [px] of that distance is always allowed: some people have a point or two

_NUMBER = re.compile(r"\d+")
_DECIMAL = re.compile(r"(?:^|[_\s-])(\d+\.\d+)$")  # the end of a name; "shot.0001" is the frame 1 of a shot
_UNIX_DIGITS = {13: 1e-3, 16: 1e-6, 19: 1e-9}  # [s] of a whole number of so many digits
_MAX_UNIX_S = 2e9  # in 2033: dates of as many digits begin with 20
_DATE = re.compile(
    r"(\d{4})[-_]?(\d\d)[-_]?(\d\d)[-_T ]?(\d\d)[-_:.h]?(\d\d)[-_:.m]?(\d\d)[-_:.,s]?(\d{3,6})(?:ms|us)?$"
)
_STEPS_S = (0.0015, 10.0)  # median step of frames, so that decimals are seconds
_COUNTED_UNITS = (1e-3, 1e-6, 1e-9)  # [s] of whole numbers that count from the start of a recording
_MIN_COUNTED_STEP = 4  # numbers from one frame to the next, so that they may be milliseconds
_MAX_RATE_ERROR = 0.05  # of a rate by such numbers, to the stated rate
_MAX_COUNT = 2.0**53  # from the first number to the last: whole in 64 bits
_MAX_NUMBER_STEP = 1.5  # of the numbers in two names, in median steps: with more a frame is missing


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


@dataclass(frozen=True, eq=False)
class NamedFrames:
    """What the names of a recording's files, one a frame, state of time.

    Parameters
    ----------
    file_names : (N,)
    numbers : (N,) int
        Of the frames; 0, 1, 2 where names have no number of their own.
    times : (N,) [s] or None
        By the names, on their own clock; None where they state none.
    """

    file_names: tuple[str, ...]
    numbers: NDArray
    times: NDArray | None = None

    @property
    def step(self) -> int:
        """Most frequent step of the numbers: the lower median."""
        steps = np.sort(np.diff(self.numbers))
        return int(steps[(len(steps) - 1) // 2]) if len(steps) else 1

    def on_clock(self, rate: float, what: str = "files") -> tuple[NDArray, str]:
        """Times (N,) [s] of the frames from the first on, and what is worth saying of them; "" for even ones.

        Parameters
        ----------
        rate : float [Hz] at which the numbers count, if they are not times themselves
        what : name of the files, for what is said
        """
        if self.times is not None:
            return self.times - self.times[0], f"the names of its {what} are taken as their times"
        count, step, numbers = len(self.file_names), self.step, self.numbers - self.numbers[0]
        steps = f"the numbers of its {what} step by {step} ({', '.join(self.file_names[:2])}): "
        for unit in _COUNTED_UNITS if step >= _MIN_COUNTED_STEP else ():
            if abs(step * unit * rate - 1.0) < _MAX_RATE_ERROR:
                return numbers * unit, f"{steps}taken as times in {unit:g} s; frames that were left out look the same"
        if step / rate > _STEPS_S[1]:
            return np.arange(count) / rate, f"{steps}not used, frames are even. If they are times, write time_unit"
        if step > 1:
            own = f"If the {what} themselves have {rate:.4g} Hz, write rate = {rate * step:.4g}"
            return numbers / rate, f"{steps}taken as frames of {rate:.4g} Hz, of which one in {step} is there. {own}"
        missing = int(numbers[-1]) + 1 - count
        return numbers / rate, f"{missing} numbers are missing among its {what}" if missing else ""

    def refuse_gaps(self, what: str) -> None:
        """Raise ObservationError where numbers of frames are missing between others."""
        gaps = np.flatnonzero(np.diff(self.numbers) > _MAX_NUMBER_STEP * self.step)
        if len(gaps) and self.times is None:
            between = " and ".join(self.file_names[gaps[0] : gaps[0] + 2])
            remedy = "Copy them again, or remove all later ones, or number them without a gap."
            raise ObservationError(f"{what} are missing between {between}, in {len(gaps)} places", remedy=remedy)


def counted_times(file_names: Sequence[str], unit: float) -> NDArray:
    """Times (N,) [s] from the first on, by the last number in every name, in a unit [s].

    Raises
    ------
    ObservationError
        A name without a number.
    """
    stems = [PurePath(name).stem for name in file_names]
    found = [_DECIMAL.findall(stem) or _NUMBER.findall(stem) for stem in stems]
    if not found or not all(found):
        raise ObservationError("the file names have no number", remedy="Remove time_unit, give rate.")
    counts = [Decimal(numbers[-1]) for numbers in found]
    return np.array([float(count - counts[0]) for count in counts]) * unit


def frames_by_name(file_names: Sequence[str], what: str = "files") -> NamedFrames:
    """Frame numbers or times of a recording's files, from their names in natural order.

    A number of seconds since 1970 or of a date is a time, and so is a decimal number of seconds at the end of a name.
    Else the last number that differs between the names is the frame's.

    Raises
    ------
    ObservationError
        Two files with one number.
    """
    plain = NamedFrames(tuple(file_names), np.arange(len(file_names)))
    stems = [PurePath(name).stem for name in file_names]
    columns = [[int(number) for number in _NUMBER.findall(stem)] for stem in stems]
    if len(stems) < 2 or not all(columns):
        return plain
    times = np.array([_seconds(stem) for stem in stems], float)
    if np.diff(times).min() > 0.0 and _STEPS_S[0] < np.median(np.diff(times)) < _STEPS_S[1]:
        return replace(plain, times=times)
    alike = len({_NUMBER.sub("#", stem) for stem in stems}) == 1
    varying = [k for k in range(len(columns[0])) if len({row[k] for row in columns}) > 1] if alike else []
    numbers = np.array([row[varying[-1] if varying else -1] for row in columns], float)
    different, counts = np.unique(numbers, return_counts=True)
    if len(different) < len(numbers):
        twice = np.flatnonzero(numbers == different[np.argmax(counts)])[:2]
        problem = f"two {what} with one number: {' and '.join(file_names[i] for i in twice)}"
        remedy = 'Keep one camera in each folder, or name its files by a pattern: "folder/left_*.png".'
        raise ObservationError(problem, remedy=remedy)
    is_count = np.diff(numbers).min() > 0.0 and np.ptp(numbers) < _MAX_COUNT
    return replace(plain, numbers=numbers.astype(int)) if is_count else plain


def _seconds(stem: str) -> float:
    """Seconds that a name states: a decimal number, seconds since 1970 or a date; NaN without."""
    if decimal := _DECIMAL.search(stem):
        return float(decimal[1])
    last = _NUMBER.findall(stem)[-1]
    time = int(last) * _UNIX_DIGITS.get(len(last), 0.0)
    if _MAX_UNIX_S / 2.0 < time < _MAX_UNIX_S:
        return time
    with suppress(ValueError):
        if date := _DATE.search(stem):
            return datetime.strptime("".join(date.groups()) + "+0000", "%Y%m%d%H%M%S%f%z").timestamp()
    return np.nan


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
    if keypoints.looked is not None:
        arrays["looked"] = keypoints.looked[nearest]
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
