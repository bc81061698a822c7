"""Sit to stand: hips rise from a seat, on which the centre of mass is behind the heels."""

from __future__ import annotations

import numpy as np

from kinefit.exporters.movements.course import Course, Repetition
from kinefit.exporters.movements.squats import is_seated


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
