"""Blocks of unknowns eliminated from the equations of shared parameters."""

import numpy as np
import pytest

from kinefit.solving.bundle.arrow import Arrow, Blocks, assembled


def dense(arrow):
    """The same equations as one matrix, parameters first."""
    p, sizes = len(arrow.g), [blocks.g.size for blocks in arrow.blocks]
    A, b, at = np.zeros((p + sum(sizes),) * 2), np.concatenate([arrow.g, *(k.g.ravel() for k in arrow.blocks)]), p
    A[:p, :p] = arrow.H
    for blocks in arrow.blocks:
        for H, B in zip(blocks.H, blocks.B, strict=True):
            own = slice(at, at + len(H))
            A[own, own], A[own, :p], A[:p, own] = H, B, B.T
            at += len(H)
    return A, b


@pytest.fixture
def arrow():
    random, kinds, H = np.random.default_rng(0), [], np.zeros((4, 4))
    for frames, n in ((3, 6), (5, 3)):
        J = random.normal(size=(frames, 20, n + 4))
        whole = J.swapaxes(1, 2) @ J
        H += whole[:, n:, n:].sum(axis=0)
        kinds.append(Blocks(whole[:, :n, :n], random.normal(size=(frames, n)), whole[:, :n, n:]))
    return Arrow(H, random.normal(size=4), tuple(kinds))


def test_a_step_is_the_dense_one_and_predicts_the_fall(arrow):
    A, b = dense(arrow)
    (delta, moves), fall = arrow.relative_step(0.0)
    x = np.concatenate([delta, *(move.ravel() for move in moves)])
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-5, atol=1e-8)
    assert fall == pytest.approx(2 * b @ x - x @ A @ x, rel=1e-6)
    (delta, moves), fall = arrow.step(np.full(4, 0.5), [np.full(k.g.shape, 2.0) for k in arrow.blocks])
    x = np.concatenate([delta, *(move.ravel() for move in moves)])
    damped = A + np.diag(np.repeat([0.5, 2.0], [4, len(A) - 4]))
    np.testing.assert_allclose(x, np.linalg.solve(damped, b), rtol=1e-5, atol=1e-8)
    assert fall == pytest.approx(2 * b @ x - x @ A @ x, rel=1e-6)


def test_covariances_are_those_of_the_dense_inverse(arrow):
    cov, (poses, points) = arrow.covariances()
    expected = np.linalg.inv(dense(arrow)[0])
    np.testing.assert_allclose(cov, expected[:4, :4], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(poses[1], expected[10:16, 10:16], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(points[4], expected[-3:, -3:], rtol=1e-5, atol=1e-8)


def test_what_is_held_does_not_move(arrow):
    held = np.zeros((3, 6), bool)
    held[1, 2:4] = True
    moves = arrow.holding(held).relative_step(0.0)[0][1]
    assert (moves[0][held] == 0.0).all() and (moves[0][~held] != 0.0).all()


def test_measurements_are_summed_by_camera_and_block():
    random = np.random.default_rng(1)
    camera, block = np.array([0, 1, 1, 0]), np.array([2, 0, 2, 2])
    A = random.normal(size=(4, 2, 2 + 3 + 1))
    free = np.array([[False, True, True], [False, False, True]])
    arrow = assembled(A.swapaxes(1, 2) @ A, camera, block, free, 3)
    J = np.zeros((8, 4 + 9))
    for k, (c, f) in enumerate(zip(camera, block, strict=True)):
        J[2 * k : 2 * k + 2, 2 * c : 2 * c + 2] = A[k, :, :2]
        J[2 * k : 2 * k + 2, 4 + 3 * f : 7 + 3 * f] = A[k, :, 2:5]
    H, g = dense(arrow)
    J = np.delete(J, 2, axis=1)  # the second camera's first parameter is fixed
    np.testing.assert_allclose(H, J.T @ J, atol=1e-12)
    np.testing.assert_allclose(g, J.T @ A[..., -1].ravel(), atol=1e-12)
