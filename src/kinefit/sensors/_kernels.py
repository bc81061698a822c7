"""Checks of rows, and levers of observed points, each in one pass.

Where on the body a detector puts its keypoints, seen from a camera.
"""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import ROT, TRANS
from kinefit.geometry._kernels_frames import moved


@jit
def sound(data, segment, count):
    """Whether data (8, N) are finite, weights at least 0 and segments (N,) below `count`."""
    total, good = 0.0, True
    for q in range(8):
        line = data[q]
        for i in range(line.size):
            total += line[i]
    for i in range(segment.size):
        good = good and data[7, i] >= 0.0 and 0 <= segment[i] < count
    return good and abs(total) < math.inf


@jit
def longest_levers(frames, screws, segments, rest, seen, root, last_dof, dof_parent, out):
    """Write to out (D,) [m/rad] the longest lever of each coordinate on an observed point; seen (K,) bool."""
    out[:] = 0.0
    for k in range(segments.size):
        if seen[k]:
            x, y, z = moved(frames[segments[k]], rest[k, 0], rest[k, 1], rest[k, 2])
            x, y, z = x - root[0, 3], y - root[1, 3], z - root[2, 3]
            d = last_dof[segments[k]]
            while d >= 6:
                t = screws[d - 6]
                a = t[0] + t[4] * z - t[5] * y
                b = t[1] + t[5] * x - t[3] * z
                c = t[2] + t[3] * y - t[4] * x
                far = a * a + b * b + c * c
                if far > out[d - 6]:
                    out[d - 6] = far
                d = dof_parent[d]
    for d in range(out.size):
        out[d] = math.sqrt(out[d])


@jit
def shifted(coefficients, trunk, x_world, frames, cameras, camera, out):
    """out (N, 3) [m]: points (N, 3) shifted by their bias by view; see `ViewBias`.

    coefficients (N, 5, 3) [m] in the axes of segments trunk (N,) with frames (S, 12), seen by camera (N,) of cameras
    (C, 29).
    """
    for n in range(trunk.size):
        f, c, k = frames[trunk[n]], coefficients[n], cameras[camera[n]]
        r, t = k[ROT : ROT + 9], k[TRANS : TRANS + 3]
        a = -(r[0] * t[0] + r[3] * t[1] + r[6] * t[2]) - x_world[n, 0]
        b = -(r[1] * t[0] + r[4] * t[1] + r[7] * t[2]) - x_world[n, 1]
        g = -(r[2] * t[0] + r[5] * t[1] + r[8] * t[2]) - x_world[n, 2]
        far = math.sqrt(a * a + b * b + g * g)
        x = (f[0] * a + f[3] * b + f[6] * g) / far
        y = (f[1] * a + f[4] * b + f[7] * g) / far
        z = (f[2] * a + f[5] * b + f[8] * g) / far
        p, q = x * x - z * z, x * z
        u = c[0, 0] * x + c[1, 0] * y + c[2, 0] * z + c[3, 0] * p + c[4, 0] * q
        v = c[0, 1] * x + c[1, 1] * y + c[2, 1] * z + c[3, 1] * p + c[4, 1] * q
        w = c[0, 2] * x + c[1, 2] * y + c[2, 2] * z + c[3, 2] * p + c[4, 2] * q
        out[n, 0] = x_world[n, 0] + f[0] * u + f[1] * v + f[2] * w
        out[n, 1] = x_world[n, 1] + f[3] * u + f[4] * v + f[5] * w
        out[n, 2] = x_world[n, 2] + f[6] * u + f[7] * v + f[8] * w
