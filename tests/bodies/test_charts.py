"""The two charts of a ball joint."""

from __future__ import annotations

import numpy as np

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.tree import off_the_limits, twin

BODY = load_body("humanoid")


def positions(angles):
    return BODY.positions(BodyState(np.eye(4), angles), BODY.landmarks)


def test_the_twin_is_the_same_turn():
    angles = np.random.default_rng(0).uniform(-1.5, 1.5, len(BODY.tree.coordinates))
    for d in BODY.tree.ball_joints:
        other = angles.copy()
        other[d] = twin(angles[d])
        np.testing.assert_allclose(positions(other), positions(angles), atol=1e-12)
        np.testing.assert_allclose(np.exp(1j * twin(twin(angles[d]))), np.exp(1j * angles[d]), atol=1e-12)


def test_shoulders_hips_and_spine_are_ball_joints():
    first = {BODY.tree.coordinates[d.start] for d in BODY.tree.ball_joints}
    assert first == {
        "lumbar_extension", "thorax_extension", "neck_extension", "arm_flex_r", "arm_flex_l", "hip_flexion_r",
        "hip_flexion_l",
    }  # fmt: skip


def test_an_arm_at_the_end_of_one_chart_goes_on_in_the_other():
    angles = np.zeros(len(BODY.tree.coordinates))
    arm = slice(BODY.tree.coordinate("arm_flex_r"), BODY.tree.coordinate("arm_rot_r") + 1)
    angles[arm] = BODY.tree.upper[arm.start], np.radians(-150), np.radians(100)
    moved = off_the_limits(BODY.tree, angles)
    assert moved is not None
    other, signs = moved
    np.testing.assert_allclose(positions(other), positions(angles), atol=1e-12)
    assert np.all((other[arm] > BODY.tree.lower[arm]) & (other[arm] < BODY.tree.upper[arm]))
    np.testing.assert_array_equal(signs[arm], [1, -1, 1])
    assert np.all(np.delete(signs, range(arm.start, arm.stop)) == 1)
    step = np.zeros_like(angles)
    step[arm] = 1e-3, 2e-3, -1e-3
    np.testing.assert_allclose(positions(other + signs * step), positions(angles + step), atol=1e-12)


def test_nothing_changes_within_the_limits_or_without_a_free_twin():
    assert off_the_limits(BODY.tree, np.zeros(len(BODY.tree.coordinates))) is None
    knees = np.zeros(len(BODY.tree.coordinates))
    knees[BODY.tree.coordinate("knee_angle_r")] = BODY.tree.upper[BODY.tree.coordinate("knee_angle_r")]
    assert off_the_limits(BODY.tree, knees) is None
