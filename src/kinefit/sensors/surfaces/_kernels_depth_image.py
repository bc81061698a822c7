"""Kernels that select measured points near the body."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import ROT, TRANS


@jit
def gated_points(
    depth, rays, camera, low, high, first_row, last_row, first_column, last_column, step, patches, out, share,
):  # fmt: skip
    """Write the world points (3, N) of every `step`-th pixel of a window that lie in the box low..high (3,) [m]; count.

    share (N,): patches of surface that a point stands for, about, at most 1: `patches` [1/m²] times z².
    """
    r00, r01, r02 = camera[ROT], camera[ROT + 1], camera[ROT + 2]
    r10, r11, r12 = camera[ROT + 3], camera[ROT + 4], camera[ROT + 5]
    r20, r21, r22 = camera[ROT + 6], camera[ROT + 7], camera[ROT + 8]
    t0, t1, t2 = camera[TRANS], camera[TRANS + 1], camera[TRANS + 2]
    n = 0
    for v in range(first_row, last_row, step):
        for u in range(first_column, last_column, step):
            m = depth[v, u]
            if m <= 0.0:
                continue
            a, b, c = m * rays[0, v, u] - t0, m * rays[1, v, u] - t1, m - t2
            x = r00 * a + r10 * b + r20 * c
            y = r01 * a + r11 * b + r21 * c
            z = r02 * a + r12 * b + r22 * c
            if low[0] < x < high[0] and low[1] < y < high[1] and low[2] < z < high[2]:
                out[0, n], out[1, n], out[2, n] = x, y, z
                part = patches * m * m
                share[n] = part if part < 1.0 else 1.0
                n += 1
    return n


@jit
def box(x, out):
    """Write the smallest and largest coordinates (2, 3) of points (N, 3)."""
    for k in range(3):
        low, high = math.inf, -math.inf
        for i in range(x.shape[0]):
            v = x[i, k]
            low = v if v < low else low
            high = v if v > high else high
        out[0, k], out[1, k] = low, high
