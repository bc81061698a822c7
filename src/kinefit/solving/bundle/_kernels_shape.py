"""Joint normal equations of pose and shape from one frame's pixels."""

from __future__ import annotations

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian
from kinefit.geometry.losses._kernels import robust
from kinefit.solving.bundle._kernels_cameras import COLUMNS, camera_columns
from kinefit.solving.correspondences._kernels import place


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
