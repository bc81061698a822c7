"""Derivatives of pixels by the parameters of their camera."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import CX, CY, DIST, FX, FY, MODEL, ROT, SKEW, TRANS, project_jacobian

COLUMNS = 16
"""Parameters of a camera, as `solvers.bundle.cameras` lists them."""


@jit
def camera_columns(camera, velocity, x, y, z, u, v, ux, uy, uz, vx, vy, vz, cu, cv):
    """Derivatives cu, cv (16,) of the pixel (u, v) of a world point by the parameters of its camera.

    A point moves by v + ω × x in the camera's frame; velocity (2,) [px/s] of the point's image; ux .. vz: derivatives
    by the world point [px/m].
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
    fx, fy, skew = camera[FX], camera[FY], camera[SKEW]
    cu[6], cv[6] = u - camera[CX], v - camera[CY]
    cu[7], cv[7] = 0.0, v - camera[CY]
    cu[8], cv[8], cu[9], cv[9] = 1.0, 0.0, 0.0, 1.0
    if camera[MODEL] == 0.0:
        a, b = xc / zc, yc / zc
        q = a * a + b * b
        first = q / (1.0 + q * (camera[DIST + 5] + q * (camera[DIST + 6] + q * camera[DIST + 7])))
        second, third = first * q, first * q * q
        p1u, p1v, p2u, p2v = 2.0 * a * b, q + 2.0 * b * b, q + 2.0 * a * a, 2.0 * a * b
    else:
        rho = math.sqrt(xc * xc + yc * yc)
        theta = math.atan2(rho, zc)
        a, b = xc, yc
        first = theta * theta * theta / rho if rho > 1e-12 else 0.0
        q = theta * theta
        second, third = first * q, 0.0
        p1u, p1v = second * q * a, second * q * b
        p2u, p2v = p1u * q, p1v * q
    cu[10], cv[10] = first * (fx * a + skew * b), first * fy * b
    cu[11], cv[11] = second * (fx * a + skew * b), second * fy * b
    cu[12], cv[12] = fx * p1u + skew * p1v, fy * p1v
    cu[13], cv[13] = fx * p2u + skew * p2v, fy * p2v
    cu[14], cv[14] = third * (fx * a + skew * b), third * fy * b
    cu[15], cv[15] = velocity[0], velocity[1]


@jit
def point_systems(cameras, camera, x, velocity, value, J_point, J_camera):
    """Linearise the pixels of points x (M, 3), each seen by one of the cameras (C, PACKED).

    Fills value (M, 2) [px] projected (NaN where invisible), J_point (M, 2, 3) and J_camera (M, 2, 16).
    """
    for m in range(camera.size):
        c = camera[m]
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[c], x[m, 0], x[m, 1], x[m, 2])
        value[m, 0], value[m, 1] = u, v
        if ok:
            J_point[m, 0, 0], J_point[m, 0, 1], J_point[m, 0, 2] = ux, uy, uz
            J_point[m, 1, 0], J_point[m, 1, 1], J_point[m, 1, 2] = vx, vy, vz
            camera_columns(
                cameras[c], velocity[m], x[m, 0], x[m, 1], x[m, 2], u, v, ux, uy, uz, vx, vy, vz, J_camera[m, 0],
                J_camera[m, 1],
            )  # fmt: skip
        else:
            J_point[m] = 0.0
            J_camera[m] = 0.0
