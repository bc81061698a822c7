"""Compiled nearest points of metaballs, Σ w exp(-2 d) = 1/2."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_frames import turned

_MAX_ITERATIONS = 30
_MIN_STEP = 1e-9  # [m] at which the iteration ends
_MAX_STEP = 0.1  # [m] far outside and at the middle of a limb the field is nearly flat


@jit
def field(balls, first, last, x, y, z):
    """Field and gradient at a point; balls (B, 13): see `BallTable`."""
    f, gx, gy, gz = 0.0, 0.0, 0.0, 0.0
    for i in range(first, last):
        b = balls[i]
        dx, dy, dz = x - b[0], y - b[1], z - b[2]
        p = b[3] * dx + b[4] * dy + b[5] * dz
        q = b[6] * dx + b[7] * dy + b[8] * dz
        r = b[9] * dx + b[10] * dy + b[11] * dz
        e = b[12] * math.exp(-2.0 * (p * p + q * q + r * r))
        f += e
        e *= -4.0
        gx += e * (p * b[3] + q * b[6] + r * b[9])
        gy += e * (p * b[4] + q * b[7] + r * b[10])
        gz += e * (p * b[5] + q * b[8] + r * b[11])
    return f, gx, gy, gz


@jit
def closest(balls, first, last, x, y, z):
    """Closest point y on the surface to a point x: F(y) = 1/2 and x - y along the gradient.

    Each step goes along the gradient to where a linear model of the field's logarithm (outside: of its root) meets the
    level, which is exact for one ellipsoid along its axes, and along the tangent plane towards the point. Returns the
    signed distance, positive outside, the outward normal, and whether it converged.
    """
    level, root = math.log(0.5), math.sqrt(0.5 * math.log(2.0))
    px, py, pz = x, y, z
    nx, ny, nz = 0.0, 0.0, 0.0
    slide = 1.0
    for step in range(_MAX_ITERATIONS):
        f, gx, gy, gz = field(balls, first, last, px, py, pz)
        size = math.sqrt(gx * gx + gy * gy + gz * gz)
        if not (f > 1e-280 and size > 1e-280):
            return 0.0, 0.0, 0.0, 0.0, False
        nx, ny, nz = -gx / size, -gy / size, -gz / size
        slope = size / f  # of -log F along the normal
        if f < 0.9:
            h = math.sqrt(-0.5 * math.log(f))
            out = (h - root) * 4.0 * h / slope
        else:
            out = (level - math.log(f)) / slope
        out = min(max(out, -_MAX_STEP), _MAX_STEP)
        wx, wy, wz = x - px, y - py, z - pz
        across = wx * nx + wy * ny + wz * nz
        tx, ty, tz = wx - across * nx, wy - across * ny, wz - across * nz
        if step == 0:
            tx, ty, tz = 0.0, 0.0, 0.0
        elif step > 8:
            slide = 0.5
        mx, my, mz = slide * tx - out * nx, slide * ty - out * ny, slide * tz - out * nz
        px, py, pz = px + mx, py + my, pz + mz
        if step > 0 and mx * mx + my * my + mz * mz < _MIN_STEP * _MIN_STEP:
            return (x - px) * nx + (y - py) * ny + (z - pz) * nz, nx, ny, nz, True
    return (x - px) * nx + (y - py) * ny + (z - pz) * nz, nx, ny, nz, abs(out) < 1e-4


@jit
def nearest_on_metaballs(x, frames, limbs, balls, wanted, distance, normal, segment):
    """Update the nearest points where a limb is nearer than the present surface.

    x (3, N) [m] in the world, frames (S, 12), limbs (G, 7) and balls (B, 13) as of `BallTable`, wanted (N,) segment or
    -1. Out: distance (N,), normal (3, N), segment (N,).
    """
    for k in range(distance.size):
        for g in range(limbs.shape[0]):
            s = int(limbs[g, 0])
            if wanted[k] >= 0 and wanted[k] != s:
                continue
            f = frames[s]
            dx, dy, dz = x[0, k] - f[9], x[1, k] - f[10], x[2, k] - f[11]
            u, v, w = (
                f[0] * dx + f[3] * dy + f[6] * dz, f[1] * dx + f[4] * dy + f[7] * dz, f[2] * dx + f[5] * dy + f[8] * dz
            )
            ax, ay, az = u - limbs[g, 3], v - limbs[g, 4], w - limbs[g, 5]
            if math.sqrt(ax * ax + ay * ay + az * az) - limbs[g, 6] > abs(distance[k]):
                continue
            d, a, b, c, ok = closest(balls, int(limbs[g, 1]), int(limbs[g, 2]), u, v, w)
            if not ok or not d < distance[k]:
                continue
            distance[k], segment[k] = d, s
            normal[0, k], normal[1, k], normal[2, k] = turned(f, a, b, c)
