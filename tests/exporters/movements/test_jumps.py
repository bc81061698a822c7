"""Jumps by the fall of the centre of mass."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.movements.synthetic import SQUAT, crouching, jumping, times_down

from kinefit.exporters.movements import Course, jumps


@pytest.mark.parametrize("speed", [1.8, 2.5, 3.2])
def test_a_jump_has_its_flight_and_height(speed):
    motion, flight = jumping(speed)
    (found,) = jumps(Course(motion))
    for name, truth, within in (
        ("flight time [s]", flight, 0.05), ("height by flight [m]", speed**2 / 19.62, 0.09),
        ("rise of the centre of mass [m]", speed**2 / 19.62, 0.05),
    ):  # fmt: skip
        value, std = found.values[name]
        assert value == pytest.approx(truth, abs=within) and std > 0.0, name
    assert found.start == pytest.approx(1.26, abs=0.03)
    assert found.stop - found.start == pytest.approx(found.values["flight time [s]"][0])


@pytest.mark.parametrize("up", ["z", "-x"])
def test_the_vertical_axis_does_not_matter(up):
    motion, _ = jumping()
    (one,), (other,) = jumps(Course(motion)), jumps(Course(motion.turned(up)))
    assert other.values["flight time [s]"] == pytest.approx(one.values["flight time [s]"])


def test_neither_squats_nor_a_hop_nor_a_flight_at_the_end_is_a_jump():
    assert jumps(Course(crouching(times_down(2), SQUAT))) == []
    assert jumps(Course(jumping(0.5)[0])) == []
    motion, _ = jumping()
    assert jumps(Course(motion.part(slice(0, 160)))) == []


def test_a_jump_of_an_unobserved_body_has_an_infinite_error_by_the_centre_of_mass():
    motion, _ = jumping()
    (found,) = jumps(Course(replace(motion, joint_std=np.full(motion.joint_std.shape, np.inf))))
    assert np.isinf(found.values["rise of the centre of mass [m]"][1])
    assert np.isfinite(found.values["flight time [s]"][1])
