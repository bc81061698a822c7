"""Products and inverses of matrices (3, 3) in plain loops: numpy's take seconds to compile inside a kernel."""

from __future__ import annotations

from kinefit._jit import jit


@jit
def copy(A, out):
    """out = A."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, j]


@jit
def times(A, B, out):
    """out = A B."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@jit
def times_transposed(A, B, out):
    """out = A Bᵀ."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[j, 0] + A[i, 1] * B[j, 1] + A[i, 2] * B[j, 2]


@jit
def inverse(A, out):
    """out = A⁻¹, by cofactors."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for m in range(3):
            p, q = (m + 1) % 3, (m + 2) % 3
            out[m, i] = A[j, p] * A[k, q] - A[j, q] * A[k, p]
    scale = 1.0 / (A[0, 0] * out[0, 0] + A[0, 1] * out[1, 0] + A[0, 2] * out[2, 0])
    for i in range(3):
        for j in range(3):
            out[i, j] *= scale
