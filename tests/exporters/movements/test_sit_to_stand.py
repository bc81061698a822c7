"""Rises from a seat."""

import numpy as np
import pytest
from tests.exporters.movements.synthetic import SEAT, SQUAT, crouching, times_down

from kinefit.exporters.movements import Course, rises


def test_rises_are_counted_and_timed():
    course = Course(crouching(times_down(3), SEAT))
    found = rises(course)
    assert len(found) == 3
    for one in found:
        value, std = one.values["time to stand [s]"]
        assert 0.3 < value < 0.7 and 0.0 < std < 0.1 and one.stop - one.start == pytest.approx(value)
        assert one.values["rise of the hips [m]"][0] == pytest.approx(np.ptp(course.hips), rel=0.1)


def test_who_sits_from_the_start_rises_once():
    share = times_down(1)
    assert len(rises(Course(crouching(share[120:], SEAT)))) == 1
    assert rises(Course(crouching(share[:180], SEAT))) == []  # sits down alone


def test_a_squat_is_no_seat():
    assert rises(Course(crouching(times_down(2), SQUAT))) == []
