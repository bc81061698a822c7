"""Absolute orientation in closed form against SciPy, and where pairs leave a turn open."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.solving.functional_joints import absolute_orientation, move

RANDOM = np.random.default_rng(0)


def pairs(count, limbs, noise):
    limb = np.sort(RANDOM.integers(0, limbs, count))
    R, t = se3.exp_so3(RANDOM.normal(size=(limbs, 3))), RANDOM.normal(size=(limbs, 3))
    x = RANDOM.normal(size=(count, 3))
    y = (R[limb] @ x[:, :, None])[..., 0] + t[limb] + noise * RANDOM.normal(size=(count, 3))
    return x, y, RANDOM.uniform(0.1, 30.0, count), limb, R, t


def test_the_true_motions_are_found():
    x, y, w, limb, R, t = pairs(100, 5, 0.0)
    found = absolute_orientation(x, y, w, limb, 6)
    np.testing.assert_allclose(found[0][:5], R, atol=1e-10)
    np.testing.assert_allclose(found[1][:5], t, atol=1e-10)
    np.testing.assert_array_equal(found[0][5], np.eye(3))  # no pairs: it stays
    np.testing.assert_array_equal(found[1][5], np.zeros(3))


def test_noisy_pairs_as_scipy_aligns_them():
    x, y, w, limb, _, _ = pairs(200, 4, 0.5)
    R, t = absolute_orientation(x, y, w, limb, 4)
    for k in range(4):
        a, b, v = x[limb == k], y[limb == k], w[limb == k]
        mean_a, mean_b = np.average(a, axis=0, weights=v), np.average(b, axis=0, weights=v)
        turn, _ = Rotation.align_vectors(b - mean_b, a - mean_a, weights=v)
        np.testing.assert_allclose(R[k], turn.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(t[k], mean_b - turn.apply(mean_a), atol=1e-9)


def test_mirrored_pairs_give_no_mirror():
    x = RANDOM.normal(size=(50, 3))
    R, _ = absolute_orientation(x, x * [1.0, 1.0, -1.0], np.ones(50), np.zeros(50, int), 1)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_one_pair_shifts_and_does_not_turn():
    R, t = absolute_orientation(np.ones((1, 3)), np.array([[2.0, 1.0, 1.0]]), np.ones(1), np.zeros(1, int), 1)
    np.testing.assert_allclose(R[0], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(t[0], [1.0, 0.0, 0.0], atol=1e-9)


def test_pairs_on_a_line_turn_it_by_the_least():
    """The turn about the line is open: with a preference for none it is the smallest that takes line to line."""
    source = np.linspace(-1.0, 1.0, 5)[:, None] * [1.0, 0.0, 0.0]
    target = np.linspace(-1.0, 1.0, 5)[:, None] * [0.0, 1.0, 0.0]
    R, _ = absolute_orientation(source, target, np.ones(5), np.zeros(5, int), 1, stay=1e-6)
    np.testing.assert_allclose(R[0], se3.exp_so3(np.array([0.0, 0.0, np.pi / 2])), atol=1e-5)


def test_the_preference_counts_as_pairs_that_stay():
    """`stay` is the same as pairs at rest with a quarter of it as second moment along every axis."""
    x, y, w, limb, _, _ = pairs(20, 1, 0.3)
    corners = np.sqrt(0.5 * 8.0 / 4.0) * np.concatenate([np.eye(3), -np.eye(3)])  # second moment 8 / 4
    mean = np.average(x, axis=0, weights=w), np.average(y, axis=0, weights=w)
    a, b = np.concatenate([x - mean[0], corners]), np.concatenate([y - mean[1], corners])
    expected, _ = absolute_orientation(a, b, np.append(w, np.ones(6)), np.zeros(26, int), 1)
    R, _ = absolute_orientation(x, y, w, limb, 1, stay=8.0)
    np.testing.assert_allclose(R, expected, atol=1e-9)


def test_a_limb_is_moved_as_its_points_are():
    frames = np.concatenate([se3.exp_so3(RANDOM.normal(size=(3, 3))).reshape(3, 9), RANDOM.normal(size=(3, 3))], axis=1)
    R, t, x = se3.exp_so3(RANDOM.normal(size=(3, 3))), RANDOM.normal(size=(3, 3)), RANDOM.normal(size=3)
    for before, after, turn, shift in zip(frames, move(frames, R, t), R, t):
        world = before[:9].reshape(3, 3) @ x + before[9:]
        np.testing.assert_allclose(after[:9].reshape(3, 3) @ x + after[9:], turn @ world + shift, atol=1e-12)


def test_bad_pairs_are_told():
    x = np.zeros((2, 3))
    with pytest.raises(ObservationError, match="pairs of shape"):
        absolute_orientation(x, x[:1], np.ones(2), np.zeros(2, int), 1)
    with pytest.raises(ObservationError, match="not finite"):
        absolute_orientation(x + np.nan, x, np.ones(2), np.zeros(2, int), 1)
    with pytest.raises(ObservationError, match="negative"):
        absolute_orientation(x, x, -np.ones(2), np.zeros(2, int), 1)
