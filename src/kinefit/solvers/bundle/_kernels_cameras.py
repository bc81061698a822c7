"""Derivatives of pixels by the parameters of their camera."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import CX, CY, DIST, FX, FY, MODEL, ROT, SKEW, TRANS, project_jacobian

COLUMNS = 10
"""Parameters of a camera: v, ω in its own frame [m, rad], log of the focal length, k1, k2, time offset [s]."""


@jit
def camera_columns(camera, freedom, velocity, x, y, z, u, v, ux, uy, uz, vx, vy, vz, cu, cv):
    """Derivatives cu, cv (10,) of the pixel (u, v) of a world point by the parameters of its camera.

    A point moves by v + ω × x in the camera's frame; freedom (10,): factor of each column, 0 for what is fixed;
    velocity (2,) [px/s] of the point's image; ux .. vz: derivatives by the world point [px/m].
    """
    xc = camera[ROT] * x + camera[ROT + 1] * y + camera[ROT + 2] * z + camera[TRANS]
    yc = camera[ROT + 3] * x + camera[ROT + 4] * y + camera[ROT + 5] * z + camera[TRANS + 1]
    zc = camera[ROT + 6] * x + camera[ROT + 7] * y + camera[ROT + 8] * z + camera[TRANS + 2]
    for i in range(3):
        a, b, c = camera[ROT + 3 * i], camera[ROT + 3 * i + 1], camera[ROT + 3 * i + 2]
        cu[i], cv[i] = ux * a + uy * b + uz * c, vx * a + vy * b + vz * c
    cu[3], cv[3] = cu[2] * yc - cu[1] * zc, cv[2] * yc - cv[1] * zc
    cu[4], cv[4] = cu[0] * zc - cu[2] * xc, cv[0] * zc - cv[2] * xc
    cu[5], cv[5] = cu[1] * xc - cu[0] * yc, cv[1] * xc - cv[0] * yc
    cu[6], cv[6] = u - camera[CX], v - camera[CY]
    if camera[MODEL] == 0.0:
        a, b = xc / zc, yc / zc
        q = a * a + b * b
        first = q / (1.0 + q * (camera[DIST + 5] + q * (camera[DIST + 6] + q * camera[DIST + 7])))
        second = first * q
    else:
        rho = math.sqrt(xc * xc + yc * yc)
        theta = math.atan2(rho, zc)
        a, b = xc, yc
        first = theta * theta * theta / rho if rho > 1e-12 else 0.0
        second = first * theta * theta
    fx, fy, skew = camera[FX], camera[FY], camera[SKEW]
    cu[7], cv[7] = first * (fx * a + skew * b), first * fy * b
    cu[8], cv[8] = second * (fx * a + skew * b), second * fy * b
    cu[9], cv[9] = velocity[0], velocity[1]
    for j in range(COLUMNS):
        cu[j] *= freedom[j]
        cv[j] *= freedom[j]


@jit
def point_systems(cameras, freedom, camera, point, x, velocity, value, J_point, J_camera):
    """Linearise pixels of free points: M measurements of points x (P, 3) by cameras (C, PACKED).

    Fills value (M, 2) [px] projected (NaN where invisible), J_point (M, 2, 3) and J_camera (M, 2, 10).
    """
    for m in range(camera.size):
        p, c = point[m], camera[m]
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[c], x[p, 0], x[p, 1], x[p, 2])
        value[m, 0], value[m, 1] = u, v
        if ok:
            J_point[m, 0, 0], J_point[m, 0, 1], J_point[m, 0, 2] = ux, uy, uz
            J_point[m, 1, 0], J_point[m, 1, 1], J_point[m, 1, 2] = vx, vy, vz
            camera_columns(
                cameras[c], freedom[c], velocity[m], x[p, 0], x[p, 1], x[p, 2], u, v, ux, uy, uz, vx, vy, vz,
                J_camera[m, 0], J_camera[m, 1],
            )  # fmt: skip
        else:
            for i in range(3):
                J_point[m, 0, i] = J_point[m, 1, i] = 0.0
            for i in range(COLUMNS):
                J_camera[m, 0, i] = J_camera[m, 1, i] = 0.0
