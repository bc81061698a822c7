"""Compiled products of multivectors over arrays, and motions of points by motors."""

from __future__ import annotations

from kinefit._jit import jit

_BLOCK = 512  # elements at a time, whose coefficients fit into the nearest cache


@jit
def product(a, b, terms, signs, out):
    """Sum out[k] += sign · a[i] · b[j] over all terms (i, j, k).

    Parameters: a (A, N or 1) and b (B, N or 1) coefficients, terms (T, 3) int64, signs (T,). Out: out (K, N), zero
    at first.
    """
    n = out.shape[1]
    one_a, one_b = a.shape[1] == 1, b.shape[1] == 1
    for start in range(0, n, _BLOCK):
        end = start + _BLOCK if start + _BLOCK < n else n
        for t in range(terms.shape[0]):
            x, y, z, sign = a[terms[t, 0]], b[terms[t, 1]], out[terms[t, 2]], signs[t]
            if one_a and one_b:
                z[0] += sign * x[0] * y[0]
            elif one_a:
                factor = sign * x[0]
                for i in range(start, end):
                    z[i] += factor * y[i]
            elif one_b:
                factor = sign * y[0]
                for i in range(start, end):
                    z[i] += factor * x[i]
            else:
                for i in range(start, end):
                    z[i] += sign * x[i] * y[i]


@jit
def operators(m, out):
    """Matrices of the map X -> M X M̃ of vectors.

    Parameters: m (8, N) motors by 1, e12, e13, e23, e1e, e2e, e3e, e123e. Out: out (5, 5, N) over e1, e2, e3, e, e0.
    """
    for i in range(m.shape[1]):
        w, x, y, z = m[0, i], m[3, i], -m[2, i], m[1, i]  # R = w + I3 (x, y, z), the quaternion with the opposite signs
        dx, dy, dz, d = m[4, i], m[5, i], m[6, i], m[7, i]
        s = w * w + x * x + y * y + z * z
        out[0, 0, i], out[1, 1, i] = w * w + x * x - y * y - z * z, w * w - x * x + y * y - z * z
        out[2, 2, i] = w * w - x * x - y * y + z * z
        out[0, 1, i], out[1, 0, i] = 2.0 * (x * y + w * z), 2.0 * (x * y - w * z)
        out[0, 2, i], out[2, 0, i] = 2.0 * (x * z - w * y), 2.0 * (x * z + w * y)
        out[1, 2, i], out[2, 1, i] = 2.0 * (y * z + w * x), 2.0 * (y * z - w * x)
        # M = R + ½ e t R gives the e-part of M R̃; its vector is −½ t |R|²
        tx = -2.0 * (dx * w + dy * z - dz * y + d * x)
        ty = -2.0 * (dy * w + dz * x - dx * z + d * y)
        tz = -2.0 * (dz * w + dx * y - dy * x + d * z)
        for j in range(3):
            out[3, j, i] = (tx * out[0, j, i] + ty * out[1, j, i] + tz * out[2, j, i]) / s
            out[j, 3, i], out[4, j, i] = 0.0, 0.0
        out[0, 4, i], out[1, 4, i], out[2, 4, i] = tx, ty, tz
        out[3, 3, i], out[4, 4, i], out[4, 3, i] = s, s, 0.0
        out[3, 4, i] = 0.5 * (tx * tx + ty * ty + tz * tz) / s


@jit
def moved(operator, x, out):
    """Move vectors x (5, N or 1) by operators (5, 5, N or 1). Out: out (5, N)."""
    n = out.shape[1]
    one, single = operator.shape[2] == 1, x.shape[1] == 1
    if one and not single:
        for row in range(5):
            a, b, c = operator[row, 0, 0], operator[row, 1, 0], operator[row, 2, 0]
            d, e = operator[row, 3, 0], operator[row, 4, 0]
            for i in range(n):
                out[row, i] = a * x[0, i] + b * x[1, i] + c * x[2, i] + d * x[3, i] + e * x[4, i]
        return
    for i in range(n):
        j, k = (0 if one else i), (0 if single else i)
        for row in range(5):
            total = 0.0
            for column in range(5):
                total += operator[row, column, j] * x[column, k]
            out[row, i] = total
