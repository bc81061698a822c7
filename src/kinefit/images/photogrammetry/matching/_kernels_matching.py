"""Compiled least-squares matching of a window in another image, with an affine map, a gain and an offset.

The unknowns are those of Gruen (1985): an affine map of six parameters, and a gain and an offset of the grey values.
The template f is fixed, so its normal matrix over [x f_x, y f_x, x f_y, y f_y, 1, f, f_x, f_y] is set up and factored
once (inverse composition, Baker and Matthews 2004); an iteration samples the other image and solves. A gain that is
not 1 scales the first six, as h = r0 + r1 f(x + d) = r0 + r1 f + r1 (d . grad f).

Compiled quintic B-splines: values of an image between its pixels, from its coefficients.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit

MARGIN = 2  # whole pixels that a value needs on its left; on its right one more
_ONE, _TENTH = np.float32(1.0), np.float32(1.0 / 120.0)


@jit
def weights(t):
    """The six weights of the coefficients about a place, `t` past the third of them; of the type of t."""
    t2 = t * t
    t3, s = t2 * t, 1 - t
    t4, s2 = t2 * t2, s * s
    t5 = t4 * t
    return (
        s2 * s2 * s / 120,
        (26 - 50 * t + 20 * t2 + 20 * t3 - 20 * t4 + 5 * t5) / 120,
        (66 - 60 * t2 + 30 * t4 - 10 * t5) / 120,
        (26 + 50 * t + 20 * t2 - 20 * t3 - 20 * t4 + 10 * t5) / 120,
        (1 + 5 * t + 10 * t2 + 10 * t3 + 5 * t4 - 5 * t5) / 120,
        t5 / 120,
    )


@jit
def slopes(t):
    """Derivatives of the six weights."""
    t2 = t * t
    t3, t4, s = t2 * t, t2 * t2, 1 - t
    return (
        -s * s * s * s / 24,
        (-10 + 8 * t + 12 * t2 - 16 * t3 + 5 * t4) / 24,
        (-24 * t + 24 * t3 - 10 * t4) / 24,
        (10 + 8 * t - 12 * t2 - 16 * t3 + 10 * t4) / 24,
        (1 + 4 * t + 6 * t2 + 4 * t3 - 5 * t4) / 24,
        t4 / 24,
    )


@jit
def weights32(t):
    """The six weights in single precision."""
    k1, k5, k10, k20 = np.float32(1.0), np.float32(5.0), np.float32(10.0), np.float32(20.0)
    k26, k66, k30, k60, k50 = np.float32(26.0), np.float32(66.0), np.float32(30.0), np.float32(60.0), np.float32(50.0)
    t2 = t * t
    t3, s = t2 * t, k1 - t
    t4, s2 = t2 * t2, s * s
    t5 = t4 * t
    both = k20 * (t2 - t4)
    odd = k50 * t - k20 * t3
    w0 = s2 * s2 * s
    w1 = k26 - odd + both + k5 * t5
    w2 = k66 - k60 * t2 + k30 * t4 - k10 * t5
    w3 = k26 + odd + both + k10 * t5
    w4 = k1 + k5 * (t + t4 - t5) + k10 * (t2 + t3)
    return w0 * _TENTH, w1 * _TENTH, w2 * _TENTH, w3 * _TENTH, w4 * _TENTH, t5 * _TENTH


@jit
def value(c, u, v):
    """Value of a spline (H, W), float32, at (u, v) [px], `MARGIN` inside its left and upper edges, and one more."""
    i, j = int(u), int(v)
    a0, a1, a2, a3, a4, a5 = weights32(np.float32(u - i))
    b0, b1, b2, b3, b4, b5 = weights32(np.float32(v - j))
    l, m, r, s, t = i - 2, i - 1, i + 1, i + 2, i + 3
    k = j - 2
    total = b0 * (a0 * c[k, l] + a1 * c[k, m] + a2 * c[k, i] + a3 * c[k, r] + a4 * c[k, s] + a5 * c[k, t])
    k = j - 1
    total += b1 * (a0 * c[k, l] + a1 * c[k, m] + a2 * c[k, i] + a3 * c[k, r] + a4 * c[k, s] + a5 * c[k, t])
    k = j
    total += b2 * (a0 * c[k, l] + a1 * c[k, m] + a2 * c[k, i] + a3 * c[k, r] + a4 * c[k, s] + a5 * c[k, t])
    k = j + 1
    total += b3 * (a0 * c[k, l] + a1 * c[k, m] + a2 * c[k, i] + a3 * c[k, r] + a4 * c[k, s] + a5 * c[k, t])
    k = j + 2
    total += b4 * (a0 * c[k, l] + a1 * c[k, m] + a2 * c[k, i] + a3 * c[k, r] + a4 * c[k, s] + a5 * c[k, t])
    k = j + 3
    return total + b5 * (a0 * c[k, l] + a1 * c[k, m] + a2 * c[k, i] + a3 * c[k, r] + a4 * c[k, s] + a5 * c[k, t])


@jit
def inside(c, u, v):
    """Whether a spline has a value at (u, v) [px]."""
    return u >= 2.0 and v >= 2.0 and u < c.shape[1] - 3.0 and v < c.shape[0] - 3.0


@jit
def values(c, uv, out):
    """Write to out (N,) the values of a spline at points (N, 2) [px]; NaN outside."""
    for n in range(uv.shape[0]):
        u, v = uv[n, 0], uv[n, 1]
        out[n] = value(c, u, v) if inside(c, u, v) else math.nan


# Variance of an interpolated value per variance of white pixel noise, at t between pixels: mean, cos 2 pi t and 4 pi t.
_VALUE = (0.91796918, 0.08175161, 0.00026418)
_SLOPE = (2.67797400, -0.77729295, -0.00624300)


@jit
def value_noise(t):
    """Variance of a value `t` past a pixel, along one axis, in variances of a pixel."""
    angle = 2.0 * math.pi * t
    return _VALUE[0] + _VALUE[1] * math.cos(angle) + _VALUE[2] * math.cos(2.0 * angle)


@jit
def slope_noise(t):
    """Variance of a derivative `t` past a pixel, along its axis, in variances of a pixel [1/px²]."""
    angle = 2.0 * math.pi * t
    return _SLOPE[0] + _SLOPE[1] * math.cos(angle) + _SLOPE[2] * math.cos(2.0 * angle)


@jit
def mean_cosine(t, a, b, n):
    """Mean of cos 2 pi (t + a i + b j) over a window of n x n places i, j about 0."""
    return math.cos(2.0 * math.pi * t) * _dirichlet(a, n) * _dirichlet(b, n)


@jit
def _dirichlet(a, n):
    below = n * math.sin(math.pi * a)
    return math.sin(math.pi * n * a) / below if abs(below) > 1e-9 else 1.0


@jit
def window_noise(u, v, a, b, d, e, n):
    """Mean variance of the values of a deformed window (2x2 map a b d e, n x n pixels), in variances of a pixel."""
    along = _VALUE[0] + _VALUE[1] * mean_cosine(u, a, b, n)
    return along * (_VALUE[0] + _VALUE[1] * mean_cosine(v, d, e, n))


SIZE = 8  # unknowns
# Row of results: u, v, A (2x2), offset, gain, correlation, var u, cov uv, var v, noise, iterations, status.
U, V, A, OFFSET, GAIN, CORRELATION, VAR_U, COV, VAR_V = 0, 1, 2, 6, 7, 8, 9, 10, 11
NOISE, ITERATIONS, STATUS = 12, 13, 14
ROW = 15
FOUND, FLAT, OUTSIDE_IMAGE, DIVERGED, NOT_VISITED = 0, 1, 2, 3, 4


@jit
def factor(m, n):
    """Cholesky factor of a symmetric matrix (n, n), in its lower half; False if it is not positive definite."""
    for j in range(n):
        d = m[j, j]
        floor = 1e-10 * d
        for k in range(j):
            d -= m[j, k] * m[j, k]
        if not d > floor:
            return False
        d = math.sqrt(d)
        m[j, j] = d
        for i in range(j + 1, n):
            s = m[i, j]
            for k in range(j):
                s -= m[i, k] * m[j, k]
            m[i, j] = s / d
    return True


@jit
def solve(m, b, n):
    """Solve with the Cholesky factor m, in place in b (n,)."""
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= m[i, k] * b[k]
        b[i] = s / m[i, i]
    for i in range(n - 1, -1, -1):
        s = b[i]
        for k in range(i + 1, n):
            s -= m[k, i] * b[k]
        b[i] = s / m[i, i]


@jit
def template(c, u, v, half, f, fx, fy, rows):
    """Sample a window (n, n) at (u, v) [px] with its derivatives, n = 2 half + 1; returns the mean, NaN if outside.

    rows : (2, n + 5) scratch array.
    """
    height, width = c.shape
    n = 2 * half + 1
    i, j = math.floor(u), math.floor(v)
    if not (i - half >= 2 and j - half >= 2 and i + half + 3 < width and j + half + 3 < height):
        return math.nan
    i, j = int(i), int(j)
    a0, a1, a2, a3, a4, a5 = weights(u - i)
    d0, d1, d2, d3, d4, d5 = slopes(u - i)
    b0, b1, b2, b3, b4, b5 = weights(v - j)
    e0, e1, e2, e3, e4, e5 = slopes(v - j)
    left, total = i - half - 2, 0.0
    for y in range(n):
        k = j - half + y - 2
        for x in range(n + 5):
            p, q, r = c[k, left + x], c[k + 1, left + x], c[k + 2, left + x]
            s, t, w = c[k + 3, left + x], c[k + 4, left + x], c[k + 5, left + x]
            rows[0, x] = b0 * p + b1 * q + b2 * r + b3 * s + b4 * t + b5 * w
            rows[1, x] = e0 * p + e1 * q + e2 * r + e3 * s + e4 * t + e5 * w
        for x in range(n):
            p, q, r = rows[0, x], rows[0, x + 1], rows[0, x + 2]
            s, t, w = rows[0, x + 3], rows[0, x + 4], rows[0, x + 5]
            grey = a0 * p + a1 * q + a2 * r + a3 * s + a4 * t + a5 * w
            f[y, x] = grey
            total += grey
            fx[y, x] = d0 * p + d1 * q + d2 * r + d3 * s + d4 * t + d5 * w
            p, q, r = rows[1, x], rows[1, x + 1], rows[1, x + 2]
            s, t, w = rows[1, x + 3], rows[1, x + 4], rows[1, x + 5]
            fy[y, x] = a0 * p + a1 * q + a2 * r + a3 * s + a4 * t + a5 * w
    return total / (n * n)


@jit
def normal_matrix(f, fx, fy, half, mean, m):
    """Lower half of the normal matrix (8, 8) of a window; positions in units of `half`, f relative to its mean."""
    n = 2 * half + 1
    for k in range(SIZE):
        for i in range(SIZE):
            m[k, i] = 0.0
    for y in range(n):
        t = (y - half) / half
        xx0 = xx1 = xx2 = xy0 = xy1 = xy2 = yy0 = yy1 = yy2 = 0.0
        x0 = x1 = y0 = y1 = fx0 = fx1 = fy0 = fy1 = f0 = ff = 0.0
        for x in range(n):
            s = (x - half) / half
            p, q, r = fx[y, x], fy[y, x], f[y, x] - mean
            pp, pq, qq, pr, qr = p * p, p * q, q * q, p * r, q * r
            xx0, xx1, xx2 = xx0 + pp, xx1 + s * pp, xx2 + s * s * pp
            xy0, xy1, xy2 = xy0 + pq, xy1 + s * pq, xy2 + s * s * pq
            yy0, yy1, yy2 = yy0 + qq, yy1 + s * qq, yy2 + s * s * qq
            x0, x1, y0, y1 = x0 + p, x1 + s * p, y0 + q, y1 + s * q
            fx0, fx1, fy0, fy1 = fx0 + pr, fx1 + s * pr, fy0 + qr, fy1 + s * qr
            f0, ff = f0 + r, ff + r * r
        m[0, 0] += xx2
        m[1, 0], m[1, 1] = m[1, 0] + t * xx1, m[1, 1] + t * t * xx0
        m[2, 0], m[2, 1], m[2, 2] = m[2, 0] + xy2, m[2, 1] + t * xy1, m[2, 2] + yy2
        m[3, 0], m[3, 1], m[3, 2] = m[3, 0] + t * xy1, m[3, 1] + t * t * xy0, m[3, 2] + t * yy1
        m[3, 3] += t * t * yy0
        m[4, 0], m[4, 1], m[4, 2], m[4, 3] = m[4, 0] + x1, m[4, 1] + t * x0, m[4, 2] + y1, m[4, 3] + t * y0
        m[5, 0], m[5, 1], m[5, 2] = m[5, 0] + fx1, m[5, 1] + t * fx0, m[5, 2] + fy1
        m[5, 3], m[5, 4], m[5, 5] = m[5, 3] + t * fy0, m[5, 4] + f0, m[5, 5] + ff
        m[6, 0], m[6, 1], m[6, 2], m[6, 3] = m[6, 0] + xx1, m[6, 1] + t * xx0, m[6, 2] + xy1, m[6, 3] + t * xy0
        m[6, 4], m[6, 5], m[6, 6] = m[6, 4] + x0, m[6, 5] + fx0, m[6, 6] + xx0
        m[7, 0], m[7, 1], m[7, 2], m[7, 3] = m[7, 0] + xy1, m[7, 1] + t * xy0, m[7, 2] + yy1, m[7, 3] + t * yy0
        m[7, 4], m[7, 5], m[7, 6], m[7, 7] = m[7, 4] + y0, m[7, 5] + fy0, m[7, 6] + xy0, m[7, 7] + yy0
    m[4, 4] = float(n * n)


@jit
def fits(c, u, v, a, b, d, e, half):
    """Whether the four corners of a deformed window lie inside a spline's image."""
    height, width = c.shape
    du, dv = (abs(a) + abs(b)) * half, (abs(d) + abs(e)) * half
    return u - du >= 2.0 and v - dv >= 2.0 and u + du < width - 3.0 and v + dv < height - 3.0


@jit
def right_side(c, f, fx, fy, half, mean, u, v, a, b, d, e, out):
    """Write to out (8,) the right side of the normal equations; returns offset and sum of squares of the samples."""
    n = 2 * half + 1
    r0 = r1 = r2 = r3 = r4 = r5 = h0 = h1 = hh = 0.0
    shift = value(c, u, v)
    for y in range(n):
        j = y - half
        start_u, start_v, t = u + b * j, v + e * j, j / half
        p0 = p1 = q0 = q1 = 0.0
        for x in range(n):
            i = x - half
            h = value(c, start_u + a * i, start_v + d * i) - shift
            p, q, s = fx[y, x] * h, fy[y, x] * h, i / half
            p0, p1, q0, q1 = p0 + p, p1 + s * p, q0 + q, q1 + s * q
            h0, h1, hh = h0 + h, h1 + h * (f[y, x] - mean), hh + h * h
        r0, r1, r2, r3, r4, r5 = r0 + p0, r1 + q0, r2 + p1, r3 + t * p0, r4 + q1, r5 + t * q0
    out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7] = r2, r3, r4, r5, h0, h1, r0, r1
    return shift, hh


@jit
def composed(a, b, d, e, x, scale):
    """Compose a 2x2 map with a step (the first four unknowns x): whether it is invertible, and the new map."""
    d11, d12, d21, d22 = 1.0 + x[0] * scale, x[1] * scale, x[2] * scale, 1.0 + x[3] * scale
    det = d11 * d22 - d12 * d21
    ok = det > 0.1 and det < 10.0
    a, b, d, e = a / det, b / det, d / det, e / det
    return ok, a * d22 - b * d21, b * d11 - a * d12, d * d22 - e * d21, e * d11 - d * d12


@jit
def match_point(first, second, at_u, at_v, start, half, steps, tolerance, share, own, f, fx, fy, rows, m, b, kept, out):
    """Match the window about (at_u, at_v) of the first spline in the second, from `start`; fills a row of results.

    start : (6,) u, v [px] and the map (2, 2) row by row.
    tolerance : [px] largest motion of the window's corners at convergence.
    kept : (8,) scratch array for the right side.
    """
    n = (2 * half + 1) ** 2
    for k in range(ROW):
        out[k] = math.nan
    out[ITERATIONS] = 0.0
    mean = template(first, at_u, at_v, half, f, fx, fy, rows)
    if not abs(mean) < math.inf:
        out[STATUS] = OUTSIDE_IMAGE
        return
    normal_matrix(f, fx, fy, half, mean, m)
    f_f = m[5, 5]
    if not factor(m, SIZE):
        out[STATUS] = FLAT
        return
    u, v, a11, a12, a21, a22 = start[0], start[1], start[2], start[3], start[4], start[5]
    gain = square = correlation = shift = 0.0
    status = DIVERGED
    for step in range(steps):
        if not fits(second, u, v, a11, a12, a21, a22, half):
            status = OUTSIDE_IMAGE
            break
        shift, hh = right_side(second, f, fx, fy, half, mean, u, v, a11, a12, a21, a22, b)
        variance = hh - b[4] * b[4] / n
        correlation = b[5] / math.sqrt(f_f * variance) if variance > 0.0 else 0.0
        for k in range(SIZE):
            kept[k] = b[k]
        solve(m, b, SIZE)
        square = hh
        for k in range(SIZE):
            square -= b[k] * kept[k]
        gain = b[5]
        out[ITERATIONS] = step + 1.0
        if not gain > 0.05:  # no correlation with the template
            break
        du, dv = b[6] / gain, b[7] / gain
        ok, n11, n12, n21, n22 = composed(a11, a12, a21, a22, b, 1.0 / (gain * half))
        if not ok:
            break
        step_u, step_v = n11 * du + n12 * dv, n21 * du + n22 * dv
        change = abs(n11 - a11) + abs(n12 - a12)
        other = abs(n21 - a21) + abs(n22 - a22)
        change = half * (change if change > other else other)
        a11, a12, a21, a22 = n11, n12, n21, n22
        u, v = u - step_u, v - step_v
        if step_u * step_u + step_v * step_v + change * change <= tolerance * tolerance:
            status = FOUND
            break
    out[U], out[V], out[A], out[A + 1], out[A + 2], out[A + 3] = u, v, a11, a12, a21, a22
    out[STATUS], out[GAIN], out[OFFSET] = status, gain, b[4] + shift - gain * mean
    out[CORRELATION] = correlation
    if status == FOUND:
        covariance(m, at_u, at_v, half, gain, square, share, own, out)


@jit
def covariance(m, at_u, at_v, half, gain, square, share, own, out):
    """Fill in noise and covariance of a match, from the factored normal matrix and the residuals.

    share : share of the template in the noise variance; the rest is the other image's.
    own : variance of the template's noise, used if smaller, as residuals also contain model errors.

    The spline smooths the noise of the residuals, which is undone, and the noise of the template makes its own
    gradients steeper than they are: G of the 2x2 normal matrix S is noise, T = S - G is not. A shift moves residuals
    along the true gradients; the other image's noise is compared along the noisy ones, the template's along the true
    ones, as it is orthogonal to its own derivative. So the covariance is sigma² T^-1 (share T + (1 - share) / gain² S)
    T^-1.
    """
    n = 2 * half + 1
    u, v, a11, a12, a21, a22 = out[U], out[V], out[A], out[A + 1], out[A + 2], out[A + 3]
    tu, tv = at_u - math.floor(at_u), at_v - math.floor(at_v)
    passed = (1.0 - share) * window_noise(u, v, a11, a12, a21, a22, n)
    passed += share * gain * gain * value_noise(tu) * value_noise(tv)
    sigma2 = (square if square > 0.0 else 0.0) / ((n * n - SIZE) * passed)
    s00, s01, s11 = m[6, 6] ** 2, m[7, 6] * m[6, 6], m[7, 6] ** 2 + m[7, 7] ** 2
    feigned = n * n * (own if own < share * sigma2 else share * sigma2)
    t00 = s00 - feigned * slope_noise(tu) * value_noise(tv)
    t11 = s11 - feigned * slope_noise(tv) * value_noise(tu)
    det = t00 * t11 - s01 * s01
    if not (t00 > 0.0 and t11 > 0.0 and det > 0.0):  # only noise
        out[STATUS] = FLAT
        return
    i00, i01, i11 = t11 / det, -s01 / det, t00 / det
    other = (1.0 - share) / (gain * gain)
    m00, m01, m11 = share * t00 + other * s00, (share + other) * s01, share * t11 + other * s11
    p00, p01, p10, p11 = i00 * m00 + i01 * m01, i00 * m01 + i01 * m11, i01 * m00 + i11 * m01, i01 * m01 + i11 * m11
    c00, c01, c11 = sigma2 * (p00 * i00 + p01 * i01), sigma2 * (p00 * i01 + p01 * i11), sigma2 * (p10 * i01 + p11 * i11)
    out[NOISE] = math.sqrt(sigma2)
    out[VAR_U] = a11 * a11 * c00 + 2.0 * a11 * a12 * c01 + a12 * a12 * c11
    out[COV] = a11 * a21 * c00 + (a11 * a22 + a12 * a21) * c01 + a12 * a22 * c11
    out[VAR_V] = a21 * a21 * c00 + 2.0 * a21 * a22 * c01 + a22 * a22 * c11


@jit
def match_points(first, second, at, starts, halves, steps, tolerance, share, own, out):
    """Match windows of 2 half + 1 pixels at points (N, 2) [px] from starts (N, 6); fills out (N, 15)."""
    f, fx, fy, rows, m, b, kept = room(halves)
    for k in range(at.shape[0]):
        match_point(
            first, second, at[k, 0], at[k, 1], starts[k], halves[k], steps, tolerance, share, own,
            f, fx, fy, rows, m, b, kept, out[k],
        )  # fmt: skip


@jit
def room(halves):
    """Scratch arrays for windows of up to the largest half side."""
    n = 1
    for k in range(halves.shape[0]):
        n = 2 * halves[k] + 1 if 2 * halves[k] + 1 > n else n
    f, fx, fy = np.empty((n, n), np.float32), np.empty((n, n), np.float32), np.empty((n, n), np.float32)
    return f, fx, fy, np.empty((2, n + 5)), np.empty((SIZE, SIZE)), np.empty(SIZE), np.empty(SIZE)


@jit
def predict(first, at, half, variance, share, out):
    """Predict the standard deviation (N,) [px] of a match in its worst direction from the texture of its window.

    variance : noise variance of both images together; `share` of it is the first image's and adds to its gradients.
    Infinite without texture beyond noise, NaN where the window leaves the image.
    """
    n = 2 * half + 1
    f, fx, fy = np.empty((n, n), np.float32), np.empty((n, n), np.float32), np.empty((n, n), np.float32)
    rows, m = np.empty((2, n + 5)), np.empty((SIZE, SIZE))
    for k in range(at.shape[0]):
        out[k] = math.nan
        if not abs(at[k, 0]) + abs(at[k, 1]) < math.inf:
            continue
        mean = template(first, at[k, 0], at[k, 1], half, f, fx, fy, rows)
        if not abs(mean) < math.inf:
            continue
        out[k] = math.inf
        normal_matrix(f, fx, fy, half, mean, m)
        if not factor(m, SIZE):
            continue
        s00, s01, s11 = m[6, 6] ** 2, m[7, 6] * m[6, 6], m[7, 6] ** 2 + m[7, 7] ** 2
        feigned = n * n * share * variance * slope_noise(at[k, 0] - math.floor(at[k, 0]))
        least = 0.5 * (s00 + s11) - math.sqrt(0.25 * (s00 - s11) ** 2 + s01 * s01)
        if least > feigned:
            out[k] = math.sqrt(variance * (least - share * feigned)) / (least - feigned)
