"""Errors that a detector's points of one segment share in one view: a common shift, estimated with the pose.

With residuals r_i [px] of a group's points, weights w_i and a shift b of variance U, the cost is
Σ ρ(w_i |r_i − b|²) + |b|²/U. At its minimum over b the gradient by the pose is that of r_i − b, and the normal matrix
Σ d_i a_i a_iᵀ − U/(1 + U Σ d_i) (Σ d_i a_i)(Σ d_i a_i)ᵀ with d_i = w_i times the robust factor: correlated points
count as few.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry.losses._kernels import robust

_MAX_ROUNDS = 12  # of alternating shifts and robust factors
_MIN_CHANGE_PX = 0.01  # [px] of a shift, below which it has converged


@jit
def without_shift(data, group, count, weight, member, shared, kind, scale, shift, information):
    """Subtract each group's shift (G, 2) [px] from the residuals of pixel rows 0 .. count; returns the shifts' cost.

    weight (K,) [1/px²] of points, member (K,) their group or -1, shared (G,) [px²]; information (G,) is workspace.
    """
    shift[:] = 0.0
    for k in range(_MAX_ROUNDS):
        information[:] = 0.0
        total = np.zeros(shift.shape)
        for i in range(0, count, 2):
            m = member[group[i]]
            if m < 0:
                continue
            w = weight[group[i]]
            gu, gv = math.sqrt(w / data[7, i]), math.sqrt(w / data[7, i + 1])  # metres a pixel
            u, v = data[6, i] / gu, data[6, i + 1] / gv
            du, dv = u - shift[m, 0], v - shift[m, 1]
            s2 = w * (du * du + dv * dv)
            if k == 0:  # the shift is not known yet
                s2 /= 1.0 + w * shared[m]
            _, factor = robust(kind, scale, s2)
            d = w * factor
            information[m] += d
            total[m, 0] += d * u
            total[m, 1] += d * v
        moved = 0.0
        for m in range(shared.size):
            posterior = 1.0 / shared[m] + information[m]
            u, v = total[m, 0] / posterior, total[m, 1] / posterior
            moved = max(moved, abs(u - shift[m, 0]), abs(v - shift[m, 1]))
            shift[m, 0], shift[m, 1] = u, v
        if moved < _MIN_CHANGE_PX:
            break
    for i in range(count):
        m = member[group[i]]
        if m >= 0:
            data[6, i] -= shift[m, i % 2] * math.sqrt(weight[group[i]] / data[7, i])
    cost = 0.0
    for m in range(shared.size):
        cost += (shift[m, 0] * shift[m, 0] + shift[m, 1] * shift[m, 1]) / shared[m]
    return cost


@jit
def take_out(data, segment, group, count, factor, weight, member, shared, centre, blocks):
    """Subtract from segments' blocks (S, 27) the information that the groups' shifts absorb; blocks: `accumulate`."""
    moved = np.zeros((shared.size, 2, 6))
    information, owner = np.zeros(shared.size), np.zeros(shared.size, np.int64)
    for i in range(count):
        m = member[group[i]]
        if m < 0:
            continue
        w = weight[group[i]]
        d = factor[i] * math.sqrt(w * data[7, i])
        x, y, z = data[0, i] - centre[0], data[1, i] - centre[1], data[2, i] - centre[2]
        a0, a1, a2 = data[3, i], data[4, i], data[5, i]
        v = moved[m, i % 2]
        v[0] += d * a0
        v[1] += d * a1
        v[2] += d * a2
        v[3] += d * (y * a2 - z * a1)
        v[4] += d * (z * a0 - x * a2)
        v[5] += d * (x * a1 - y * a0)
        information[m] += 0.5 * w * factor[i]
        owner[m] = segment[i]
    for m in range(shared.size):
        share = shared[m] / (1.0 + shared[m] * information[m])
        for axis in range(2):
            v, b, k = moved[m, axis], blocks[owner[m]], 0
            for p in range(6):
                for q in range(p, 6):
                    b[k] -= share * v[p] * v[q]
                    k += 1
