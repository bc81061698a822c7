"""Plücker lines and planes: distances, derivatives, and how they move."""

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.geometry import lines, se3

random = np.random.default_rng(0)
A, B, X = random.normal(size=(3, 30, 3))
LINE = lines.line_through(A, B)
PLANE = lines.plane_through(LINE, X)


def differences(function, x, h=1e-6):
    """∂ function / ∂ x in the last axis, one item at a time."""
    return np.stack([(function(x + d) - function(x - d)) / (2 * h) for d in h * np.eye(x.shape[-1])], axis=-1)


def test_a_line_is_a_direction_and_a_moment():
    np.testing.assert_allclose(np.linalg.norm(LINE[:, :3], axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(np.sum(LINE[:, :3] * LINE[:, 3:], axis=1), 0, atol=1e-14)
    np.testing.assert_allclose(lines.line_along(A, 7 * (B - A)), LINE, atol=1e-14)
    np.testing.assert_allclose(lines.line_along(B, B - A), LINE, atol=1e-13)


def test_points_of_a_line_have_no_distance_to_it():
    for t in (-2.0, 0.0, 0.3, 1.0):
        np.testing.assert_allclose(lines.point_line(A + t * (B - A), LINE), 0, atol=1e-13)


def test_distance_of_a_point_to_a_line():
    n = (B - A) / np.linalg.norm(B - A, axis=1, keepdims=True)
    off = (X - A) - np.sum((X - A) * n, axis=1, keepdims=True) * n
    np.testing.assert_allclose(
        np.linalg.norm(lines.point_line(X, LINE), axis=1), np.linalg.norm(off, axis=1), atol=1e-13
    )


def test_a_plane_holds_what_it_was_made_of():
    np.testing.assert_allclose(np.linalg.norm(PLANE[:, :3], axis=1), 1, atol=1e-14)
    for x in (A, B, X):
        np.testing.assert_allclose(lines.point_plane(x, PLANE), 0, atol=1e-12)
    np.testing.assert_allclose(lines.line_plane(LINE, PLANE), 0, atol=1e-12)


def test_distance_and_derivative_of_point_to_plane():
    Y = X + 0.7 * PLANE[:, :3]
    np.testing.assert_allclose(lines.point_plane(Y, PLANE), 0.7, atol=1e-12)
    for k in range(len(Y)):
        np.testing.assert_allclose(differences(lambda x: lines.point_plane(x, PLANE[k]), Y[k]), PLANE[k, :3], atol=1e-9)  # noqa: B023


def test_line_to_plane_tells_tilt_and_offset():
    plane = np.array([0.0, 0.0, 1.0, 2.0])
    above = lines.line_along([5.0, 1.0, 2.5], [1.0, 2.0, 0.0])
    np.testing.assert_allclose(lines.line_plane(above, plane), [0, 0, 0, 0.5], atol=1e-14)
    tilted = lines.line_along([0.0, 0.0, 2.0], [1.0, 0.0, 1.0])
    assert abs(lines.line_plane(tilted, plane)[0] - np.sin(np.pi / 4)) < 1e-14


@pytest.mark.parametrize("size", [1.0, 1e-7])
def test_a_moved_line_is_the_line_of_the_moved_points(size):
    T = se3.exp(size * random.normal(size=(30, 6)))
    np.testing.assert_allclose(
        lines.move_line(T, LINE), lines.line_through(se3.apply(T, A), se3.apply(T, B)), atol=1e-12
    )


def test_motion_changes_no_distance():
    T = se3.exp(random.normal(size=(30, 6)))
    before, after = lines.point_line(X, LINE), lines.point_line(se3.apply(T, X), lines.move_line(T, LINE))
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), np.linalg.norm(before, axis=1), atol=1e-12)


def test_closest_points_of_two_lines():
    other = np.roll(LINE, 1, axis=0)
    p, q = lines.closest_points(LINE, other)
    np.testing.assert_allclose(lines.point_line(p, LINE), 0, atol=1e-11)
    np.testing.assert_allclose(lines.point_line(q, other), 0, atol=1e-11)
    for direction in (LINE[:, :3], other[:, :3]):  # what joins them is at right angles to both
        np.testing.assert_allclose(np.sum((q - p) * direction, axis=1), 0, atol=1e-11)


def test_closest_points_of_lines_that_meet():
    p, q = lines.closest_points(lines.line_through(A, X), lines.line_through(B, X))
    np.testing.assert_allclose(p, X, atol=1e-10)
    np.testing.assert_allclose(q, X, atol=1e-10)


@pytest.mark.parametrize("angle", [1e-3, 1e-5, 1e-6])
def test_closest_points_of_nearly_parallel_lines(angle):
    x = np.array([0.2, 0.1, -0.4])
    a, b = lines.line_along(x, [1.0, 0, 0]), lines.line_along(x, [np.cos(angle), np.sin(angle), 0])
    p, q = lines.closest_points(a, b)
    np.testing.assert_allclose([p, q], [x, x], atol=1e-15 / angle)


@pytest.mark.parametrize("sign", [1, -1])
def test_closest_points_of_parallel_lines_are_across_from_each_other(sign):
    a, b = lines.line_along([3.0, 1, 0], [1.0, 0, 0]), lines.line_along([-7.0, 4, 4], [sign * 2.0, 0, 0])
    p, q = lines.closest_points(a, b)
    np.testing.assert_allclose(q - p, [0, 3, 4], atol=1e-13)


@pytest.mark.parametrize(
    "make",
    [
        lambda: lines.line_through([1.0, 2, 3], [1.0, 2, 3]),
        lambda: lines.line_along([1.0, 2, 3], [0.0, 0, 0]),
        lambda: lines.line_along([1.0, 2, 3], [np.nan, 0, 1]),
        lambda: lines.line_along([1.0, 2, 3], [np.inf, 0, 1]),
        lambda: lines.plane_through(LINE[0], A[0] + 0.5 * (B[0] - A[0])),
    ],
)
def test_what_has_no_direction_is_told(make):
    with pytest.raises(ObservationError, match=r"zero or not finite.*different points"):
        make()


def test_any_leading_shape():
    a, b = A.reshape(2, 15, 3), B.reshape(2, 15, 3)
    line = lines.line_through(a, b)
    assert line.shape == (2, 15, 6)
    np.testing.assert_array_equal(line.reshape(-1, 6), LINE)
    assert lines.plane_through(line, X[0]).shape == (2, 15, 4)
    assert lines.closest_points(line, LINE[0])[0].shape == (2, 15, 3)
