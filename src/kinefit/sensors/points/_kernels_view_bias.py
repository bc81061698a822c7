"""Where on the body a detector puts its keypoints, seen from a camera."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import ROT, TRANS


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
