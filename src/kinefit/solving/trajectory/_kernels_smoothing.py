"""Every frame's normal equations at once, and the motion prior that couples each frame to the next three.

A block of the prior between two frames has entries only within one joint: line i of it, (n, 3), holds the columns
first[i] .. first[i] + width[i] - 1.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies._kernels import difference, forward, retract
from kinefit.geometry._kernels_camera import project_jacobian
from kinefit.geometry.losses._kernels import weigh
from kinefit.solving._kernels import accumulate, project
from kinefit.solving.correspondences._kernels import pixel_rows, place, point_rows
from kinefit.solving.trajectory._kernels_shared import take_out, without_shift


@jit
def pixel_equations(
    roots, angles, owner, rest, cameras, camera, uv, weight, placed_owner, placed_rest, places, place_weight, robust,
    place_kind, place_scale, member, shared, kind, scale, parents, dof_start, prismatic, axes, rest_joints, chain,
    depth, C, g, cost,
):  # fmt: skip
    """Normal equations C (F, n, m) packed, g (F, n), cost (F,) of all frames at roots (F, 4, 4), angles (F, D).

    uv (F, K, 2) [px], weight (F, K) [1/px²] of points owner (K,), rest (K, 3) seen by camera (K,); and points
    placed_owner (P,), placed_rest (P, 3) that should lie at places (F, P, 3) [m], place_weight (F, P) [1/m²], of which
    the first `robust` have a loss place_kind, place_scale, and the others none.
    member (K,) is the group of a point, -1 for none, and shared (G,) [px²] the variance of the group's common shift,
    independent in every frame; see `_kernels_shared`.
    """
    size = 2 * owner.size + 3 * placed_owner.size
    data, segment, group = np.empty((8, size)), np.empty(size, np.int64), np.empty(size, np.int64)
    factor, blocks = np.empty(size), np.empty((parents.size, 27))
    frames, screws = np.empty((parents.size, 12)), np.empty((axes.shape[0], 6))
    shift, information = np.empty((shared.size, 2)), np.empty(shared.size)
    for t in range(roots.shape[0]):
        forward(parents, dof_start, prismatic, axes, rest_joints, roots[t], angles[t], frames, screws)
        count = pixel_rows(frames, owner, rest, cameras, camera, uv[t], weight[t], data, segment, group, 0)
        first = count
        of_shifts = 0.0
        if shared.size > 0:
            of_shifts = without_shift(data, group, count, weight[t], member, shared, kind, scale, shift, information)
        of_shifts += weigh(data, group, count, kind, scale, factor)
        count = point_rows(
            frames, placed_owner, placed_rest, places[t], place_weight[t], data, segment, group, count
        )  # fmt: skip
        for i in range(first, count):
            if group[i] >= robust:
                group[i] = -1
        cost[t] = of_shifts + weigh(
            data[:, first:], group[first:], count - first, place_kind, place_scale, factor[first:]
        )  # fmt: skip
        blocks[:] = 0.0
        accumulate(data, segment, factor, count, roots[t, 0, 3], roots[t, 1, 3], roots[t, 2, 3], blocks)
        if shared.size > 0:
            take_out(data, segment, group, first, factor, weight[t], member, shared, roots[t, :3, 3], blocks)
        project(parents, dof_start, chain, depth, screws, blocks, C[t], g[t])


@jit
def velocities(roots, angles, out):
    """Steps (F - 1, n) from each frame to the next; the root's turn is the rotation vector in the world."""
    for t in range(roots.shape[0] - 1):
        difference(roots[t], roots[t + 1], angles[t], angles[t + 1], out[t])


@jit
def differences(roots, other_roots, angles, other_angles, out):
    """Steps (F, n) from states to others, frame by frame."""
    for t in range(roots.shape[0]):
        difference(roots[t], other_roots[t], angles[t], other_angles[t], out[t])


@jit
def add_packed(packed, chain, depth, dense):
    """Add matrices (F, n, m), packed as the tree has them, to the lower triangles of dense ones (F, n, n)."""
    for t in range(packed.shape[0]):
        for k in range(depth.size):
            for i in range(depth[k] + 1):
                dense[t, k, chain[k, i]] += packed[t, k, i]


@jit
def _inverse_left_jacobian(w, sign, J):
    """J_l⁻¹ of SO(3) at sign · w; at −w it is J_r⁻¹."""
    t2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    t = math.sqrt(t2)
    b = 1.0 / 12.0 + t2 / 720.0 if t < 1e-2 else 1.0 / t2 - (1.0 + math.cos(t)) / (2.0 * t * math.sin(t))
    x, y, z = sign * w[0], sign * w[1], sign * w[2]
    J[0, 0], J[0, 1], J[0, 2] = 1.0 - b * (y * y + z * z), b * x * y + 0.5 * z, b * x * z - 0.5 * y
    J[1, 0], J[1, 1], J[1, 2] = b * x * y - 0.5 * z, 1.0 - b * (x * x + z * z), b * y * z + 0.5 * x
    J[2, 0], J[2, 1], J[2, 2] = b * x * z + 0.5 * y, b * y * z - 0.5 * x, 1.0 - b * (x * x + y * y)


@jit
def add_motion(steps, past, weight, first, width, band, g):
    """Add the prior on how steps change, r_s = v_s − past[s, 0] v_{s−1} − past[s, 1] v_{s−2}.

    steps (T - 1, n), past (T - 1, 2), weight (T - 1, n); blocks band (4, T, n, 3) as `_kernels_band` has them, and
    g (T, n). Returns the cost.
    """
    count, n = steps.shape
    cost = 0.0
    turns = np.zeros((3, 2, 3, 3))  # J_l⁻¹ and J_r⁻¹ of the turns of steps s, s − 1, s − 2
    J = np.zeros((4, n, 3))  # of r_s by frames s + 1, s, s − 1, s − 2
    c = np.zeros(4)
    for s in range(count):
        for i in range(2, 0, -1):
            for side in range(2):
                for a in range(3):
                    for b in range(3):
                        turns[i, side, a, b] = turns[i - 1, side, a, b]
        _inverse_left_jacobian(steps[s, 3:6], 1.0, turns[0, 0])
        _inverse_left_jacobian(steps[s, 3:6], -1.0, turns[0, 1])
        c[0], c[1], c[2] = 1.0, -past[s, 0], -past[s, 1]
        known = min(s + 2, 4)
        for i in range(n):
            for p in range(known):
                if width[i] == 1:
                    J[p, i, 0] = c[p] - (c[p - 1] if p > 0 else 0.0)
                else:
                    for b in range(3):
                        v = c[p] * turns[p, 0, i - first[i], b] if p < 3 else 0.0
                        J[p, i, b] = v - (c[p - 1] * turns[p - 1, 1, i - first[i], b] if p > 0 else 0.0)
        for i in range(n):
            w, start = weight[s, i], first[i]
            r = steps[s, i]
            for p in range(1, min(s + 1, 3)):
                r += c[p] * steps[s - p, i]
            cost += w * r * r
            for p in range(known):
                for a in range(width[i]):
                    wj = w * J[p, i, a]
                    g[s + 1 - p, start + a] -= wj * r
                    for q in range(p, known):  # frame s + 1 − q comes before
                        for b in range(width[i]):
                            band[q - p, s + 1 - q, start + a, b] += wj * J[q, i, b]
    return cost


@jit
def hold(held, first, width, chain, depth, C, band, g):
    """Take degrees of freedom held (T, n) out of a system, in place."""
    T, n = held.shape
    for t in range(T):
        for k in range(n):
            if held[t, k]:
                g[t, k] = 0.0
                C[t, k, : depth[k]] = 0.0
                C[t, k, depth[k]] = 1.0
            for i in range(depth[k]):
                if held[t, chain[k, i]]:
                    C[t, k, i] = 0.0
            for b in range(width[k]):
                for ahead in range(min(4, T - t)):
                    if held[t + ahead, k] or held[t, first[k] + b]:
                        band[ahead, t, k, b] = 0.0


@jit
def retract_all(roots, angles, delta, lower, upper, new_roots, new_angles):
    """All frames moved by delta (T, n), each within its limits (T, D)."""
    for t in range(roots.shape[0]):
        retract(roots[t], angles[t], delta[t], lower[t], upper[t], new_roots[t], new_angles[t])


@jit
def pixel_variance(
    roots, angles, owner, rest, cameras, camera, covariance,
    parents, dof_start, prismatic, axes, rest_joints, dof_parent, last_dof, out,
):  # fmt: skip
    """Variance out (T, K, 2) [px²] along u and v of projected points, from covariances (T, n, n); NaN if invisible."""
    frames, screws = np.empty((parents.size, 12)), np.empty((axes.shape[0], 6))
    n = covariance.shape[1]
    index, row = np.empty(n, np.int64), np.empty((2, n))
    for t in range(roots.shape[0]):
        forward(parents, dof_start, prismatic, axes, rest_joints, roots[t], angles[t], frames, screws)
        for k in range(owner.size):
            x, y, z = place(frames, owner, rest, k)
            ok, _, _, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[camera[k]], x, y, z)
            if not ok:
                out[t, k, 0] = out[t, k, 1] = math.nan
                continue
            x, y, z = x - roots[t, 0, 3], y - roots[t, 1, 3], z - roots[t, 2, 3]
            for c in range(2):
                a0, a1, a2 = (ux, uy, uz) if c == 0 else (vx, vy, vz)
                a3, a4, a5 = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
                row[c, 0], row[c, 1], row[c, 2], row[c, 3], row[c, 4], row[c, 5] = a0, a1, a2, a3, a4, a5
                for i in range(6):
                    index[i] = i
                count, d = 6, last_dof[owner[k]]
                while d >= 6:
                    s = screws[d - 6]
                    row[c, count] = a0 * s[0] + a1 * s[1] + a2 * s[2] + a3 * s[3] + a4 * s[4] + a5 * s[5]
                    index[count] = d
                    count, d = count + 1, dof_parent[d]
                total = 0.0
                for i in range(count):
                    line, part = covariance[t, index[i]], 0.0
                    for j in range(count):
                        part += line[index[j]] * row[c, j]
                    total += part * row[c, i]
                out[t, k, c] = total
