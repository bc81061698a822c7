"""Nodes of a skinned mesh in the world, and their derivatives along directions."""

from __future__ import annotations

from kinefit._jit import jit
from kinefit.geometry._kernels_frames import moved


@jit
def posed(nodes, owners, weights, frames, out):
    """Σ_k w_k (R_k x_k + t_k): nodes (V, K, 3) at rest, owners and weights (V, K), frames (S, 12) -> out (V, 3)."""
    for v in range(owners.shape[0]):
        x = y = z = 0.0
        for k in range(owners.shape[1]):
            w = weights[v, k]
            if w == 0.0:
                continue
            a, b, c = moved(frames[owners[v, k]], nodes[v, k, 0], nodes[v, k, 1], nodes[v, k, 2])
            x, y, z = x + w * a, y + w * b, z + w * c
        out[v, 0], out[v, 1], out[v, 2] = x, y, z


@jit
def moves(
    nodes, owners, weights, index, share, direction, centre, frames, screws, dof_parent, last_dof,
    drive_dof, drive_segment, drive_twist, above, out,
):  # fmt: skip
    """Derivatives of points along directions by every degree of freedom: Σ_j b_j Σ_k w_k (n, (y_k − c) × n) J_k.

    index, share (N, C): the nodes that a point lies between, and its barycentric coordinates; direction (N, 3).
    drive_dof, drive_segment (M,) and drive_twist (M, 6): motions of joints with an angle. above (S, S) bool: above[s,
    p] where p is s or an ancestor of it. out (N, 6 + D).
    """
    for i in range(index.shape[0]):
        n0, n1, n2 = direction[i, 0], direction[i, 1], direction[i, 2]
        row = out[i]
        for d in range(row.size):
            row[d] = 0.0
        for j in range(index.shape[1]):
            v = index[i, j]
            for k in range(owners.shape[1]):
                w = share[i, j] * weights[v, k]
                if w == 0.0:
                    continue
                s = owners[v, k]
                x, y, z = moved(frames[s], nodes[v, k, 0], nodes[v, k, 1], nodes[v, k, 2])
                x, y, z = x - centre[0], y - centre[1], z - centre[2]
                a0, a1, a2 = w * n0, w * n1, w * n2
                a3, a4, a5 = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
                row[0] += a0
                row[1] += a1
                row[2] += a2
                row[3] += a3
                row[4] += a4
                row[5] += a5
                d = last_dof[s]
                while d >= 6:
                    g = screws[d - 6]
                    row[d] += a0 * g[0] + a1 * g[1] + a2 * g[2] + a3 * g[3] + a4 * g[4] + a5 * g[5]
                    d = dof_parent[d]
                for m in range(drive_dof.size):
                    if above[s, drive_segment[m]]:
                        g = drive_twist[m]
                        row[drive_dof[m]] += a0 * g[0] + a1 * g[1] + a2 * g[2] + a3 * g[3] + a4 * g[4] + a5 * g[5]
