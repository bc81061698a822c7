"""Compiled row makers: they fill the row buffers from line `start` on and return the next free line.

Common parameters: frames (S, 12) from forward kinematics; owner (K,) segments and rest (K, 3) points in the root frame
at rest; buffers data (8, N) = x, n, r, w; segment (N,); group (N,).
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian
from kinefit.geometry._kernels_frames import moved


@jit
def place(frames, owner, rest, k):
    """Position (x, y, z) [m] of point k in the world."""
    return moved(frames[owner[k]], rest[k, 0], rest[k, 1], rest[k, 2])


@jit
def _put(data, segment, group, i, s, g, x, y, z, nx, ny, nz, r, w):
    data[0, i], data[1, i], data[2, i] = x, y, z
    data[3, i], data[4, i], data[5, i] = nx, ny, nz
    data[6, i], data[7, i] = r, w
    segment[i], group[i] = s, g


@jit
def point_rows(frames, owner, rest, target, weight, data, segment, group, start):
    """Three rows for each point, along the world's axes: target (K, 3) [m], weight (K,) [1/m²], 0 for none."""
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        s = owner[k]
        _put(data, segment, group, i, s, k, x, y, z, 1.0, 0.0, 0.0, target[k, 0] - x, w)
        _put(data, segment, group, i + 1, s, k, x, y, z, 0.0, 1.0, 0.0, target[k, 1] - y, w)
        _put(data, segment, group, i + 2, s, k, x, y, z, 0.0, 0.0, 1.0, target[k, 2] - z, w)
        i += 3
    return i


@jit
def plane_rows(frames, owner, rest, target, normal, weight, first_group, data, segment, group, start):
    """One row for each point, along the normal of the plane through target; weight (K,) [1/m²].

    For thousands of points: rest, target and normal are (3, K), points are sorted by segment, and a point without
    weight gets a row without effect.
    """
    k = 0
    while k < owner.size:
        s, first = owner[k], k
        while k < owner.size and owner[k] == s:
            k += 1
        f = frames[s]
        f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
        t0, t1, t2 = f[9], f[10], f[11]
        i, n = start + first, k - first
        rx, ry, rz = (
            rest[0, first:k],
            rest[1, first:k],
            rest[2, first:k],
        )  # slices, so that the compiler vectorises the loop
        tx, ty, tz = target[0, first:k], target[1, first:k], target[2, first:k]
        nx, ny, nz, w = normal[0, first:k], normal[1, first:k], normal[2, first:k], weight[first:k]
        px, py, pz = data[0, i : i + n], data[1, i : i + n], data[2, i : i + n]
        ox, oy, oz, r, v = (
            data[3, i : i + n],
            data[4, i : i + n],
            data[5, i : i + n],
            data[6, i : i + n],
            data[7, i : i + n],
        )
        for j in range(n):
            x = f0 * rx[j] + f1 * ry[j] + f2 * rz[j] + t0
            y = f3 * rx[j] + f4 * ry[j] + f5 * rz[j] + t1
            z = f6 * rx[j] + f7 * ry[j] + f8 * rz[j] + t2
            px[j], py[j], pz[j] = x, y, z
            r[j] = nx[j] * (tx[j] - x) + ny[j] * (ty[j] - y) + nz[j] * (tz[j] - z)
        for j in range(n):
            ox[j], oy[j], oz[j], v[j] = nx[j], ny[j], nz[j], w[j]
        for j in range(n):
            segment[i + j], group[i + j] = s, first_group + first + j
    return start + owner.size


@jit
def pixel_rows(frames, owner, rest, cameras, camera, target, weight, data, segment, group, start):
    """Two rows for each pixel: the exact linearisation of reprojection with distortion.

    cameras (C, P) packed, camera (K,) index, target (K, 2) [px], weight (K,) [1/px²]. With g = ∂u/∂x: n = g/|g|,
    r = Δu/|g|, w = weight |g|². A point that does not project into its camera makes no row.
    """
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[camera[k]], x, y, z)
        if not ok:
            continue
        s = owner[k]
        g2 = ux * ux + uy * uy + uz * uz
        g = 1.0 / math.sqrt(g2)
        _put(data, segment, group, i, s, k, x, y, z, ux * g, uy * g, uz * g, (target[k, 0] - u) * g, w * g2)
        g2 = vx * vx + vy * vy + vz * vz
        g = 1.0 / math.sqrt(g2)
        _put(data, segment, group, i + 1, s, k, x, y, z, vx * g, vy * g, vz * g, (target[k, 1] - v) * g, w * g2)
        i += 2
    return i


@jit
def image_line_rows(frames, owner, rest, cameras, camera, line, weight, data, segment, group, start):
    """One row for each point, from its pixel to the image line a u + b v + c = 0 (K, 3); weight (K,) [1/px²]."""
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[camera[k]], x, y, z)
        if not ok:
            continue
        a, b, c = line[k, 0], line[k, 1], line[k, 2]
        scale = 1.0 / math.sqrt(a * a + b * b)
        a, b, c = a * scale, b * scale, c * scale
        gx, gy, gz = a * ux + b * vx, a * uy + b * vy, a * uz + b * vz
        g2 = gx * gx + gy * gy + gz * gz
        g = 1.0 / math.sqrt(g2)
        r = -(a * u + b * v + c) * g
        _put(data, segment, group, i, owner[k], k, x, y, z, gx * g, gy * g, gz * g, r, w * g2)
        i += 1
    return i


@jit
def ray_rows(frames, owner, rest, line, weight, data, segment, group, start):
    """Two rows for each point: its offset from the Plücker line (K, 6) along two directions normal to it."""
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        n0, n1, n2 = line[k, 0], line[k, 1], line[k, 2]
        fx, fy, fz = (
            n1 * line[k, 5] - n2 * line[k, 4],
            n2 * line[k, 3] - n0 * line[k, 5],
            n0 * line[k, 4] - n1 * line[k, 3],
        )
        # a branch-free frame about n (Duff et al. 2017)
        sign = math.copysign(1.0, n2)
        p = -1.0 / (sign + n2)
        q = n0 * n1 * p
        ax, ay, az = 1.0 + sign * n0 * n0 * p, sign * q, -sign * n0
        bx, by, bz = q, sign + n1 * n1 * p, -n1
        ra = ax * (fx - x) + ay * (fy - y) + az * (fz - z)
        rb = bx * (fx - x) + by * (fy - y) + bz * (fz - z)
        _put(data, segment, group, i, owner[k], k, x, y, z, ax, ay, az, ra, w)
        _put(data, segment, group, i + 1, owner[k], k, x, y, z, bx, by, bz, rb, w)
        i += 2
    return i


@jit
def buffers(count):
    """Empty row buffers of N = count lines: data (8, N), segment (N,), group (N,)."""
    return np.empty((8, count)), np.empty(count, np.int64), np.empty(count, np.int64)
