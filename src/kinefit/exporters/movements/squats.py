"""Squats: hips sink and rise over feet that stand, with the centre of mass above them."""

from __future__ import annotations

import numpy as np

from kinefit.exporters.movements.course import Course, Drop, Repetition


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
