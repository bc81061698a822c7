"""Jumps: both feet leave the floor and land again.

In flight the centre of mass falls with g: it ends where the fall is less than a share of that. Feet tell it worse, as
toes bend unseen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.exporters.movements.course import Course, Repetition
from kinefit.exporters.report.feet import smoothed
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
