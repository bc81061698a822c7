"""Compiled values of closures, and their derivatives by the degrees of freedom."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit


@jit
def rotation_vector(R, e):
    """Write the rotation vector of R (3, 3), of length 0..π, to e (3,) [rad], by the largest quaternion component."""
    q, trace = np.empty(4), R[0, 0] + R[1, 1] + R[2, 2]
    best, k = trace, 3
    for i in range(3):
        if R[i, i] > best:
            best, k = R[i, i], i
    if k == 3:
        q[3] = 1.0 + trace
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q[k] = 1.0 + 2.0 * R[k, k] - trace
        q[i], q[j], q[3] = R[i, k] + R[k, i], R[j, k] + R[k, j], R[j, i] - R[i, j]
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    sign = -1.0 if q[3] < 0.0 else 1.0
    angle = 2.0 * math.atan2(length, sign * q[3])
    scale = sign * angle / length if length > 1e-300 else 0.0
    for i in range(3):
        e[i] = scale * q[i]


@jit
def turn_rows(e, M, out):
    """Write J_l⁻¹(e) Mᵀ to out (3, 3), for a rotation vector e (3,) and a frame M (3, 3); Barfoot, eq. 7.77."""
    t2 = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    if t2 < 1e-6:
        d = 1.0 / 12.0 + t2 / 720.0
    else:
        half = 0.5 * math.sqrt(t2)
        d = (1.0 - half * math.cos(half) / math.sin(half)) / t2
    for c in range(3):
        a, b, g = M[c, 0], M[c, 1], M[c, 2]
        x, y, z = e[1] * g - e[2] * b, e[2] * a - e[0] * g, e[0] * b - e[1] * a
        out[0, c] = a - 0.5 * x + d * (e[1] * z - e[2] * y)
        out[1, c] = b - 0.5 * y + d * (e[2] * x - e[0] * z)
        out[2, c] = g - 0.5 * z + d * (e[0] * y - e[1] * x)


@jit
def close(
    frames, screws, centre, segments, rest, directions, first, rigid, turns, dof_parent, last_dof, value, J,
):  # fmt: skip
    """Write the values (m,) of K closures, and their Jacobian J (m, n) unless it is empty.

    frames (S, 12), screws (D, 6): of a pose about centre (3,). segments (K, 2): -1 for the world. rest (K, 2, 3) [m]:
    points in the root frame at rest, or in the world. directions (m, 3): in the other frame. first (K + 1,): first
    equation of each closure. rigid (K,) bool: the last three equations of these are rotations relative to frames turns
    (K, 3, 3) in the other frame.
    """
    R, x = np.empty((2, 3, 3)), np.empty((2, 3))
    M, relative, e, rows, a = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(6)
    for k in range(segments.shape[0]):
        for side in range(2):
            s = segments[k, side]
            for i in range(3):
                x[side, i] = frames[s, 9 + i] if s >= 0 else 0.0
                for j in range(3):
                    R[side, i, j] = frames[s, 3 * i + j] if s >= 0 else (1.0 if i == j else 0.0)
                    x[side, i] += R[side, i, j] * rest[k, side, j]
        shifts = first[k + 1] - 3 if rigid[k] else first[k + 1]
        if rigid[k]:
            for i in range(3):
                for j in range(3):
                    M[i, j] = R[1, i, 0] * turns[k, 0, j] + R[1, i, 1] * turns[k, 1, j] + R[1, i, 2] * turns[k, 2, j]
            for i in range(3):
                for j in range(3):
                    relative[i, j] = M[0, i] * R[0, 0, j] + M[1, i] * R[0, 1, j] + M[2, i] * R[0, 2, j]
            rotation_vector(relative, e)
            turn_rows(e, M, rows)
        for q in range(first[k], first[k + 1]):
            if q < shifts:
                value[q] = 0.0
                for i in range(3):
                    a[i] = (
                        R[1, i, 0] * directions[q, 0] + R[1, i, 1] * directions[q, 1] + R[1, i, 2] * directions[q, 2]
                    )
                    value[q] += a[i] * (x[0, i] - x[1, i])
                u, v, w = x[0, 0] - centre[0], x[0, 1] - centre[1], x[0, 2] - centre[2]
                a[3], a[4], a[5] = v * a[2] - w * a[1], w * a[0] - u * a[2], u * a[1] - v * a[0]
            else:
                value[q] = e[q - shifts]
                for i in range(3):
                    a[i], a[3 + i] = 0.0, rows[q - shifts, i]
            if J.shape[0] == 0:
                continue
            for side in range(2):
                s, sign = segments[k, side], 1.0 - 2.0 * side
                if s < 0:
                    continue
                for i in range(6):
                    J[q, i] += sign * a[i]
                d = last_dof[s]
                while d >= 6:
                    total = 0.0
                    for i in range(6):
                        total += a[i] * screws[d - 6, i]
                    J[q, d] += sign * total
                    d = dof_parent[d]
