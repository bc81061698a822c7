"""Normal equations of a tree: rows -> 6×6 a segment -> H.

H is packed by the tree's pattern, see `_kernels_linear`.

Fit a pose to pixels in one kernel: `least_squares.levenberg_marquardt` with rows of pixels and a prediction.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies._kernels import difference, forward, retract
from kinefit.geometry._kernels_frames import moved
from kinefit.geometry.losses._kernels import weigh
from kinefit.solving._kernels_linear import LEAST_DAMPING, adapt, damped_step
from kinefit.solving.correspondences._kernels import pixel_rows


@jit
def accumulate(data, segment, factor, count, cx, cy, cz, blocks):
    """Add all rows into blocks (S, 27): upper triangle of Σ w a aᵀ row by row, then Σ w a r; a = (n, (x − c) × n)."""
    i = 0
    while i < count:
        s = segment[i]
        j = i + 1
        while j < count and segment[j] == s:
            j += 1
        h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = 0.0
        h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = 0.0
        g0 = g1 = g2 = g3 = g4 = g5 = 0.0
        px, py, pz = data[0, i:j], data[1, i:j], data[2, i:j]  # slices from zero: so that the loop becomes vector code
        nx, ny, nz = data[3, i:j], data[4, i:j], data[5, i:j]
        residual, weight, share = data[6, i:j], data[7, i:j], factor[i:j]
        for k in range(j - i):
            x, y, z = px[k] - cx, py[k] - cy, pz[k] - cz
            a0, a1, a2 = nx[k], ny[k], nz[k]
            a3, a4, a5 = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
            w = weight[k] * share[k]
            r = w * residual[k]
            g0 += a0 * r
            g1 += a1 * r
            g2 += a2 * r
            g3 += a3 * r
            g4 += a4 * r
            g5 += a5 * r
            w0, w1, w2, w3, w4 = w * a0, w * a1, w * a2, w * a3, w * a4
            h00 += w0 * a0
            h01 += w0 * a1
            h02 += w0 * a2
            h03 += w0 * a3
            h04 += w0 * a4
            h05 += w0 * a5
            h11 += w1 * a1
            h12 += w1 * a2
            h13 += w1 * a3
            h14 += w1 * a4
            h15 += w1 * a5
            h22 += w2 * a2
            h23 += w2 * a3
            h24 += w2 * a4
            h25 += w2 * a5
            h33 += w3 * a3
            h34 += w3 * a4
            h35 += w3 * a5
            h44 += w4 * a4
            h45 += w4 * a5
            h55 += w * a5 * a5
        b = blocks[s]
        b[0] += h00
        b[1] += h01
        b[2] += h02
        b[3] += h03
        b[4] += h04
        b[5] += h05
        b[6] += h11
        b[7] += h12
        b[8] += h13
        b[9] += h14
        b[10] += h15
        b[11] += h22
        b[12] += h23
        b[13] += h24
        b[14] += h25
        b[15] += h33
        b[16] += h34
        b[17] += h35
        b[18] += h44
        b[19] += h45
        b[20] += h55
        b[21] += g0
        b[22] += g1
        b[23] += g2
        b[24] += g3
        b[25] += g4
        b[26] += g5
        i = j


@jit
def project(parents, dof_start, chain, depth, screws, blocks, C, g):
    """H = Σ Jₛᵀ Hₛ Jₛ, packed in C, and g = Σ Jₛᵀ gₛ; `blocks` are summed up the tree."""
    for s in range(parents.size - 1, -1, -1):
        b = blocks[s]
        for d in range(dof_start[s + 1] - 1, dof_start[s] - 1, -1):
            j0, j1, j2, j3, j4, j5 = screws[d, 0], screws[d, 1], screws[d, 2], screws[d, 3], screws[d, 4], screws[d, 5]
            f0 = b[0] * j0 + b[1] * j1 + b[2] * j2 + b[3] * j3 + b[4] * j4 + b[5] * j5
            f1 = b[1] * j0 + b[6] * j1 + b[7] * j2 + b[8] * j3 + b[9] * j4 + b[10] * j5
            f2 = b[2] * j0 + b[7] * j1 + b[11] * j2 + b[12] * j3 + b[13] * j4 + b[14] * j5
            f3 = b[3] * j0 + b[8] * j1 + b[12] * j2 + b[15] * j3 + b[16] * j4 + b[17] * j5
            f4 = b[4] * j0 + b[9] * j1 + b[13] * j2 + b[16] * j3 + b[18] * j4 + b[19] * j5
            f5 = b[5] * j0 + b[10] * j1 + b[14] * j2 + b[17] * j3 + b[19] * j4 + b[20] * j5
            k = 6 + d
            g[k] = b[21] * j0 + b[22] * j1 + b[23] * j2 + b[24] * j3 + b[25] * j4 + b[26] * j5
            row = C[k]
            row[0], row[1], row[2], row[3], row[4], row[5] = f0, f1, f2, f3, f4, f5
            for i in range(6, depth[k] + 1):
                t = screws[chain[k, i] - 6]
                row[i] = t[0] * f0 + t[1] * f1 + t[2] * f2 + t[3] * f3 + t[4] * f4 + t[5] * f5
        p = parents[s]
        if p >= 0:
            up = blocks[p]
            for i in range(27):
                up[i] += b[i]
    b = blocks[0]
    i = 0
    for r in range(6):
        g[r] = b[21 + r]
        for c in range(r, 6):
            C[c, r] = b[i]
            i += 1


@jit
def assemble(
    data, segment, group, count, kind, scale, centre, parents, dof_start, chain, depth, screws, factor, blocks, C, g
):
    """Rows -> robust factors, H packed in C, and g; returns the cost Σ ρ."""
    cost = weigh(data, group, count, kind, scale, factor)
    blocks[:] = 0.0
    accumulate(data, segment, factor, count, centre[0], centre[1], centre[2], blocks)
    project(parents, dof_start, chain, depth, screws, blocks, C, g)
    return cost


@jit
def add_parameters(index, residual, weight, depth, C, g):
    """Add rows on degrees of freedom to a packed H and g; returns their cost."""
    cost = 0.0
    for i in range(index.size):
        k = index[i]
        C[k, depth[k]] += weight[i]
        g[k] += weight[i] * residual[i]
        cost += weight[i] * residual[i] * residual[i]
    return cost


@jit
def add_pairs(segments, point_a, point_b, normal, residual, weight, centre, screws, dof_parent, last_dof, H, g):
    """Add pair rows to a dense H (lower triangle) and g; returns their cost."""
    n = g.size
    row = np.empty(n)
    cost = 0.0
    for i in range(residual.size):
        row[:] = 0.0
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        for side in range(2):
            p = point_a[i] if side == 0 else point_b[i]
            sign = 1.0 if side == 0 else -1.0
            x, y, z = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
            ax, ay, az = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
            row[0] += sign * nx
            row[1] += sign * ny
            row[2] += sign * nz
            row[3] += sign * ax
            row[4] += sign * ay
            row[5] += sign * az
            d = last_dof[segments[i, side]]
            while d >= 6:
                t = screws[d - 6]
                row[d] += sign * (t[0] * nx + t[1] * ny + t[2] * nz + t[3] * ax + t[4] * ay + t[5] * az)
                d = dof_parent[d]
        w = weight[i]
        cost += w * residual[i] * residual[i]
        for k in range(n):
            wk = w * row[k]
            g[k] += wk * residual[i]
            if wk != 0.0:
                for j in range(k + 1):
                    H[k, j] += wk * row[j]
    return cost


@jit
def joint_moves(frames, screws, rest, root, dof_parent, last_dof, moves):
    """moves (S, 3, n): derivative of every joint centre by every degree of freedom."""
    moves[:] = 0.0
    for s in range(rest.shape[0]):
        x, y, z = moved(frames[s], rest[s, 0], rest[s, 1], rest[s, 2])
        x, y, z = x - root[0, 3], y - root[1, 3], z - root[2, 3]
        m = moves[s]
        m[0, 0] = m[1, 1] = m[2, 2] = 1.0
        m[0, 4], m[0, 5], m[1, 5] = z, -y, x
        m[1, 3], m[2, 3], m[2, 4] = -z, y, -x
        d = last_dof[s]
        while d >= 6:
            t = screws[d - 6]
            m[0, d] = t[0] + t[4] * z - t[5] * y
            m[1, d] = t[1] + t[5] * x - t[3] * z
            m[2, d] = t[2] + t[3] * y - t[4] * x
            d = dof_parent[d]


@jit
def add_joint(first, index, gap, precision, H, g):
    """Add rows on degrees of freedom `first` + index (K,), with a joint weight (K, K), to H (lower) and g; their cost.

    The indices increase.
    """
    cost = 0.0
    for i in range(index.size):
        a, pull = first + index[i], 0.0
        for j in range(index.size):
            pull += precision[i, j] * gap[j]
        for j in range(i + 1):
            H[a, first + index[j]] += precision[i, j]
        g[a] += pull
        cost += gap[i] * pull
    return cost


@jit
def mirror(H):
    """Copy the lower triangle of H (n, n) to the upper."""
    for i in range(H.shape[0]):
        for j in range(i):
            H[j, i] = H[i, j]


@jit
def minimum(
    parents, dof_start, prismatic, axes, rest, chain, depth, every, all_before, lower, upper, locked,
    owner, place, cameras, camera, uv, weight, kind, scale,
    predicted_root, predicted_angles, information, held, usual, precision,
    roots, angles, H, g, most, tolerance, damping, share,
):  # fmt: skip
    """Levenberg-Marquardt over pixels (as `pixel_rows`, with one robust loss), a predicted pose and a prior posture.

    Parameters: the tree; every (n, n) and all_before (n,) the dense pattern; owner, place, cameras, camera, uv, weight
    as in `pixel_rows`; predicted pose with its information (n, n); a prior on coordinates held (P,) with mean usual
    (D,) and precision (P, P). Two of each, roots (2, 4, 4), angles (2, D), H (2, n, n), g (2, n): the first state is
    the start. The first damping is at least a share of H's mean diagonal.
    Returns which of the two is the minimum (-1 if a number is not finite), its cost, and the number of steps tried.
    Only the lower triangle of H is filled.
    """
    n, D, S, N = depth.size, axes.shape[0], parents.size, 2 * owner.size
    frames, screws, centre = np.empty((S, 12)), np.empty((D, 6)), np.empty(3)
    data, segment, group = np.empty((8, N)), np.empty(N, np.int64), np.empty(N, np.int64)
    factor, blocks, C = np.empty(N), np.empty((S, 27)), np.empty(chain.shape)
    L, delta, gap, away = np.empty((n, n)), np.zeros(n), np.empty(n), np.empty(held.size)
    retract(roots[0], angles[0], delta, lower, upper, roots[1], angles[1])
    now, tried, cost, mean, growth, predicted = 0, 0, math.inf, 0.0, 2.0, 0.0
    nothing, least = 0.0, 0.0
    while True:
        new = 1 - now
        root, q, A, b = roots[new], angles[new], H[new], g[new]
        forward(parents, dof_start, prismatic, axes, rest, root, q, frames, screws)
        end = pixel_rows(frames, owner, place, cameras, camera, uv, weight, data, segment, group, 0)
        for i in range(3):
            centre[i] = root[i, 3]
        value = assemble(
            data, segment, group, end, kind, scale, centre, parents, dof_start, chain, depth, screws, factor, blocks,
            C, b,
        )  # fmt: skip
        A[:] = 0.0
        for k in range(n):
            for t in range(depth[k] + 1):
                A[k, chain[k, t]] = C[k, t]
        difference(root, predicted_root, q, predicted_angles, gap)
        value += add_joint(0, all_before, gap, information, A, b)
        for i in range(held.size):
            away[i] = usual[held[i]] - q[held[i]]
        value += add_joint(6, held, away, precision, A, b)
        if not abs(value) < math.inf:
            return -1, value, tried
        if tried == 0:
            for k in range(n):
                mean += A[k, k] / n
            mean += 1e-300
            least, nothing = LEAST_DAMPING * mean, 1e-16 * value
            damping = max(damping, share * mean, least)
            now, cost = new, value
        else:
            damping, growth = adapt(damping, growth, cost - value, predicted, least)
            if value < cost:
                now, cost = new, value
            elif damping > 1e16 * mean:
                return now, cost, tried
        predicted = -1.0
        while predicted < 0.0:
            if tried == most:
                return now, cost, tried
            tried += 1
            predicted = damped_step(
                H[now], g[now], damping, every, all_before, angles[now], lower, upper, locked, L, delta
            )
            if predicted < 0.0:
                damping, growth = adapt(damping, growth, -1.0, 1.0, least)
        if predicted <= tolerance * cost + nothing:
            return now, cost, tried
        retract(roots[now], angles[now], delta, lower, upper, roots[1 - now], angles[1 - now])
