"""States of bodies: moving them and the difference between two."""

import numpy as np
import pytest
from tests.oracle import STATES, random_body, state_of

from kinefit.bodies import BodyState
from kinefit.errors import BodyError
from kinefit.geometry import se3

BODY = random_body(0)


@pytest.mark.parametrize("kind", STATES)
@pytest.mark.parametrize("size", [1.0, 1e-7, 0.0])
def test_difference_is_the_inverse_of_retract(kind, size):
    state = state_of(BODY, kind)
    delta = size * np.random.default_rng(5).uniform(-1.5, 1.5, BODY.tree.n_dofs)
    np.testing.assert_allclose(state.difference(state.retract(delta)), delta, atol=1e-14 + 1e-12 * size)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), [[0.6, 0.0, -0.8]], [[-0.36, 0.48, 0.8]]]))
@pytest.mark.parametrize("short", [0.0, 1e-7, 1e-3])
def test_difference_near_half_a_turn(axis, short):
    state = state_of(BODY, "random")
    delta = np.zeros(BODY.tree.n_dofs)
    delta[3:6] = (np.pi - short) * axis
    other = state.retract(delta)
    found = state.difference(other)
    np.testing.assert_allclose(state.retract(found).T_world_root, other.T_world_root, atol=1e-12)
    assert abs(np.linalg.norm(found[3:6]) - (np.pi - short)) < 1e-7
    if short:
        np.testing.assert_allclose(found, delta, atol=1e-9)


def test_difference_is_the_logarithm():
    for seed in range(20):
        a, b = state_of(BODY, "random", seed), state_of(BODY, "random", seed + 100)
        expected = se3.log_so3(b.T_world_root[:3, :3] @ a.T_world_root[:3, :3].T)
        np.testing.assert_allclose(a.difference(b)[3:6], expected, atol=1e-12)
        np.testing.assert_allclose(a.difference(b)[:3], b.T_world_root[:3, 3] - a.T_world_root[:3, 3])
        np.testing.assert_allclose(a.difference(b)[6:], b.angles - a.angles)


def test_the_root_turns_about_its_own_origin():
    state = state_of(BODY, "random")
    turned = state.retract(np.r_[np.zeros(3), 0.3, -0.2, 0.5, np.zeros(BODY.tree.n_dofs - 6)])
    np.testing.assert_array_equal(turned.T_world_root[:3, 3], state.T_world_root[:3, 3])
    np.testing.assert_allclose(
        turned.T_world_root[:3, :3], se3.exp_so3([0.3, -0.2, 0.5]) @ state.T_world_root[:3, :3], atol=1e-15
    )


def test_many_small_steps_leave_a_rotation():
    state = BodyState(np.eye(4), np.zeros(0))
    delta = np.r_[0.0, 0, 0, 0.01, 0.02, -0.01]
    for _ in range(3000):
        state = state.retract(delta)
    R = state.T_world_root[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-11)


def test_a_state_is_frozen_and_its_own():
    T, angles = np.eye(4), np.zeros(3)
    state = BodyState(T, angles)
    T[0, 3] = angles[0] = 5.0
    assert state.T_world_root[0, 3] == 0 and state.angles[0] == 0
    for array in (state.T_world_root, state.angles):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_arrays_of_any_layout_are_taken():
    """Kernels are compiled for C order: another must not reach them."""
    T = se3.exp(np.arange(6.0))
    state = BodyState(np.asfortranarray(T), np.zeros(6)[::2])
    assert state.T_world_root.flags.c_contiguous and state.angles.flags.c_contiguous
    np.testing.assert_array_equal(state.T_world_root, T)


@pytest.mark.parametrize("length", [0, 6, 8, 10])
def test_a_step_of_another_length_is_refused(length):
    with pytest.raises(BodyError, match="Give 9 numbers"):
        BodyState(np.eye(4), np.zeros(3)).retract(np.zeros(length))
