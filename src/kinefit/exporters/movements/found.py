"""All movements of a motion, and their table: jumps, squats and rises from a seat.

Jumps: both feet leave the floor and land again. In flight the centre of mass falls with g: it ends where the fall is
less than a share of that. Feet tell it worse, as toes bend unseen.
Squats: hips sink and rise over feet that stand, with the centre of mass above them.
Sit to stand: hips rise from a seat, on which the centre of mass is behind the heels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion
from kinefit.errors import ObservationError
from kinefit.exporters.movements.course import Course, Drop, Repetition
from kinefit.exporters.report.feet import smoothed
from kinefit.exporters.tables import Table, quantity_table
from kinefit.findings import runs_of

_CLEAR_M = 0.03  # of the lower sole above the floor
_FLIGHT_S = (0.15, 1.2)  # a run's flight is shorter
_EVENT_STD_S = 0.01  # of take-off and landing, against plates
_FALL_SHARE, _FALL_HZ = 0.7, 12.0  # of g; chosen on one drop jump (DJ1 of a person of 63 kg)
_GRAVITY = 9.81


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
        speed = float(np.sqrt(2.0 * _GRAVITY * max(rise, 0.0)))
        values = {
            "flight time [s]": (flight, float(np.sqrt(2.0)) * std),
            "height by flight [m]": (_GRAVITY * flight**2 / 8.0, _GRAVITY * flight / 4.0 * float(np.sqrt(2.0)) * std),
            "rise of the centre of mass [m]": (rise, float(np.hypot(speed * std, course.height_std[first]))),
        }
        out.append(Repetition("jump", start, end, values))
    return out


def _fall_ends(acceleration: NDArray, times: NDArray, top: int, way: int) -> float:
    """[s] where an acceleration (F,) [m/s²] upwards first is above that of a fall, before (-1) or after (1) a frame."""
    limit = -_FALL_SHARE * _GRAVITY
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
