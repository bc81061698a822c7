"""Derivatives of pixels by the parameters of their camera.

Joint normal equations of pose and shape from one frame's pixels.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import CX, CY, DIST, FX, FY, MODEL, ROT, SKEW, TRANS, project_jacobian
from kinefit.geometry.losses._kernels import robust
from kinefit.solving.correspondences._kernels import place

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


@jit
def scale_motion(parents, offsets, groups, frames, motion):
    """motion (S, G, 3): derivatives [m] of the joint centres by the scale of each group."""
    motion[:] = 0.0
    for s in range(1, parents.size):
        p = parents[s]
        motion[s] = motion[p]
        f, g = frames[p], groups[p]
        x, y, z = offsets[s, 0], offsets[s, 1], offsets[s, 2]
        for i in range(3):
            motion[s, g, i] += f[3 * i] * x + f[3 * i + 1] * y + f[3 * i + 2] * z


@jit
def frame_system(
    parents, dof_parent, last_dof, offsets, groups, n_groups,
    owner, rest, base, shift, mirror, cameras, camera, column, target, weight, share,
    frames, screws, centre, kind, scale, place_of, velocity, H, g,
):  # fmt: skip
    """Add one frame's pixels to H (m, m; lower triangle) and g (m,): dofs, scales, point shifts, cameras.

    owner (K,), rest (K, 3): points of the body; base (K, 3): their place in the segment before scaling; shift (K,):
    first shift parameter of each point; mirror (K,): -1 where the shift counts mirrored in z.
    Measurements: camera (N,), column (N,) point, target (N, 2) [px], weight (N,) [1/px²],
    share (N,) of it that counts beyond the loss. Cameras: place_of (C, 16) their parameters in g, -1 for fixed ones;
    velocity (N, 2) [px/s]. Returns the robust cost.
    """
    n = screws.shape[0] + 6
    motion = np.empty((parents.size, n_groups, 3))
    scale_motion(parents, offsets, groups, frames, motion)
    index = np.empty(n + n_groups + 3 + COLUMNS, np.int64)
    ju, jv = np.empty(index.size), np.empty(index.size)
    cu, cv = np.empty(COLUMNS), np.empty(COLUMNS)
    cost = 0.0
    for m in range(camera.size):
        w = weight[m]
        if w <= 0.0:
            continue
        k = column[m]
        x, y, z = place(frames, owner, rest, k)
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[camera[m]], x, y, z)
        if not ok:
            continue
        ru, rv = target[m, 0] - u, target[m, 1] - v
        rho, factor = robust(kind, scale, w * (ru * ru + rv * rv))
        cost += share[m] * rho
        w *= factor * share[m]
        if w <= 0.0:
            continue
        s, count = owner[k], 0
        dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
        d = last_dof[s]
        while d >= 0:
            if d >= 6:
                t = screws[d - 6]
                mx, my, mz = t[0] + t[4] * dz - t[5] * dy, t[1] + t[5] * dx - t[3] * dz, t[2] + t[3] * dy - t[4] * dx
            elif d >= 3:
                mx, my, mz = (0.0, -dz, dy) if d == 3 else (dz, 0.0, -dx) if d == 4 else (-dy, dx, 0.0)
            else:
                mx, my, mz = (1.0 if d == 0 else 0.0), (1.0 if d == 1 else 0.0), (1.0 if d == 2 else 0.0)
            index[count], ju[count], jv[count] = d, ux * mx + uy * my + uz * mz, vx * mx + vy * my + vz * mz
            count += 1
            d = dof_parent[d]
        f = frames[s]
        for q in range(n_groups):
            mx, my, mz = motion[s, q, 0], motion[s, q, 1], motion[s, q, 2]
            if q == groups[s]:
                mx += f[0] * base[k, 0] + f[1] * base[k, 1] + f[2] * base[k, 2]
                my += f[3] * base[k, 0] + f[4] * base[k, 1] + f[5] * base[k, 2]
                mz += f[6] * base[k, 0] + f[7] * base[k, 1] + f[8] * base[k, 2]
            if mx != 0.0 or my != 0.0 or mz != 0.0:
                index[count], ju[count], jv[count] = n + q, ux * mx + uy * my + uz * mz, vx * mx + vy * my + vz * mz
                count += 1
        for i in range(3):
            sign = mirror[k] if i == 2 else 1.0
            mx, my, mz = sign * f[i], sign * f[3 + i], sign * f[6 + i]
            index[count] = n + n_groups + shift[k] + i
            ju[count], jv[count] = ux * mx + uy * my + uz * mz, vx * mx + vy * my + vz * mz
            count += 1
        c = camera[m]
        camera_columns(cameras[c], velocity[m], x, y, z, u, v, ux, uy, uz, vx, vy, vz, cu, cv)
        for i in range(COLUMNS):
            if place_of[c, i] >= 0:
                index[count], ju[count], jv[count] = place_of[c, i], cu[i], cv[i]
                count += 1
        for a in range(count):
            ia = index[a]
            wu, wv = w * ju[a], w * jv[a]
            g[ia] += wu * ru + wv * rv
            for b in range(count):
                ib = index[b]
                if ib <= ia:
                    H[ia, ib] += wu * ju[b] + wv * jv[b]
    return cost
