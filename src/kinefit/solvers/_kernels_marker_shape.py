"""One frame's normal equations of pose, scales and marker offsets together, from markers in space."""

from __future__ import annotations

import numpy as np

from kinefit._jit import jit
from kinefit._kernels_losses import robust
from kinefit.correspondences._kernels import place
from kinefit.solvers._kernels_shape import scale_motion


@jit
def marker_columns(
    x, y, z, s, k, n, n_groups, dof_parent, last_dof, groups, base, shift, motion, frames, screws, centre, index, moves
):  # fmt: skip
    """Derivatives `moves` (3, m) of one marker's place by what moves it, whose places go to `index`; returns how many.

    First the degrees of freedom above segment s, then the scale groups, then the marker's own three offsets.
    """
    count = 0
    dx, dy, dz = x - centre[0], y - centre[1], z - centre[2]
    d = last_dof[s]
    while d >= 0:
        if d >= 6:
            t = screws[d - 6]
            vx, vy, vz, wx, wy, wz = t[0], t[1], t[2], t[3], t[4], t[5]
        else:
            vx, vy, vz = (1.0 if d == 0 else 0.0), (1.0 if d == 1 else 0.0), (1.0 if d == 2 else 0.0)
            wx, wy, wz = (1.0 if d == 3 else 0.0), (1.0 if d == 4 else 0.0), (1.0 if d == 5 else 0.0)
        index[count] = d
        moves[0, count] = vx + wy * dz - wz * dy
        moves[1, count] = vy + wz * dx - wx * dz
        moves[2, count] = vz + wx * dy - wy * dx
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
            index[count] = n + q
            moves[0, count], moves[1, count], moves[2, count] = mx, my, mz
            count += 1
    for i in range(3):
        index[count] = n + n_groups + shift[k] + i
        moves[0, count], moves[1, count], moves[2, count] = f[i], f[3 + i], f[6 + i]
        count += 1
    return count


@jit
def marker_system(
    parents, dof_parent, last_dof, offsets, groups, n_groups, owner, rest, base, shift, target, weight,
    frames, screws, centre, kind, scale, H, g,
):  # fmt: skip
    """Add one frame's markers to H (m, m; lower triangle) and g (m,): degrees of freedom, scales, offsets.

    owner (K,), rest (K, 3): markers on the body as it is; base (K, 3): their place in the segment before scaling; shift
    (K,): first offset parameter of each; target (K, 3) [m], weight (K,) [1/m²], 0 where unseen. Returns the cost.
    """
    n = screws.shape[0] + 6
    motion = np.empty((parents.size, n_groups, 3))
    scale_motion(parents, offsets, groups, frames, motion)
    index, moves = np.empty(n + n_groups + 3, np.int64), np.empty((3, n + n_groups + 3))
    cost = 0.0
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        rx, ry, rz = target[k, 0] - x, target[k, 1] - y, target[k, 2] - z
        rho, factor = robust(kind, scale, w * (rx * rx + ry * ry + rz * rz))
        cost += rho
        w *= factor
        if w <= 0.0:
            continue
        count = marker_columns(
            x, y, z, owner[k], k, n, n_groups, dof_parent, last_dof, groups, base, shift, motion, frames, screws,
            centre, index, moves,
        )  # fmt: skip
        for a in range(count):
            ia = index[a]
            wx, wy, wz = w * moves[0, a], w * moves[1, a], w * moves[2, a]
            g[ia] += wx * rx + wy * ry + wz * rz
            for b in range(count):
                ib = index[b]
                if ib <= ia:
                    H[ia, ib] += wx * moves[0, b] + wy * moves[1, b] + wz * moves[2, b]
    return cost


@jit
def marker_cost(owner, rest, target, weight, frames, kind, scale):
    """Robust cost of one frame's markers alone."""
    cost = 0.0
    for k in range(owner.size):
        if weight[k] > 0.0:
            x, y, z = place(frames, owner, rest, k)
            rx, ry, rz = target[k, 0] - x, target[k, 1] - y, target[k, 2] - z
            cost += robust(kind, scale, weight[k] * (rx * rx + ry * ry + rz * rz))[0]
    return cost
