"""Errors of results against known truths."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.simulation import cut, squat_and_wave
from kinefit.simulation.evaluation import angle_errors, coverage, coverage_of_groups, joint_errors, orientation_errors

TRUTH = squat_and_wave()
D = TRUTH.body.tree.coordinate


def with_angle(name, degrees):
    angles = np.array(TRUTH.angles)
    angles[:, D(name)] += np.radians(degrees)
    return replace(TRUTH, angles=angles)


def test_the_truth_has_no_error_in_any_world():
    for result in (TRUTH, TRUTH.turned("y")):
        assert joint_errors(TRUTH, result).max() < 1e-12
        assert np.abs(angle_errors(TRUTH, result)).max() == 0
        assert orientation_errors(TRUTH, result).max() < 1e-6


def test_a_shift_of_the_root_shifts_every_joint():
    Ts = np.array(TRUTH.Ts_world_root)
    Ts[:, :3, 3] += (0.03, 0.0, 0.04)
    np.testing.assert_allclose(joint_errors(TRUTH, replace(TRUTH, Ts_world_root=Ts)), 0.05, atol=1e-12)


@pytest.mark.parametrize(("degrees", "expected"), [(3.0, 3.0), (-2.0, -2.0), (358.0, -2.0), (-350.0, 10.0)])
def test_angles_wrap(degrees, expected):
    errors = angle_errors(TRUTH, with_angle("elbow_flex_r", degrees))
    np.testing.assert_allclose(errors[:, D("elbow_flex_r")], expected, atol=1e-9)
    assert np.abs(np.delete(errors, D("elbow_flex_r"), axis=1)).max() == 0


def test_one_angle_turns_its_segment_and_all_beyond():
    result = with_angle("elbow_flex_r", 4.0)
    tree = TRUTH.body.tree
    beyond = [tree.segment("forearm_r"), tree.segment("hand_r")]
    errors = orientation_errors(TRUTH, result)
    np.testing.assert_allclose(errors[:, beyond], 4.0, atol=1e-9)
    assert np.delete(errors, beyond, axis=1).max() < 1e-6
    errors = orientation_errors(TRUTH, result, relative=True)
    np.testing.assert_allclose(errors[:, beyond[0]], 4.0, atol=1e-9)
    assert np.delete(errors, beyond[0], axis=1).max() < 1e-5
    joints = joint_errors(TRUTH, result)
    length = np.linalg.norm(tree.offsets[beyond[1]])
    np.testing.assert_allclose(joints[:, beyond[1]], 2 * length * np.sin(np.radians(2.0)), atol=1e-12)


def test_bodies_may_have_other_lengths():
    longer = replace(TRUTH, body=TRUTH.body.scaled(np.full(len(TRUTH.body.scale_groups), 1.1)))
    assert np.abs(angle_errors(TRUTH, longer)).max() == 0 and 0.01 < joint_errors(TRUTH, longer).max() < 0.2


def test_right_error_bars_cover_95_percent():
    random = np.random.default_rng(0)
    sigma = np.radians(2.0)
    angles = TRUTH.angles + sigma * random.standard_normal(TRUTH.angles.shape)
    Ts = np.array(TRUTH.Ts_world_root)
    shift = 0.01 * random.standard_normal((len(TRUTH), 3))
    Ts[:, :3, 3] += shift
    moved = replace(TRUTH, Ts_world_root=Ts, joint_std=np.full_like(TRUTH.joint_std, 0.01))
    turned = replace(TRUTH, angles=angles, dof_std=np.full_like(TRUTH.dof_std, sigma))
    assert abs(coverage(TRUTH, turned).angles - 0.954) < 0.01
    assert abs(coverage(TRUTH, moved).joints - 0.954) < 0.04
    assert coverage(TRUTH, turned, sigmas=1.0).angles < 0.75
    assert coverage(TRUTH, TRUTH.turned("y")).angles == 1.0
    unknown = replace(TRUTH, dof_std=np.full_like(TRUTH.dof_std, np.inf))
    assert np.isnan(coverage(TRUTH, unknown).angles)


def test_groups_are_judged_apart():
    std, groups = np.full_like(TRUTH.joint_std, 0.01), TRUTH.body.scale_groups
    feet = TRUTH.body.segment_scale == groups.index("foot")
    std[:, feet] = np.inf
    shifted = np.array(TRUTH.Ts_world_root)
    shifted[:, :3, 3] += 0.015
    told = coverage_of_groups(TRUTH, replace(TRUTH, Ts_world_root=shifted, joint_std=std))
    assert tuple(told) == groups
    assert np.isnan(told["foot"].joints) and told["thigh"].joints == 1.0
    assert coverage_of_groups(TRUTH, replace(TRUTH, Ts_world_root=shifted, joint_std=std), sigmas=1)["hand"].joints == 0


def test_what_cannot_be_compared_is_told():
    with pytest.raises(ObservationError, match="frames"):
        joint_errors(TRUTH, cut(TRUTH, 1))
    tree = replace(TRUTH.body.tree, segments=("hips", *TRUTH.body.tree.segments[1:]))
    with pytest.raises(ObservationError, match="segments"):
        angle_errors(TRUTH, replace(TRUTH, body=replace(TRUTH.body, tree=tree)))
