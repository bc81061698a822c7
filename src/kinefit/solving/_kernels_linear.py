"""Linear algebra of a tree: packing, factors, damped steps, elimination.

The tree makes H sparse: two degrees of freedom are coupled only if one is an ancestor of the other. Row k of the packed
matrix C contains H[k, chain[k, t]] for t = 0..depth[k], from the root down to k itself, where `chain` (n, m) lists the
ancestors of each degree of freedom. The factorisation H = Lᵀ L keeps that pattern (Featherstone 2005). The chain of an
ancestor is the start of its descendants' chains, so every inner loop runs over neighbours in memory. With chains 0..k
the same code handles dense matrices.

Small dense products and solutions: libraries that start threads for each are many times slower.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit

LEAST_DAMPING = 1e-12
"""Least λ, as a share of H's mean diagonal: without it λ falls to 0 and cannot grow again. 1e-15 to 1e-6 work equally
well."""

_MAX_STOPS = 4  # rounds of stopping coordinates at limits; 8 save no step, 1 needs 14 % more if limits are active
_ROUNDING = 1e-15  # share of angle and limit that is added to a step to a limit; `retract` ends at the limit itself


@jit
def pack(H, chain, depth, C):
    """Pack the lower triangle of H (n, n) into C (n, m)."""
    for k in range(depth.size):
        for t in range(depth[k] + 1):
            C[k, t] = H[k, chain[k, t]]


@jit
def unpack(C, chain, depth, H):
    """Unpack C (n, m) into both triangles of H (n, n); H must be zero for uncoupled degrees of freedom."""
    for k in range(depth.size):
        for t in range(depth[k] + 1):
            H[k, chain[k, t]] = C[k, t]
            H[chain[k, t], k] = C[k, t]


@jit
def factor_tree(C, chain, depth):
    """Factor H = Lᵀ L in place, with the inverse of L's diagonal. False if H is not positive definite."""
    for k in range(depth.size - 1, -1, -1):
        row, d = C[k], depth[k]
        if not row[d] > 0.0:
            return False
        inverse = 1.0 / math.sqrt(row[d])
        row[d] = inverse
        for t in range(d):
            row[t] *= inverse
        for t in range(d):
            above, h = C[chain[k, t]], row[t]
            for s in range(t + 1):
                above[s] -= h * row[s]
    return True


@jit
def solve_tree(L, chain, depth, x):
    """Solve Lᵀ L x = b in place, with L from `factor_tree`."""
    n = depth.size
    for k in range(n - 1, -1, -1):
        row, d = L[k], depth[k]
        v = x[k] * row[d]
        x[k] = v
        for t in range(d):
            x[chain[k, t]] -= row[t] * v
    for k in range(n):
        row, d = L[k], depth[k]
        v = x[k]
        for t in range(d):
            v -= row[t] * x[chain[k, t]]
        x[k] = v * row[d]


@jit
def hold(held, chain, depth, C, g):
    """Exclude degrees of freedom `held` (n,) from a step: rows and columns of C become the identity's, g zero."""
    n = g.size
    for k in range(n):
        if held[k]:
            t = depth[k]
            g[k] = 0.0
            for i in range(t):
                C[k, i] = 0.0
            C[k, t] = 1.0
            for i in range(k + 1, n):
                if depth[i] > t and chain[i, t] == k:
                    C[i, t] = 0.0


@jit
def damped_step(C, g, damping, chain, depth, angles, lower, upper, locked, L, delta):
    """Solve (H + λ) δ = g within limits; returns the predicted fall of the cost, negative if H is not positive.

    Locked coordinates, and coordinates at a limit with an outward gradient, do not move. Coordinates that would exceed
    a limit stop at it, and the step of the others is solved again, because clipping alone gives poor steps.
    """
    n = g.size
    held, way, stops = np.empty(n, np.bool_), np.zeros(n), 0
    for k in range(n):
        held[k] = locked[k]
        if k >= 6:
            d = k - 6
            held[k] |= (angles[d] <= lower[d] and g[k] < 0.0) or (angles[d] >= upper[d] and g[k] > 0.0)
    for tried in range(_MAX_STOPS + 1):
        for i in range(n):
            for t in range(depth[i] + 1):
                L[i, t] = C[i, t]
            delta[i] = g[i]
        if stops > 0:
            subtract_product(C, chain, depth, way, delta)
        hold(held, chain, depth, L, delta)
        for i in range(n):
            L[i, depth[i]] += damping
        if not factor_tree(L, chain, depth):
            return -1.0
        solve_tree(L, chain, depth, delta)
        crossing = 0
        for k in range(6, n):
            d = k - 6
            if held[k]:
                continue
            q = angles[d] + delta[k]
            if q < lower[d] or q > upper[d]:
                crossing += 1
                if tried < _MAX_STOPS:
                    held[k] = True
                    limit = lower[d] if q < lower[d] else upper[d]
                    way[k] = limit - angles[d]
                    if way[k] != 0.0:
                        way[k] += math.copysign(_ROUNDING * (abs(limit) + abs(angles[d])), way[k])
        if crossing == 0 or tried == _MAX_STOPS:
            break
        stops += crossing
    fall = 0.0
    for i in range(n):
        fall += delta[i] * (g[i] + damping * delta[i])
    if stops > 0:
        for i in range(n):
            delta[i] += way[i]
        left = g.copy()
        subtract_product(C, chain, depth, delta, left)
        for i in range(n):
            fall += way[i] * (g[i] + left[i])
    return fall


@jit
def subtract_product(C, chain, depth, x, out):
    """out −= H x."""
    for k in range(depth.size):
        d, v = depth[k], 0.0
        for t in range(d):
            v += C[k, t] * x[chain[k, t]]
            out[chain[k, t]] -= C[k, t] * x[k]
        out[k] -= v + C[k, d] * x[k]


@jit
def adapt(damping, growth, fall, predicted, least):
    """Adapt damping and growth factor after a step, from the true and the predicted fall of the cost (Nielsen's rule).

    The damping does not fall below `least` > 0: `LEAST_DAMPING` times H's mean diagonal.
    """
    if not fall > 0.0:
        return damping * growth, 2.0 * growth
    gain = 2.0 * fall / predicted - 1.0
    shrink = 1.0 - gain * gain * gain
    return max(damping * (shrink if shrink > 0.1 else 0.1), least), 2.0


@jit
def invert_factor(C, chain, depth):
    """Replace H (packed) = Lᵀ L by L⁻¹; False if a degree of freedom has no information of its own."""
    n = depth.size
    own, x = np.empty(n), np.empty(chain.shape[1])
    for k in range(n):
        own[k] = C[k, depth[k]]
    if not factor_tree(C, chain, depth):
        return False
    for k in range(n - 1, -1, -1):
        d = depth[k]
        if not 1.0 / (C[k, d] * C[k, d]) > 1e-10 * own[k]:
            return False
        x[:d] = 0.0
        x[d] = 1.0
        for t in range(d, -1, -1):
            row = C[chain[k, t]]
            v = x[t] * row[t]
            x[t] = v
            for s in range(t):
                x[s] -= row[s] * v
        for t in range(d + 1):  # a slice set to an array compiles its error's text, for seconds
            C[k, t] = x[t]
    return True


@jit
def invert(C, chain, depth, out):
    """Inverse (n, n) of H (packed, destroyed); False if a degree of freedom has no information of its own."""
    if not invert_factor(C, chain, depth):
        return False
    for k in range(depth.size):
        for i in range(k + 1):
            t = min(depth[i], depth[k])
            while t >= 0 and chain[i, t] != chain[k, t]:
                t -= 1
            a, b, v = C[i], C[k], 0.0
            for s in range(t + 1):
                v += a[s] * b[s]
            out[k, i] = out[i, k] = v
    return True


@jit
def invert_diagonal(C, chain, depth, out):
    """Diagonal (n,) of the inverse of H (packed, destroyed); False as in `invert`."""
    if not invert_factor(C, chain, depth):
        return False
    for k in range(depth.size):
        v = 0.0
        for t in range(depth[k] + 1):
            v += C[k, t] * C[k, t]
        out[k] = v
    return True


@jit
def multiply(A, B, out):
    """out = A B; zeros of A are skipped."""
    for i in range(A.shape[0]):
        line = out[i]
        line[:] = 0.0
        k, last = 0, A.shape[1]
        while k < last:
            if A[i, k] == 0.0:
                k += 1
            elif k + 3 < last:
                a, b, c, d = A[i, k], A[i, k + 1], A[i, k + 2], A[i, k + 3]
                p, q, r, s = B[k], B[k + 1], B[k + 2], B[k + 3]
                for j in range(line.size):
                    line[j] += a * p[j] + b * q[j] + c * r[j] + d * s[j]
                k += 4
            else:
                a, p = A[i, k], B[k]
                for j in range(line.size):
                    line[j] += a * p[j]
                k += 1


@jit
def gram(A, B, out):
    """Add Aᵀ B to out (n, m), for A (N, n) and B (N, m)."""
    N = A.shape[0]
    for i in range(0, N - 1, 2):  # two at a time: rows of one point have the same zeros
        p, q = B[i], B[i + 1]
        for k in range(A.shape[1]):
            a, b = A[i, k], A[i + 1, k]
            if a != 0.0 or b != 0.0:
                line = out[k]
                for j in range(line.size):
                    line[j] += a * p[j] + b * q[j]
    if N % 2:
        p = B[N - 1]
        for k in range(A.shape[1]):
            a = A[N - 1, k]
            if a != 0.0:
                line = out[k]
                for j in range(line.size):
                    line[j] += a * p[j]


@jit
def along(data, segment, centre, screws, dof_parent, last_dof, J):
    """J (N, n): derivatives of the points of rows, data (6 or more, N), along their directions."""
    J[:] = 0.0
    for i in range(segment.size):
        x, y, z = data[0, i] - centre[0], data[1, i] - centre[1], data[2, i] - centre[2]
        nx, ny, nz = data[3, i], data[4, i], data[5, i]
        ax, ay, az = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        row = J[i]
        row[0], row[1], row[2], row[3], row[4], row[5] = nx, ny, nz, ax, ay, az
        d = last_dof[segment[i]]
        while d >= 6:
            t = screws[d - 6]
            row[d] = t[0] * nx + t[1] * ny + t[2] * nz + t[3] * ax + t[4] * ay + t[5] * az
            d = dof_parent[d]


@jit
def joint_columns(parents, frames, offsets, out):
    """out (S, 3, q): derivatives of joint centres in the world, from those of their offsets in parents (S, 3, q)."""
    for s in range(parents.size):
        p = parents[s]
        if p < 0:
            out[s] = 0.0
            continue
        f, d, above, here = frames[p], offsets[s], out[p], out[s]
        for i in range(3):
            a, b, c = f[3 * i], f[3 * i + 1], f[3 * i + 2]
            for k in range(d.shape[1]):
                here[i, k] = above[i, k] + a * d[0, k] + b * d[1, k] + c * d[2, k]


@jit
def point_columns(data, segment, group, frames, joints, places, out):
    """out (N, q): whitened derivatives of rows, from those of joints (S, 3, q) and of places in segments (M, 3, q)."""
    for i in range(segment.size):
        f, joint, place, row = frames[segment[i]], joints[segment[i]], places[group[i]], out[i]
        w = math.sqrt(data[7, i])
        x, y, z = w * data[3, i], w * data[4, i], w * data[5, i]
        a, b, c = f[0] * x + f[3] * y + f[6] * z, f[1] * x + f[4] * y + f[7] * z, f[2] * x + f[5] * y + f[8] * z
        for k in range(row.size):
            row[k] = (
                x * joint[0, k] + y * joint[1, k] + z * joint[2, k]
                + a * place[0, k] + b * place[1, k] + c * place[2, k]
            )  # fmt: skip
