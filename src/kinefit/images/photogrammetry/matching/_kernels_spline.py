"""Compiled quintic B-splines: values of an image between its pixels, from its coefficients."""

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
