"""Rigid fits of a few points, and the likelihood of points with the pose integrated out: numba."""

import math

import numpy as np

from kinefit._jit import jit

_HALF_LOG = 1.5 * math.log(2 * math.pi)
_LOG_ROTATIONS = math.log(8 * math.pi**2) - 1.5 * math.log(2 * math.pi)
_MIN_CURVATURE = 1 / (2 * math.pi)  # [1/rad²] curvature whose Gaussian has the width of a whole turn


@jit
def largest_quaternion(N, q):
    """Write to q (4,) the unit eigenvector (w, x, y, z) of the largest eigenvalue of N (4, 4) (Jacobi); destroys N."""
    V = np.eye(4)
    for _ in range(12):
        off = 0.0
        for i in range(3):
            for j in range(i + 1, 4):
                off += N[i, j] * N[i, j]
        if off <= 1e-30 * (N[0, 0] ** 2 + N[1, 1] ** 2 + N[2, 2] ** 2 + N[3, 3] ** 2):
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if N[i, j] == 0.0:
                    continue
                theta = (N[j, j] - N[i, i]) / (2 * N[i, j])
                t = 1 / (abs(theta) + math.sqrt(theta * theta + 1))
                t = t if theta >= 0 else -t
                c = 1 / math.sqrt(t * t + 1)
                s = t * c
                for k in range(4):
                    a, b = N[k, i], N[k, j]
                    N[k, i], N[k, j] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = N[i, k], N[j, k]
                    N[i, k], N[j, k] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = V[k, i], V[k, j]
                    V[k, i], V[k, j] = c * a - s * b, s * a + c * b
    best = 0
    for i in range(1, 4):
        best = i if N[i, i] > N[best, best] else best
    for k in range(4):
        q[k] = V[k, best]


@jit
def rigid(n, x, y, w, R, t, H):
    """Weighted rigid fit of x[:n] (n, 3) to y[:n] (n, 3) [m], weights w (n,) [1/m²]: returns Σ w |y - R x - t|².

    Writes R (3, 3), t (3,) and H = Σ w (|x|² I - x xᵀ) (3, 3) about the weighted centroid, in the frame of x.
    """
    total = 0.0
    a, b = np.zeros(3), np.zeros(3)
    for i in range(n):
        total += w[i]
        for k in range(3):
            a[k] += w[i] * x[i, k]
            b[k] += w[i] * y[i, k]
    a /= total
    b /= total
    S = np.zeros((3, 3))
    H[:] = 0.0
    for i in range(n):
        x0, x1, x2 = x[i, 0] - a[0], x[i, 1] - a[1], x[i, 2] - a[2]
        for k in range(3):
            d = w[i] * (y[i, k] - b[k])
            S[0, k] += x0 * d
            S[1, k] += x1 * d
            S[2, k] += x2 * d
        H[0, 0] += w[i] * (x1 * x1 + x2 * x2)
        H[1, 1] += w[i] * (x0 * x0 + x2 * x2)
        H[2, 2] += w[i] * (x0 * x0 + x1 * x1)
        H[0, 1] -= w[i] * x0 * x1
        H[0, 2] -= w[i] * x0 * x2
        H[1, 2] -= w[i] * x1 * x2
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    N = np.empty((4, 4))
    N[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
    N[1, 1] = S[0, 0] - S[1, 1] - S[2, 2]
    N[2, 2] = S[1, 1] - S[0, 0] - S[2, 2]
    N[3, 3] = S[2, 2] - S[0, 0] - S[1, 1]
    N[0, 1] = N[1, 0] = S[1, 2] - S[2, 1]
    N[0, 2] = N[2, 0] = S[2, 0] - S[0, 2]
    N[0, 3] = N[3, 0] = S[0, 1] - S[1, 0]
    N[1, 2] = N[2, 1] = S[0, 1] + S[1, 0]
    N[1, 3] = N[3, 1] = S[2, 0] + S[0, 2]
    N[2, 3] = N[3, 2] = S[1, 2] + S[2, 1]
    q = np.empty(4)
    largest_quaternion(N, q)
    qw, qx, qy, qz = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
    rss = 0.0
    for k in range(3):
        t[k] = b[k] - R[k, 0] * a[0] - R[k, 1] * a[1] - R[k, 2] * a[2]
    for i in range(n):
        for k in range(3):
            e = y[i, k] - t[k] - R[k, 0] * x[i, 0] - R[k, 1] * x[i, 1] - R[k, 2] * x[i, 2]
            rss += w[i] * e * e
    return rss


@jit
def least_squares(n, x, y, w, H):
    """The least Σ w |y - R x - t|² over rigid motions, without the motion; writes H like `rigid`.

    |x|² + |y|² - 2λ, λ the largest eigenvalue of Horn's matrix, by Newton's method from above on its characteristic
    polynomial (Theobald 2005); where two eigenvalues nearly agree, as for points on a line, by `rigid`.
    """
    total = 0.0
    a0 = a1 = a2 = b0 = b1 = b2 = 0.0
    for i in range(n):
        v = w[i]
        total += v
        a0, a1, a2 = a0 + v * x[i, 0], a1 + v * x[i, 1], a2 + v * x[i, 2]
        b0, b1, b2 = b0 + v * y[i, 0], b1 + v * y[i, 1], b2 + v * y[i, 2]
    a0, a1, a2, b0, b1, b2 = a0 / total, a1 / total, a2 / total, b0 / total, b1 / total, b2 / total
    s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = 0.0
    xx = yy = zz = xy = xz = yz = square = 0.0
    for i in range(n):
        v, x0, x1, x2 = w[i], x[i, 0] - a0, x[i, 1] - a1, x[i, 2] - a2
        y0, y1, y2 = y[i, 0] - b0, y[i, 1] - b1, y[i, 2] - b2
        v0, v1, v2 = v * x0, v * x1, v * x2
        xx, yy, zz, xy, xz, yz = xx + v0 * x0, yy + v1 * x1, zz + v2 * x2, xy + v0 * x1, xz + v0 * x2, yz + v1 * x2
        s00, s01, s02 = s00 + v0 * y0, s01 + v0 * y1, s02 + v0 * y2
        s10, s11, s12 = s10 + v1 * y0, s11 + v1 * y1, s12 + v1 * y2
        s20, s21, s22 = s20 + v2 * y0, s21 + v2 * y1, s22 + v2 * y2
        square += v * (y0 * y0 + y1 * y1 + y2 * y2)
    H[0, 0], H[1, 1], H[2, 2] = yy + zz, xx + zz, xx + yy
    H[0, 1] = H[1, 0] = -xy
    H[0, 2] = H[2, 0] = -xz
    H[1, 2] = H[2, 1] = -yz
    whole = 0.5 * (xx + yy + zz + square)
    if not whole > 0.0:
        return 0.0
    if n == 2:
        e = math.sqrt(xx + yy + zz) - math.sqrt(square)
        return e * e
    # of the matrix divided by `whole`: λ⁴ + c2 λ² + c1 λ + c0, the largest root at most 1
    s00, s01, s02, s10, s11 = s00 / whole, s01 / whole, s02 / whole, s10 / whole, s11 / whole
    s12, s20, s21, s22 = s12 / whole, s20 / whole, s21 / whole, s22 / whole
    sums = s00 * s00 + s01 * s01 + s02 * s02 + s10 * s10 + s11 * s11 + s12 * s12 + s20 * s20 + s21 * s21 + s22 * s22
    c2 = -2.0 * sums
    det = s00 * (s11 * s22 - s12 * s21) - s01 * (s10 * s22 - s12 * s20) + s02 * (s10 * s21 - s11 * s20)
    c1 = -8.0 * det
    m00, m11 = s00 * s00 + s01 * s01 + s02 * s02, s10 * s10 + s11 * s11 + s12 * s12
    m22 = s20 * s20 + s21 * s21 + s22 * s22
    m01, m02 = s00 * s10 + s01 * s11 + s02 * s12, s00 * s20 + s01 * s21 + s02 * s22
    m12 = s10 * s20 + s11 * s21 + s12 * s22
    minors = m00 * m11 - m01 * m01 + m00 * m22 - m02 * m02 + m11 * m22 - m12 * m12
    c0 = sums * sums - 4.0 * minors
    root, slope = 1.0, 1.0
    for _ in range(50):
        slope = (4.0 * root * root + 2.0 * c2) * root + c1
        if slope < 1e-3:
            break
        value = ((root * root + c2) * root + c1) * root + c0
        step = value / slope
        root -= step
        if abs(step) < 1e-14:
            break
    if slope < 1e-3:
        R, t, G = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        return rigid(n, x, y, w, R, t, G)
    rss = 2.0 * whole * (1.0 - root)
    return rss if rss > 0.0 else 0.0


@jit
def evidence(n, x, y, sigma, work):
    """-log density of n points of a rigid segment with its pose integrated out; and the weighted sum of squares.

    x, y (n, 3) [m] in the segment and in space, sigma (n,) [m] per coordinate, work: scratch (8 + n // 3, 3).

    ∫∫ Π N(y; R x + t, σ²) dt dR = Π (2πσ²)^-3/2 (2π/W)^3/2 (2π)^3/2 det(H)^-1/2 / 8π² exp(-rss/2), W = Σ 1/σ².
    """
    if n == 0:
        return 0.0, 0.0
    H, w = work[0:3], work[3:].reshape(-1)
    total, cost = 0.0, 0.0
    for i in range(n):
        w[i] = 1 / (sigma[i] * sigma[i])
        total += w[i]
        cost += _HALF_LOG + 3 * math.log(sigma[i])
    rss = 0.0
    if n > 1:
        rss = least_squares(n, x, y, w, H)
        a, b, c = H[0, 0] + _MIN_CURVATURE, H[1, 1] + _MIN_CURVATURE, H[2, 2] + _MIN_CURVATURE
        d, e, f = H[0, 1], H[0, 2], H[1, 2]
        det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
        turn = _LOG_ROTATIONS + 0.5 * math.log(det if det > 1e-12 else 1e-12)
        cost += turn if turn > 0.0 else 0.0
    return 0.5 * rss + cost - _HALF_LOG + 1.5 * math.log(total), rss


@jit
def place_joint(n, x, y, sigma, joint, out):
    """Write to out (3,) [m] a segment's joint by a rigid fit; returns its mean variance per coordinate [m²]."""
    R, t, H, w = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(n)
    total = 0.0
    for i in range(n):
        w[i] = 1 / (sigma[i] * sigma[i])
        total += w[i]
    rigid(n, x, y, w, R, t, H)
    r = np.empty(3)
    for k in range(3):
        out[k] = t[k] + R[k, 0] * joint[0] + R[k, 1] * joint[1] + R[k, 2] * joint[2]
        r[k] = joint[k]
        for i in range(n):
            r[k] -= w[i] * x[i, k] / total
    a, b, c = H[0, 0] + _MIN_CURVATURE, H[1, 1] + _MIN_CURVATURE, H[2, 2] + _MIN_CURVATURE
    d, e, f = H[0, 1], H[0, 2], H[1, 2]
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    i00, i11, i22 = b * c - f * f, a * c - e * e, a * b - d * d
    i01, i02, i12 = e * f - d * c, d * f - b * e, d * e - a * f
    square = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    inner = r[0] ** 2 * i00 + r[1] ** 2 * i11 + r[2] ** 2 * i22
    inner += 2 * (r[0] * r[1] * i01 + r[0] * r[2] * i02 + r[1] * r[2] * i12)
    return 1 / total + (square * (i00 + i11 + i22) - inner) / (3 * det)
