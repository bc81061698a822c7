"""Euler angles that give the rotation and do not jump; names that formats accept."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kinefit.exporters.skeletons.common import euler_zxy, plain_names
from kinefit.geometry import se3


def from_zxy(angles):
    z, x, y = (se3.exp_so3(angles[..., k, None] * np.eye(3)[axis]) for k, axis in enumerate((2, 0, 1)))
    return z @ x @ y


angle = st.floats(-10, 10)
middle = st.one_of(angle, st.sampled_from([np.pi / 2, -np.pi / 2, np.pi / 2 + 1e-9, np.pi / 2 - 1e-6, 0.0]))


@given(st.lists(st.tuples(angle, middle, angle), min_size=1, max_size=6))
def test_the_angles_give_the_rotation_also_at_gimbal_lock(triples):
    R = from_zxy(np.array(triples))
    assert np.abs(from_zxy(euler_zxy(R)) - R).max() < 5e-7


def test_turns_add_up_and_the_middle_angle_may_pass_a_right_angle():
    t = np.linspace(0, 1, 200)
    angles = np.stack([9.0 * t, 2.6 * np.sin(3 * t), -14.0 * t], axis=1)
    assert np.abs(angles[:, 1]).max() > np.pi / 2
    assert np.abs(euler_zxy(from_zxy(angles)) - angles).max() < 1e-9


def test_many_joints_are_told_apart():
    angles = np.random.default_rng(0).uniform(-1.2, 1.2, (5, 4, 3))
    assert np.abs(euler_zxy(from_zxy(angles)) - angles).max() < 1e-12


def test_names_lose_blanks_and_stay_different():
    assert plain_names(["left arm", "left_arm", "a/b", ""]) == ["left_arm", "left_arm_2", "a_b", "_"]
