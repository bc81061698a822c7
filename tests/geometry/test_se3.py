"""Twists and rigid motions: group axioms everywhere, and against matrix exponentials and central differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from kinefit.geometry import se3

REGIMES = ("uniform", "near identity", "near pi", "at the series' end")


def twists(regime, count=40, seed=0):
    random = np.random.default_rng(seed)
    axis = random.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = {
        "uniform": random.uniform(0, 3.1, (count, 1)),
        "near identity": 1e-7 * random.random((count, 1)),
        "near pi": np.pi - 1e-7 * random.random((count, 1)),
        "at the series' end": 0.5 + np.linspace(-1e-6, 1e-6, count)[:, None],
    }[regime]
    return np.concatenate([random.normal(size=(count, 3)), angle * axis], axis=1)


@pytest.fixture(params=REGIMES)
def xi(request):
    return twists(request.param)


def matrix(xi):
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.hat(xi[3:]), xi[:3]
    return out


any_twist = st.tuples(*[st.floats(-2, 2)] * 3, *[st.floats(-1.8, 1.8)] * 3).map(np.array)
tiny_twist = any_twist.map(lambda v: 1e-7 * v)
half_turn = any_twist.filter(lambda v: np.linalg.norm(v[3:]) > 0.1).map(
    lambda v: np.concatenate([v[:3], (np.pi - 1e-7) * v[3:] / np.linalg.norm(v[3:])])
)
all_twists = st.one_of(any_twist, tiny_twist, half_turn)


@given(all_twists, all_twists, all_twists)
def test_group_axioms(a, b, c):
    A, B, C = se3.exp(a), se3.exp(b), se3.exp(c)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    np.testing.assert_allclose(A @ se3.inverse(A), np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3.inverse(A) @ A, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A), atol=1e-12)
    np.testing.assert_allclose(se3.exp(-a), se3.inverse(A), atol=1e-13)
    R = (A @ B)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(R) > 0


def test_nothing_is_the_identity():
    assert np.array_equal(se3.exp(np.zeros(6)), np.eye(4))
    assert np.array_equal(se3.log(np.eye(4)), np.zeros(6))
    assert np.array_equal(se3.left_jacobian_so3(np.zeros(3)), np.eye(3))


def test_exp_is_the_matrix_exponential(xi):
    expected = np.array([expm(matrix(x)) for x in xi])
    np.testing.assert_allclose(se3.exp(xi), expected, atol=5e-14)
    np.testing.assert_allclose(se3.exp_so3(xi[:, 3:]), expected[:, :3, :3], atol=5e-14)


def test_small_twists_keep_all_their_digits():
    xi = np.array([1e-9, -2e-9, 3e-9, 2e-9, 1e-9, -1e-9])
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, rtol=1e-12)


def test_log_is_the_inverse_of_exp(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=2e-12)
    np.testing.assert_allclose(se3.exp(se3.log(se3.exp(xi))), se3.exp(xi), atol=2e-12)


@given(all_twists)
def test_log_turns_by_half_a_turn_at_most(xi):
    assert np.linalg.norm(se3.log(se3.exp(3 * xi))[3:]) <= np.pi + 1e-12


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0.8, 0), (-0.6, 0, 0.8), (1, 1, 1)])
def test_log_of_exactly_half_a_turn(axis):
    n = np.array(axis) / np.linalg.norm(axis)
    R = 2 * np.outer(n, n) - np.eye(3)
    omega = se3.log_so3(R)
    assert abs(np.linalg.norm(omega) - np.pi) < 1e-12
    np.testing.assert_allclose(se3.exp_so3(omega), R, atol=1e-12)


def test_adjoint_moves_twists(xi):
    T = se3.exp(np.random.default_rng(3).normal(size=(len(xi), 6)))
    moved = (se3.adjoint(T) @ xi[..., None])[..., 0]
    np.testing.assert_allclose(se3.exp(moved), T @ se3.exp(xi) @ se3.inverse(T), atol=1e-12)


def test_adjoint_of_a_product():
    A, B = se3.exp(np.random.default_rng(4).normal(size=(2, 20, 6)))
    np.testing.assert_allclose(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=1e-12)


def test_left_jacobian_is_the_series(xi):
    """Σ hat(ω)ⁿ / (n + 1)!, which needs no case for any angle."""
    for x in xi[:10]:
        total, term = np.eye(3), np.eye(3)
        for n in range(1, 60):
            term = term @ se3.hat(x[3:]) / (n + 1)
            total = total + term
        np.testing.assert_allclose(se3.left_jacobian_so3(x[3:]), total, atol=1e-12)


def test_quaternion_round_trip(xi):
    R = se3.exp_so3(xi[:, 3:])
    q = se3.quaternion(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-15)
    assert np.all(q[:, 0] >= 0)
    np.testing.assert_allclose(se3.rotation_from_quaternion(q), R, atol=1e-14)
    np.testing.assert_allclose(se3.rotation_from_quaternion(-3 * q), R, atol=1e-14)


def test_quaternion_of_a_known_turn():
    angle = 0.7
    q = se3.quaternion(se3.exp_so3([0, 0, angle]))
    np.testing.assert_allclose(q, [np.cos(angle / 2), 0, 0, np.sin(angle / 2)], atol=1e-15)


def test_a_point_moves_by_v_plus_omega_cross_x(xi):
    """P3, eq. 2: the twist is the derivative of the motion, ẋ = v + ω × x."""
    x, h = np.array([0.3, -0.2, 0.9]), 1e-6
    speed = (se3.apply(se3.exp(h * xi), x) - se3.apply(se3.exp(-h * xi), x)) / (2 * h)
    np.testing.assert_allclose(speed, xi[:, :3] + np.cross(xi[:, 3:], x), atol=1e-8)


def test_rodrigues_formula():
    """P3, eq. 3: exp of a turn θ about a unit axis is I + sin θ ŵ + (1 − cos θ) ŵ²."""
    for x in twists("uniform", 10):
        theta = np.linalg.norm(x[3:])
        w = se3.hat(x[3:] / theta)
        np.testing.assert_allclose(
            se3.exp_so3(x[3:]), np.eye(3) + np.sin(theta) * w + (1 - np.cos(theta)) * w @ w, atol=1e-14
        )


def test_a_screw_without_pitch_leaves_its_axis_still():
    """P3, eq. 3 and P1 3.1: ξ = θ (q × n, n) turns about the line through q along n."""
    random = np.random.default_rng(5)
    q, n = random.normal(size=(2, 3))
    n /= np.linalg.norm(n)
    T = se3.exp(1.3 * np.concatenate([np.cross(q, n), n]))
    np.testing.assert_allclose(se3.apply(T, q + np.outer([-1, 0, 2], n)), q + np.outer([-1, 0, 2], n), atol=1e-14)
    x = random.normal(size=3)
    axis_distance = [np.linalg.norm(np.cross(p - q, n)) for p in (x, se3.apply(T, x))]
    assert abs(axis_distance[0] - axis_distance[1]) < 1e-14


def test_points_are_laid_onto_others_best():
    random = np.random.default_rng(2)
    T, x = se3.exp(random.normal(size=6)), random.normal(size=(9, 3))
    y = se3.apply(T, x)
    np.testing.assert_allclose(se3.aligned(x, y), T, atol=1e-12)
    weight = np.arange(9.0)
    y[0] += 5.0  # weighs nothing
    np.testing.assert_allclose(se3.aligned(x, y, weight), T, atol=1e-12)
    flat = x * (1.0, 1.0, 0.0)  # a reflection would do as well
    assert np.linalg.det(se3.aligned(flat, -flat)[:3, :3]) == pytest.approx(1.0)


def test_any_leading_shape():
    xi = np.random.default_rng(6).normal(size=(2, 5, 6))
    T = se3.exp(xi)
    assert T.shape == (2, 5, 4, 4) and se3.log(T).shape == (2, 5, 6) and se3.adjoint(T).shape == (2, 5, 6, 6)
    assert se3.left_jacobian_so3(xi[..., 3:]).shape == (2, 5, 3, 3)
    assert se3.quaternion(T[..., :3, :3]).shape == (2, 5, 4)
    np.testing.assert_array_equal(T[1, 3], se3.exp(xi[1, 3]))
    np.testing.assert_array_equal(se3.log(T)[1, 3], se3.log(T[1, 3]))
    assert se3.apply(T[0], np.zeros((5, 3))).shape == (5, 3)


def test_the_nearest_rotation_is_no_reflection():
    random = np.random.default_rng(7)
    R = se3.exp_so3(random.normal(size=(20, 3)))
    np.testing.assert_allclose(se3.nearest_rotation(R * 2.5), R, atol=1e-13)
    mirrored = R @ np.diag([3.0, 2.0, -1.0])  # the axis of least weight gives way
    np.testing.assert_allclose(se3.nearest_rotation(mirrored), R, atol=1e-13)


def test_the_shortest_turn_takes_one_direction_to_another():
    random = np.random.default_rng(0)
    a, b = random.normal(size=(2, 50, 3))
    b[:2] = 3.0 * a[0], -2.0 * a[1]  # the same direction, and the opposite one
    R = se3.shortest_turn(a, b)
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)
    np.testing.assert_allclose((R @ unit(a)[..., None])[..., 0], np.concatenate([unit(a)[:1], unit(b)[1:]]), atol=1e-9)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    angles = np.arccos(np.clip(np.sum(unit(a) * unit(b), axis=1), -1.0, 1.0))
    np.testing.assert_allclose(np.linalg.norm(se3.log_so3(R), axis=1), angles, atol=1e-6)
