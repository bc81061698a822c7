"""Plücker lines and planes: distances of points and lines to them, and their derivatives (P1 2.3, P3 eqs. 4-5).

A line is (n, m): unit direction n and moment m = x × n of any of its points x [m]. A plane is (n, d): unit normal and
n·x = d [m]. Shapes are given for one leading axis (N,); all functions but `perpendiculars` take any leading axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError


def _unit(v: NDArray, what: str) -> NDArray:
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm)) or np.any(norm < 1e-12):
        raise ObservationError(f"{what} of length zero or not finite", remedy="Give two different points.")
    return v / norm


def perpendiculars(directions: NDArray) -> tuple[NDArray, NDArray]:
    """Two unit directions (N, 3) each, orthogonal to unit directions (N, 3) and to each other."""
    first = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(directions, first)


def line_through(a: NDArray, b: NDArray) -> NDArray:
    """Plücker lines (N, 6) from points a to points b, both (N, 3) [m]."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return line_along(a, b - a)


def line_along(x: NDArray, direction: NDArray) -> NDArray:
    """Plücker lines (N, 6) through x (N, 3) [m] along directions (N, 3) of any length."""
    n = _unit(np.asarray(direction, float), "a line's direction")
    return np.concatenate([np.broadcast_to(n, np.broadcast_shapes(n.shape, np.shape(x))), np.cross(x, n)], -1)


def plane_through(line: NDArray, x: NDArray) -> NDArray:
    """Planes (N, 4) = (n, d) through Plücker lines (N, 6) and points (N, 3) [m] off them."""
    foot = np.cross(line[..., :3], line[..., 3:])
    n = _unit(np.cross(line[..., :3], np.asarray(x, float) - foot), "a plane's normal")
    return np.concatenate([n, np.sum(n * x, -1, keepdims=True)], -1)


def move_line(T: NDArray, line: NDArray) -> NDArray:
    """Lines (N, 6) moved by T (N, 4, 4)."""
    n = (T[..., :3, :3] @ line[..., :3, None])[..., 0]
    m = (T[..., :3, :3] @ line[..., 3:, None])[..., 0] + np.cross(T[..., :3, 3], n)
    return np.concatenate([n, m], -1)


def point_line(x: NDArray, line: NDArray) -> NDArray:
    """Residual vectors x × n − m (N, 3) [m] of points and lines; their norms are the distances (P3 eq. 4)."""
    return np.cross(x, line[..., :3]) - line[..., 3:]


def point_plane(x: NDArray, plane: NDArray) -> NDArray:
    """Signed distances n·x − d (N,) [m] of points to planes; the derivative by x is n."""
    return np.sum(plane[..., :3] * x, -1) - plane[..., 3]


def line_plane(line: NDArray, plane: NDArray) -> NDArray:
    """Residuals (N, 4) of lines that should lie in planes: tilt, and offset along the normal.

    The first entry is the sine of the angle between them [rad]; the other three are the vector [m] from the plane to
    the line's foot point along the plane's normal. All four vanish exactly when the line lies in the plane (P1 2.3).
    """
    n_line, n_plane = line[..., :3], plane[..., :3]
    foot = np.cross(n_line, line[..., 3:])
    tilt = np.sum(n_line * n_plane, -1, keepdims=True)
    return np.concatenate([tilt, point_plane(foot, plane)[..., None] * n_plane], -1)


def closest_points(line_a: NDArray, line_b: NDArray) -> tuple[NDArray, NDArray]:
    """Closest points (N, 3) [m] of two lines (N, 6) (of parallel ones: the feet from the origin)."""
    a, b = line_a[..., :3], line_b[..., :3]
    foot_a, foot_b = np.cross(a, line_a[..., 3:]), np.cross(b, line_b[..., 3:])
    gap, across = foot_b - foot_a, np.cross(a, b)
    sine2 = np.sum(across**2, -1)  # not 1 − cos², which loses all digits of small angles
    parallel = sine2 < 1e-24
    safe = np.where(parallel, 1.0, sine2)
    s = np.where(parallel, 0.0, np.sum(np.cross(gap, b) * across, -1) / safe)
    t = np.where(parallel, -np.sum(gap * b, -1), np.sum(np.cross(gap, a) * across, -1) / safe)
    return foot_a + s[..., None] * a, foot_b + t[..., None] * b
