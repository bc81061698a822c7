"""Small dense products and solutions: libraries that start threads for each are many times slower."""

from __future__ import annotations

import math

from kinefit._jit import jit


@jit
def gram(A, B, out):
    """Add Aᵀ B to out (n, m), for A (N, n) and B (N, m)."""
    N = A.shape[0]
    for i in range(0, N - 1, 2):  # two at a time: rows of one point have the same zeros
        p, q = B[i], B[i + 1]
        for k in range(A.shape[1]):
            a, b = A[i, k], A[i + 1, k]
            if a != 0.0 or b != 0.0:
                line = out[k]
                for j in range(line.size):
                    line[j] += a * p[j] + b * q[j]
    if N % 2:
        p = B[N - 1]
        for k in range(A.shape[1]):
            a = A[N - 1, k]
            if a != 0.0:
                line = out[k]
                for j in range(line.size):
                    line[j] += a * p[j]


@jit
def along(data, segment, centre, screws, dof_parent, last_dof, J):
    """J (N, n): derivatives of the points of rows, data (6 or more, N), along their directions."""
    J[:] = 0.0
    for i in range(segment.size):
        x, y, z = data[0, i] - centre[0], data[1, i] - centre[1], data[2, i] - centre[2]
        nx, ny, nz = data[3, i], data[4, i], data[5, i]
        ax, ay, az = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        row = J[i]
        row[0], row[1], row[2], row[3], row[4], row[5] = nx, ny, nz, ax, ay, az
        d = last_dof[segment[i]]
        while d >= 6:
            t = screws[d - 6]
            row[d] = t[0] * nx + t[1] * ny + t[2] * nz + t[3] * ax + t[4] * ay + t[5] * az
            d = dof_parent[d]


@jit
def joint_columns(parents, frames, offsets, out):
    """out (S, 3, q): derivatives of joint centres in the world, from those of their offsets in parents (S, 3, q)."""
    for s in range(parents.size):
        p = parents[s]
        if p < 0:
            out[s] = 0.0
            continue
        f, d, above, here = frames[p], offsets[s], out[p], out[s]
        for i in range(3):
            a, b, c = f[3 * i], f[3 * i + 1], f[3 * i + 2]
            for k in range(d.shape[1]):
                here[i, k] = above[i, k] + a * d[0, k] + b * d[1, k] + c * d[2, k]


@jit
def point_columns(data, segment, group, frames, joints, places, out):
    """out (N, q): whitened derivatives of rows, from those of joints (S, 3, q) and of places in segments (M, 3, q)."""
    for i in range(segment.size):
        f, joint, place, row = frames[segment[i]], joints[segment[i]], places[group[i]], out[i]
        w = math.sqrt(data[7, i])
        x, y, z = w * data[3, i], w * data[4, i], w * data[5, i]
        a, b, c = f[0] * x + f[3] * y + f[6] * z, f[1] * x + f[4] * y + f[7] * z, f[2] * x + f[5] * y + f[8] * z
        for k in range(row.size):
            row[k] = (
                x * joint[0, k] + y * joint[1, k] + z * joint[2, k]
                + a * place[0, k] + b * place[1, k] + c * place[2, k]
            )  # fmt: skip
