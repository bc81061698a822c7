"""Small dense sums and solutions, one after another: libraries that start threads for each are many times slower."""

from __future__ import annotations

import math

from kinefit._jit import jit


@jit
def gram(A, B, out):
    """Add Aᵀ B to out (n, m), for A (N, n) and B (N, m)."""
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    out[k, j] += a * B[i, j]


@jit
def solve(A, right):
    """Solve A x = right in place, A (n, n) symmetric and positive, right (n, m); False where it is not positive."""
    n, m = right.shape
    for k in range(n):
        for i in range(k + 1):
            s = A[k, i]
            for j in range(i):
                s -= A[k, j] * A[i, j]
            if i < k:
                A[k, i] = s / A[i, i]
            elif s > 0.0:
                A[k, k] = math.sqrt(s)
            else:
                return False
    for k in range(n):
        for j in range(k):
            a = A[k, j]
            for q in range(m):
                right[k, q] -= a * right[j, q]
        a = 1.0 / A[k, k]
        for q in range(m):
            right[k, q] *= a
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            a = A[j, k]
            for q in range(m):
                right[k, q] -= a * right[j, q]
        a = 1.0 / A[k, k]
        for q in range(m):
            right[k, q] *= a
    return True


@jit
def along(data, segment, centre, screws, dof_parent, last_dof, J):
    """J (N, n): how far the points of rows, data (6 or more, N), move along their directions."""
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
