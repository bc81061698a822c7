"""Normal equations of a tree: rows -> 6×6 a segment -> H.

H is packed by the tree's pattern, see `_kernels_linear`.
"""

from __future__ import annotations

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_frames import moved
from kinefit.geometry.losses._kernels import weigh


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
