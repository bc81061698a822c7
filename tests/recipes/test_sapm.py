"""SAPM as printed (P5): its steps, and the paper's first experiment."""

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.identification.frame.synthetic import random_pose, synthetic_body
from kinefit.recipes._sapm_steps import candidate_table, errors, nearest
from kinefit.recipes.sapm import sapm


def test_candidates_hold_equation_4_and_come_best_first():
    rng = np.random.default_rng(0)
    x, points = rng.uniform(0, 1, (5, 3)), rng.uniform(0, 1, (30, 3))
    table = candidate_table(x, points, np.ones(30, bool), 2, points[7], 7, 0.1)
    D, d = np.linalg.norm(x - x[2], axis=1), np.linalg.norm(points - points[7], axis=1)
    assert table.order[0] == 2 and (np.diff(D[table.order]) >= 0).all() and list(table.columns[0]) == [7]
    for i, column in zip(table.order[1:], table.columns[1:]):
        ratio = np.abs(d - D[i]) / D[i]
        assert set(column) == {j for j in np.flatnonzero(ratio < 0.2) if j != 7} and (np.diff(ratio[column]) >= 0).all()


def test_motion_never_mirrors():
    x = np.random.default_rng(1).standard_normal((5, 3))
    e, R, _ = errors(x, x * [1, 1, -1])
    assert np.linalg.det(R) == pytest.approx(1.0) and e.max() > 0.1


def test_a_point_is_matched_once_to_the_closest():
    x = np.array([[0.0, 0, 0], [0.01, 0, 0], [1.0, 0, 0]])
    found = nearest(x, np.eye(3), np.zeros(3), np.array([[0.011, 0, 0], [5.0, 0, 0]]), np.ones(2, bool), 0.1)
    assert found.tolist() == [-1, 0, -1]


def test_poses_without_noise():
    model, rng = synthetic_body(44), np.random.default_rng(2)
    poses = [random_pose(model, rng) for _ in range(25)]
    assert np.mean([(sapm(model, p.points) == p.truth).all() for p in poses]) >= 0.88


def test_a_missing_joint_is_recovered_as_a_virtual_one():
    model = synthetic_body(44)
    pose = random_pose(model, np.random.default_rng(3))
    joint = model.labels.index("neck")
    points = np.delete(pose.points, pose.truth[joint], axis=0)
    truth = np.where(pose.truth > pose.truth[joint], pose.truth - 1, pose.truth)
    truth[joint] = -1
    assert (sapm(model, points, epsilon=0.02, beta=0.7) == truth).all()


def test_bad_points_are_refused():
    with pytest.raises(ObservationError):
        sapm(synthetic_body(44), np.full((4, 3), np.nan))
