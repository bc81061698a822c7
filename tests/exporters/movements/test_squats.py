"""Squats are counted and timed; sitting is none."""

import numpy as np
import pytest
from tests.exporters.movements.synthetic import SEAT, SQUAT, crouching, jumping, times_down

from kinefit.exporters.movements import Course, Repetition, squats


@pytest.mark.parametrize("count", [1, 3])
def test_squats_have_depth_times_and_knees(count):
    motion = crouching(times_down(count), SQUAT)
    course = Course(motion)
    found = squats(course, [])
    assert len(found) == count
    depth = np.ptp(course.hips)
    for one in found:
        assert one.values["depth [m]"][0] == pytest.approx(depth, rel=0.1)
        assert one.values["left knee flexion [deg]"][0] == pytest.approx(105.0, abs=1.0)
        for name in ("time down [s]", "time up [s]"):
            value, std = one.values[name]
            assert 0.3 < value < 0.7 and 0.0 < std < 0.1
        assert one.stop - one.start > one.values["time down [s]"][0] + one.values["time up [s]"][0] + 0.3


def test_neither_sitting_nor_a_small_bend_nor_a_jump_is_a_squat():
    assert squats(Course(crouching(times_down(2), SEAT)), []) == []
    assert squats(Course(crouching(0.3 * times_down(2), SQUAT)), []) == []
    assert squats(Course(jumping()[0]), []) == []
    motion = crouching(times_down(1), SQUAT)
    (one,) = squats(Course(motion), [])
    flight = Repetition("jump", one.stop - 0.1, one.stop + 0.4, {})
    assert squats(Course(motion), [flight]) == []


def test_a_recording_that_begins_below_has_no_squat_there():
    motion = crouching(times_down(2)[130:], SQUAT)
    assert len(squats(Course(motion), [])) == 1
