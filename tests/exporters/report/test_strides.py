"""Standard deviations of steps and strides, against steps of bodies of other lengths."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.report.test_cycles import walk

from kinefit.bodies.lasting_errors import LastingErrors, ParameterErrors
from kinefit.exporters.report.cycles import find_cycles
from kinefit.exporters.report.strides import stride_quantities

LENGTHS = ("stride length [m]", "step length [m]", "step width [m]")
SIGMA = 0.02  # of the logarithm of a length


@pytest.fixture(scope="module")
def limp():
    """A walk whose pelvis turns and whose thighs differ, so that lengths change steps."""
    motion = walk()
    angles = np.array(motion.angles)
    angles[:, motion.body.tree.coordinates.index("hip_adduction_l")] += 0.1
    angles[:, motion.body.tree.coordinates.index("knee_angle_r")] += 0.2
    return replace(motion, angles=angles)


def measured(motion, feet=None):
    cycles = find_cycles(motion)
    side = next(side for side in cycles.sides if side.name == "left")
    return stride_quantities(motion, feet or cycles.feet, "left", side.times), cycles.feet


def with_errors(motion, constant, parameters=None):
    keys = np.array([0, len(motion) - 1])
    factors = np.broadcast_to(constant, (2, *constant.shape))
    return replace(motion, lasting=LastingErrors(keys, factors, np.zeros_like(factors), 0.5, parameters))


def length_error(group):
    one = np.ones((1, 1))
    return ParameterErrors((f"length {group}",), np.zeros(1), SIGMA**2 * one, one / SIGMA**2, SIGMA * one)


@pytest.mark.parametrize("group", ["pelvis", "thigh", "shank", "foot"])
def test_an_error_of_a_length_moves_steps_as_the_length_does(limp, group):
    dofs = limp.body.tree.n_dofs
    found, feet = measured(with_errors(limp, np.zeros((dofs, 1)), length_error(group)))
    ends = []
    for sign in (1.0, -1.0):
        scales = np.exp(sign * 0.01 * (np.array(limp.body.scale_groups) == group))
        ends.append(measured(replace(limp, body=limp.body.scaled(scales)), feet)[0])
    moved = {name: SIGMA * np.abs(ends[0][name].values - ends[1][name].values) / 0.02 for name in LENGTHS}
    assert max(np.max(moved[name]) for name in LENGTHS) > 1e-4
    for name in LENGTHS:
        np.testing.assert_allclose(found[name].stds, moved[name], rtol=0.05, atol=2e-5)


def test_what_lasts_is_in_no_stride_and_what_is_brief_is_in_it_twice(limp):
    dofs = limp.body.tree.n_dofs
    shift = 0.01 * np.eye(dofs, 3)  # of the whole body
    lasting = with_errors(replace(limp, joint_std=np.full(limp.joint_std.shape, 0.01)), shift)
    np.testing.assert_allclose(measured(lasting)[0]["stride length [m]"].stds, 0.0, atol=1e-6)
    brief = with_errors(replace(limp, joint_std=np.full(limp.joint_std.shape, 0.01)), 0.6 * shift)
    stds = measured(brief)[0]["stride length [m]"].stds
    np.testing.assert_allclose(stds, 0.008 * np.sqrt(2.0), rtol=1e-3)


def test_lengths_are_between_the_backs_of_the_heels():
    motion = walk()
    found, feet = measured(motion)
    marks = motion.body.landmarks
    backs = [marks.index(f"{side}_calcaneus_posterior") for side in "lr"]
    points = marks.points + 0.0
    points[backs, 0] -= 0.03
    body = replace(motion.body, landmarks=replace(marks, points=points))
    moved = measured(replace(motion, body=body), feet)[0]
    for name in LENGTHS:  # both heels alike
        np.testing.assert_allclose(moved[name].values, found[name].values, atol=0.002)
    points[backs[1], 0] -= 0.03
    body = replace(motion.body, landmarks=replace(marks, points=points))
    away = measured(replace(motion, body=body), feet)[0]["step length [m]"].values
    np.testing.assert_allclose(away - found["step length [m]"].values, 0.03, atol=0.004)
