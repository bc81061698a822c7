"""Cost of the joint rotations of an explanation under their learnt distribution, from the root outwards: numba."""

import math

import numpy as np

from kinefit._jit import jit
from kinefit.identification.frame._kernels_evidence import rigid

MAX_ITERATIONS = 8
_UNKNOWN_TURN_VARIANCE = 10.0  # [rad²] prior variance of an unknown turn


@jit
def inverse(A, out):
    """Write to out (3, 3) the inverse of a symmetric A (3, 3)."""
    a, b, c, d, e, f = A[0, 0], A[1, 1], A[2, 2], A[0, 1], A[0, 2], A[1, 2]
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    out[0, 0], out[1, 1], out[2, 2] = (b * c - f * f) / det, (a * c - e * e) / det, (a * b - d * d) / det
    out[0, 1] = out[1, 0] = (e * f - d * c) / det
    out[0, 2] = out[2, 0] = (d * f - b * e) / det
    out[1, 2] = out[2, 1] = (d * e - a * f) / det


@jit
def turn_of(R, out):
    """Write to out (3,) [rad] the rotation vector of R (3, 3)."""
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1)
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    sine = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, cosine)
    if sine > 1e-6:
        out[0], out[1], out[2] = x * angle / sine, y * angle / sine, z * angle / sine
    elif cosine > 0:
        out[0], out[1], out[2] = x, y, z
    else:  # half a turn, either way
        best = 0
        for k in range(1, 3):
            best = k if R[k, k] > R[best, best] else best
        length = math.sqrt(max(0.5 * (1 + R[best, best]), 1e-12))
        for k in range(3):
            out[k] = math.pi * (length if k == best else 0.5 * R[best, k] / length)


@jit
def rotate_by(v, R, out):
    """Write to out (3, 3) exp(v) R, v (3,) [rad]."""
    angle = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    a = math.sin(angle) / angle if angle > 1e-9 else 1.0
    b = (1 - math.cos(angle)) / angle**2 if angle > 1e-9 else 0.5
    for k in range(3):
        x, y, z = R[0, k], R[1, k], R[2, k]
        cx, cy, cz = v[1] * z - v[2] * y, v[2] * x - v[0] * z, v[0] * y - v[1] * x
        out[0, k] = x + a * cx + b * (v[1] * cz - v[2] * cy)
        out[1, k] = y + a * cy + b * (v[2] * cx - v[0] * cz)
        out[2, k] = z + a * cz + b * (v[0] * cy - v[1] * cx)


@jit
def fit_rotation(n, x, y, w, R0, G, R, H):
    """Minimise f = Σ w |y - R x|² + vᵀ G v, v = log(R R0ᵀ), over R (3, 3) in place by Gauss-Newton; returns f.

    x, y (n, 3) [m] about their weighted centroids, w (n,) [1/m²]; writes H (3, 3), the data's part of the curvature.
    """
    v, g, step, A, inv, D = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    f, turn = 0.0, 0
    while True:
        f = 0.0
        H[:] = 0.0
        g[:] = 0.0
        for i in range(n):
            r0 = R[0, 0] * x[i, 0] + R[0, 1] * x[i, 1] + R[0, 2] * x[i, 2]
            r1 = R[1, 0] * x[i, 0] + R[1, 1] * x[i, 1] + R[1, 2] * x[i, 2]
            r2 = R[2, 0] * x[i, 0] + R[2, 1] * x[i, 1] + R[2, 2] * x[i, 2]
            e0, e1, e2 = y[i, 0] - r0, y[i, 1] - r1, y[i, 2] - r2
            f += w[i] * (e0 * e0 + e1 * e1 + e2 * e2)
            g[0] += w[i] * (r1 * e2 - r2 * e1)
            g[1] += w[i] * (r2 * e0 - r0 * e2)
            g[2] += w[i] * (r0 * e1 - r1 * e0)
            H[0, 0] += w[i] * (r1 * r1 + r2 * r2)
            H[1, 1] += w[i] * (r0 * r0 + r2 * r2)
            H[2, 2] += w[i] * (r0 * r0 + r1 * r1)
            H[0, 1] -= w[i] * r0 * r1
            H[0, 2] -= w[i] * r0 * r2
            H[1, 2] -= w[i] * r1 * r2
        H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
        for a in range(3):
            for b in range(3):
                D[a, b] = R[a, 0] * R0[b, 0] + R[a, 1] * R0[b, 1] + R[a, 2] * R0[b, 2]
        turn_of(D, v)
        for a in range(3):
            pull = G[a, 0] * v[0] + G[a, 1] * v[1] + G[a, 2] * v[2]
            f += v[a] * pull
            g[a] -= pull
        turn += 1
        if turn > MAX_ITERATIONS:
            break
        for a in range(3):
            for b in range(3):
                A[a, b] = H[a, b] + G[a, b]
        inverse(A, inv)
        for a in range(3):
            step[a] = inv[a, 0] * g[0] + inv[a, 1] * g[1] + inv[a, 2] * g[2]
        length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        for a in range(3):
            step[a] *= 1.0 if length < 1.0 else 1.0 / length
        rotate_by(step, R, D)
        R[:] = D
        if length < 1e-3:
            turn = MAX_ITERATIONS
    return f


@jit
def turn_costs(labels, points, starts, markers, x, sigma, parent, here, there, spread, middle, give, most, out):
    """Write to out (E,) the cost of all joint rotations: -log likelihood ratio to uniform rotations.

    labels (E, M) the point of each label, -1 for none; points (N, 3); segments, parents first: `starts` (S + 1,) into
    markers (K,), x (K, 3), sigma (K,) [m]; parent (S,), -1 for the root; here, there (S, 3) the joint in the segment
    and in its parent, spread (S,) [m]; middle (S, 3, 3) and give (S, 3, 3) [rad²]: mean and covariance of the joint's
    turns, give[s, 0, 0] < 0 if unknown; most: largest cost of one joint. Each segment is fitted to its points and its
    joint, with and without the prior on the turn if the parent's rotation is known; the difference is counted.
    """
    S = len(parent)
    size = 1
    for s in range(S):
        size = max(size, starts[s + 1] - starts[s] + 1)
    xs, ys, ws = np.empty((size, 3)), np.empty((size, 3)), np.empty(size)
    Rs, ts, Ps = np.zeros((S, 3, 3)), np.zeros((S, 3)), np.zeros((S, 3, 3))
    placed, known, tv = np.zeros(S, np.bool_), np.zeros(S, np.bool_), np.zeros(S)
    R0, G, H, R, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    best, Hbest, t, a, b = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for h in range(len(labels)):
        total = 0.0
        for s in range(S):
            p = parent[s]
            n = 0
            for i in range(starts[s], starts[s + 1]):
                q = labels[h, markers[i]]
                if q >= 0:
                    xs[n], ys[n], ws[n] = x[i], points[q], 1 / sigma[i] ** 2
                    n += 1
            point_count = n
            has_parent = p >= 0 and placed[p]
            if has_parent:
                square = 0.0
                for k in range(3):
                    ys[n, k] = ts[p, k]
                    xs[n, k] = here[s, k]
                    for c in range(3):
                        ys[n, k] += Rs[p, k, c] * there[s, c]
                    square += there[s, k] ** 2
                trace = (Ps[p, 0, 0] + Ps[p, 1, 1] + Ps[p, 2, 2]) / 3
                ws[n] = 1 / (spread[s] ** 2 + tv[p] + 2 / 3 * square * min(trace, 1.0))
                n += 1
            placed[s], known[s] = n >= 3 or (has_parent and known[p] and give[s, 0, 0] >= 0), False
            if not placed[s]:
                continue
            a[:], b[:] = 0.0, 0.0
            weight = 0.0
            for i in range(n):
                weight += ws[i]
                for k in range(3):
                    a[k] += ws[i] * xs[i, k]
                    b[k] += ws[i] * ys[i, k]
            for k in range(3):
                a[k] /= weight
                b[k] /= weight
                for i in range(n):
                    xs[i, k] -= a[k]
                    ys[i, k] -= b[k]
            free_cost = rigid(n, xs, ys, ws, best, t, Hbest)
            prior = has_parent and known[p] and give[s, 0, 0] >= 0
            if prior:
                for k in range(3):
                    for c in range(3):
                        R0[k, c] = Rs[p, k, 0] * middle[s, 0, c] + Rs[p, k, 1] * middle[s, 1, c]
                        R0[k, c] += Rs[p, k, 2] * middle[s, 2, c]
                for k in range(3):
                    for c in range(3):
                        P[k, c] = Ps[p, k, c]
                        for u in range(3):
                            for v in range(3):
                                P[k, c] += R0[k, u] * give[s, u, v] * R0[c, v]
                inverse(P, G)
                R[:] = best
                cost = fit_rotation(n, xs, ys, ws, R0, G, R, H)
                best[:] = R
                Hbest[:] = H
                R[:] = R0
                other_cost = fit_rotation(n, xs, ys, ws, R0, G, R, H)
                if other_cost < cost:
                    cost = other_cost
                    best[:] = R
                    Hbest[:] = H
                if point_count > 0:
                    cost = 0.5 * (cost - free_cost)
                    total += cost if cost < most else most
            else:
                G[:] = 0.0
                for k in range(3):
                    G[k, k] = 1 / _UNKNOWN_TURN_VARIANCE
                R[:] = best
                fit_rotation(n, xs, ys, ws, best.copy(), G, R, Hbest)  # for its curvature in the world
            Rs[s] = best
            for k in range(3):
                ts[s, k] = b[k] - best[k, 0] * a[0] - best[k, 1] * a[1] - best[k, 2] * a[2]
                for c in range(3):
                    Hbest[k, c] += G[k, c]
            inverse(Hbest, Ps[s])
            tv[s] = 1 / weight
            known[s] = True
        out[h] = total
