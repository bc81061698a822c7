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
