"""All movements of a motion, and their table: jumps, squats and rises from a seat.

Jumps: both feet leave the floor and land again. In flight the centre of mass falls with g: it ends where the fall is
less than a share of that. Feet tell it worse, as toes bend unseen.
Squats: hips sink and rise over feet that stand, with the centre of mass above them.
Sit to stand: hips rise from a seat, on which the centre of mass is behind the heels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.errors import ObservationError
from kinefit.exporters.gait.plates import GRAVITY
from kinefit.exporters.report.feet import BALL, HEEL, peaks, smoothed, upright
from kinefit.exporters.tables import Table, quantity_table
from kinefit.findings import runs_of

_FLOOR_PERCENTILE = 5.0  # of the lower sole's height
_MIN_DEPTH, _END_SHARE = 0.1, 0.05  # shares: of the stature that hips sink at least; of a drop that is bottom or top
_HEIGHT_NOISE_M = 0.002  # of smooth hips from frame to frame; what lasts moves no time
_MIN_APART_S = 0.5  # between two lowest places


@dataclass(frozen=True)
class Repetition:
    """One jump, squat or rise from a seat.

    Parameters
    ----------
    kind : "jump", "squat" or "sit to stand"
    start, stop : [s]
    values : {quantity [unit]: (value, standard deviation)}
    """

    kind: str
    start: float
    stop: float
    values: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Drop:
    """Hips that sink and rise again.

    Parameters
    ----------
    begin : last frame of standing; -1 if the person did not stand before
    down, low, up : first frame at the bottom, the lowest, and the last one at the bottom
    end : first frame of standing again
    """

    begin: int
    down: int
    low: int
    up: int
    end: int


@dataclass(frozen=True, eq=False)
class Course:
    """Heights of a motion over the floor; the body has hips, heels and balls of the feet."""

    motion: Motion
    landmarks: tuple[str, ...] = field(default=tuple(f"{s}_{n}" for n in ("hip", HEEL, *BALL) for s in "lr"))

    @cached_property
    def _places(self) -> NDArray:
        """(F, 4, 2, 3) [m] hips, heels and both balls of the left and the right side, floor at zero, y up."""
        places = upright(self.motion, self.landmarks).reshape(len(self.motion), 4, 2, 3)
        places[..., 1] -= np.percentile(places[:, 1:, :, 1].min(axis=(1, 2)), _FLOOR_PERCENTILE)
        return places

    @property
    def sole(self) -> NDArray:
        """(F,) [m] height of the lowest point of both feet."""
        return np.asarray(self._places[:, 1:, :, 1].min(axis=(1, 2)))

    @property
    def hips(self) -> NDArray:
        """(F,) [m] height of the middle of the hips."""
        return np.asarray(self._places[:, 0, :, 1].mean(axis=1))

    @cached_property
    def centre(self) -> NDArray:
        """(F, 3) [m] centre of mass, y up."""
        return self.motion.centre_of_mass @ rotation_between_up(self.motion.up, "y").T

    @property
    def behind(self) -> NDArray:
        """(F,) [m] how far the centre of mass is behind the heels: who does not fall then sits."""
        heels, balls = self._places[:, 1].mean(axis=1), self._places[:, 2:].mean(axis=(1, 2))
        foot = (balls - heels)[:, ::2]
        away = (self.centre - heels)[:, ::2]
        return -np.asarray(np.sum(away * foot, axis=1) / np.linalg.norm(foot, axis=1))

    @property
    def height_std(self) -> NDArray:
        """(F,) [m] upper bound of the standard deviation of heights."""
        return self.motion.turned("y").centre_of_mass_std[:, 1]

    @cached_property
    def smooth_hips(self) -> NDArray:
        """(F,) [m] the hips' height without what is faster than walking."""
        return smoothed(self.hips, self.motion.rate)

    def time_std(self, frame: int) -> float:
        """[s] standard deviation of the time of a height of the hips, t of noise n = |v| t + |a| t² / 2."""
        step = 1.0 / self.motion.rate
        speed = np.gradient(self.smooth_hips, step)
        v, a = abs(float(speed[frame])), abs(float(np.gradient(speed, step)[frame])) + 1e-6
        return float(np.hypot(step / np.sqrt(12.0), (np.sqrt(v**2 + 2.0 * a * _HEIGHT_NOISE_M) - v) / a))

    def drops(self) -> list[Drop]:
        """Every time that the hips sink by a tenth of the stature and rise again."""
        motion, hips, out = self.motion, self.smooth_hips, []
        least = _MIN_DEPTH * (motion.body.stature or 1.7)
        lows = peaks(-hips, least, round(_MIN_APART_S * motion.rate))
        ends = [0, *lows.tolist(), len(hips) - 1]
        for before, low, after in zip(ends, ends[1:], ends[2:]):
            left, right = hips[before : low + 1][::-1] - hips[low], hips[low : after + 1] - hips[low]
            if right.max() < least:
                continue
            stood = left.max() > 0.5 * right.max()
            (down, high), (up, top) = (_ends_of(side) for side in (left if stood else right, right))
            out.append(Drop(low - high if stood else -1, max(low - down, before), low, low + up, low + top))
        return out


def _ends_of(rise: NDArray) -> tuple[int, int]:
    """Last frame at the bottom and first frame at the top of a course that rises from zero."""
    return int(np.argmax(rise > _END_SHARE * rise.max())) - 1, int(np.argmax(rise > (1.0 - _END_SHARE) * rise.max()))


_CLEAR_M = 0.03  # of the lower sole above the floor
_FLIGHT_S = (0.15, 1.2)  # a run's flight is shorter
_EVENT_STD_S = 0.01  # of take-off and landing, against plates
_FALL_SHARE, _FALL_HZ = 0.7, 12.0  # of g; chosen on one drop jump (DJ1 of a person of 63 kg)


def jumps(course: Course) -> list[Repetition]:
    """Jumps with their flight, the height by it (g T² / 8), and the rise of the centre of mass from take-off."""
    motion, sole, height, out = course.motion, course.sole, course.centre[:, 1], []
    falls = np.gradient(np.gradient(smoothed(height, motion.rate, _FALL_HZ), motion.times), motion.times)
    std = float(np.hypot(_EVENT_STD_S, 1.0 / (motion.rate * np.sqrt(12.0))))
    for first, stop in runs_of(sole > _CLEAR_M):
        if first == 0 or stop >= len(sole):
            continue
        top = first + int(np.argmax(height[first:stop]))
        start, end = (_fall_ends(falls, motion.times, top, way) for way in (-1, 1))
        flight = end - start
        if not _FLIGHT_S[0] < flight < _FLIGHT_S[1]:
            continue
        rise = float(height[first:stop].max() - np.interp(start, motion.times, height))
        speed = float(np.sqrt(2.0 * GRAVITY * max(rise, 0.0)))
        values = {
            "flight time [s]": (flight, float(np.sqrt(2.0)) * std),
            "height by flight [m]": (GRAVITY * flight**2 / 8.0, GRAVITY * flight / 4.0 * float(np.sqrt(2.0)) * std),
            "rise of the centre of mass [m]": (rise, float(np.hypot(speed * std, course.height_std[first]))),
        }
        out.append(Repetition("jump", start, end, values))
    return out


def _fall_ends(acceleration: NDArray, times: NDArray, top: int, way: int) -> float:
    """[s] where an acceleration (F,) [m/s²] upwards first is above that of a fall, before (-1) or after (1) a frame."""
    limit = -_FALL_SHARE * GRAVITY
    course, clock = (values[top::way] for values in (acceleration, times))
    over = np.flatnonzero(course > limit)
    k = max(int(over[0]), 1) if len(over) else len(course) - 1
    share = (limit - course[k - 1]) / (course[k] - course[k - 1]) if len(over) and course[k] != course[k - 1] else 1.0
    return float(clock[k - 1] + np.clip(share, 0.0, 1.0) * (clock[k] - clock[k - 1]))


def squats(course: Course, flights: list[Repetition]) -> list[Repetition]:
    """Squats with their depth, times and knees; not what leads to a flight or follows it."""
    out = []
    for drop in course.drops():
        frames = [max(drop.begin, 0), drop.down, drop.up, drop.end]
        start, down, up, stop = course.motion.times[frames].tolist()
        jumps = any(start < one.stop and one.start < stop for one in flights)
        if drop.begin < 0 or jumps or is_seated(course, drop):
            continue
        stds = [course.time_std(frame) for frame in frames]
        depth = course.hips[drop.begin] - course.hips[drop.low]
        values = {
            "depth [m]": (float(depth), float(np.sqrt(2.0) * course.height_std[drop.low])),
            "time down [s]": (down - start, float(np.hypot(stds[0], stds[1]))),
            "time up [s]": (stop - up, float(np.hypot(stds[2], stds[3]))),
            **{f"{side} knee flexion [deg]": _knee(course, drop, side[0]) for side in ("left", "right")},
        }  # fmt: skip
        out.append(Repetition("squat", start, stop, values))
    return out


def is_seated(course: Course, drop: Drop) -> bool:
    """Whether the centre of mass is behind the heels at the lowest place."""
    return bool(course.behind[drop.low] > 0.0)


def _knee(course: Course, drop: Drop, side: str) -> tuple[float, float]:
    """[deg] of a knee at the lowest place."""
    motion = course.motion
    at = motion.body.tree.coordinate(f"knee_angle_{side}")
    return float(np.degrees(motion.angles[drop.low, at])), float(np.degrees(motion.dof_std[drop.low, 6 + at]))


def rises(course: Course) -> list[Repetition]:
    """Rises from a seat with the time from leaving it to standing, and the height between."""
    hips, times, out = course.smooth_hips, course.motion.times, []
    for drop in course.drops():
        if not is_seated(course, drop):
            continue
        rise = hips[drop.end] - hips[drop.low]
        start, stop = float(times[drop.up]), float(times[drop.end])
        std = float(np.hypot(course.time_std(drop.up), course.time_std(drop.end)))
        error = float(np.sqrt(2.0) * course.height_std[drop.end])
        values = {"time to stand [s]": (stop - start, std), "rise of the hips [m]": (float(rise), error)}
        out.append(Repetition("sit to stand", start, stop, values))
    return out


def find_movements(motion: Motion) -> list[Repetition]:
    """Jumps, squats and rises from a seat, in the order of their times.

    Raises
    ------
    ObservationError
        The body has no hips, heels or balls of the feet, or the motion fewer than three frames.
    """
    course = Course(motion)
    lacking = [name for name in course.landmarks if name not in motion.body.landmarks.names]
    if lacking or len(motion) < 3:
        problem = f"the body has no landmark {lacking[0]}" if lacking else "fewer than three frames"
        raise ObservationError(problem, remedy="Give a motion of a person's whole body, such as humanoid.")
    flights = jumps(course)
    return sorted([*flights, *squats(course, flights), *rises(course)], key=lambda one: one.start)


def movement_table(found: list[Repetition]) -> Table:
    """Columns (rows,): kind, start and stop [s], each quantity with its standard deviation; NaN where it has none."""
    quantities = dict.fromkeys(name for one in found for name in one.values)
    return quantity_table(found, ("kind", "start", "stop"), quantities)
