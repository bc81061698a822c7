"""Cost of the joint rotations of an explanation under their learnt distribution, from the root outwards: numba."""

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_matrices import copy, inverse, times, times_transposed
from kinefit.markers.frame._kernels_evidence import rigid
from kinefit.solving.correspondences._kernels import rotation_vector

MAX_ITERATIONS = 8
_UNKNOWN_TURN_INFORMATION = 0.1  # [1/rad²] prior of an unknown turn


@jit
def fit_rotation(C, S, square, R0, G, R):
    """Minimise f = Σ w |y - R x|² + vᵀ G v, v = log(R R0ᵀ), over R (3, 3) in place by Gauss-Newton; returns f.

    Of points about their weighted centroids: C = Σ w (|x|² I - x xᵀ), S = Σ w x yᵀ (3, 3), square = Σ w (|x|² + |y|²).
    """
    v, pull, M, H, T = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    f, length = 0.0, 1.0
    for iteration in range(MAX_ITERATIONS + 1):
        times(R, S, M)
        times_transposed(R, R0, T)
        rotation_vector(T, v)
        f = square - 2.0 * (M[0, 0] + M[1, 1] + M[2, 2])
        for i in range(3):
            pull[i] = G[i, 0] * v[0] + G[i, 1] * v[1] + G[i, 2] * v[2]
            f += v[i] * pull[i]
        if length < 1e-3 or iteration == MAX_ITERATIONS:
            break
        information(R, C, G, T, H)
        inverse(H, T)
        a, b, c = M[1, 2] - M[2, 1] - pull[0], M[2, 0] - M[0, 2] - pull[1], M[0, 1] - M[1, 0] - pull[2]
        for i in range(3):
            v[i] = T[i, 0] * a + T[i, 1] * b + T[i, 2] * c
        length = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        angle, scale = min(length, 1.0), 1.0 / max(length, 1e-300)
        a, b, c, sine, versine = v[0] * scale, v[1] * scale, v[2] * scale, math.sin(angle), 1.0 - math.cos(angle)
        for j in range(3):
            x, y, z = R[0, j], R[1, j], R[2, j]
            along = a * x + b * y + c * z
            R[0, j] += sine * (b * z - c * y) + versine * (a * along - x)
            R[1, j] += sine * (c * x - a * z) + versine * (b * along - y)
            R[2, j] += sine * (a * y - b * x) + versine * (c * along - z)
    return f


@jit
def information(R, C, G, T, out):
    """out = R C Rᵀ + G; T (3, 3) is overwritten."""
    times(R, C, T)
    times_transposed(T, R, out)
    for i in range(3):
        for j in range(3):
            out[i, j] += G[i, j]


@jit
def turn_costs(labels, points, starts, markers, x, sigma, parent, here, there, spread, middle, give, most, out):
    """Write to out (E,) the cost of all joint rotations: -log likelihood ratio to uniform rotations.

    labels (E, M) the point of each label, -1 for none; points (N, 3); segments, parents first: `starts` (S + 1,) into
    markers (K,), x (K, 3), sigma (K,) [m]; parent (S,), -1 for the root; here, there (S, 3) the joint in the segment
    and in its parent, spread (S,) [m]; middle (S, 3, 3) and give (S, 3, 3) [rad²]: mean and covariance of the joint's
    turns, give[s, 0, 0] < 0 if unknown; most: largest cost of one joint. Each segment is fitted to its points and its
    joint, with and without the prior on the turn if the parent's rotation is known; the difference is counted.
    """
    S, size = len(parent), len(x) + 1
    xs, ys, ws = np.empty((size, 3)), np.empty((size, 3)), np.empty(size)
    Rs, ts, Ps = np.zeros((S, 3, 3)), np.zeros((S, 3)), np.zeros((S, 3, 3))
    placed, variance = np.zeros(S, np.bool_), np.zeros(S)
    R, C, t, start, R0 = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    G, H, T, cross, unknown = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    a, b, zero = np.empty(3), np.empty(3), np.zeros((3, 3))
    for i in range(3):
        unknown[i, i] = _UNKNOWN_TURN_INFORMATION
    for h in range(len(labels)):
        total = 0.0
        for s in range(S):
            p, count = parent[s], 0
            for i in range(starts[s], starts[s + 1]):
                q = labels[h, markers[i]]
                if q >= 0:
                    for k in range(3):
                        xs[count, k], ys[count, k] = x[i, k], points[q, k]
                    ws[count] = 1 / sigma[i] ** 2
                    count += 1
            has_parent = p >= 0 and placed[p]
            has_prior = has_parent and give[s, 0, 0] >= 0
            n = count
            if has_parent:
                lever, turned = 0.0, Rs[p]
                for k in range(3):
                    xs[n, k] = here[s, k]
                    ys[n, k] = ts[p, k] + turned[k, 0] * there[s, 0] + turned[k, 1] * there[s, 1]
                    ys[n, k] += turned[k, 2] * there[s, 2]
                    lever += 2 / 3 * there[s, k] ** 2
                lever *= min((Ps[p, 0, 0] + Ps[p, 1, 1] + Ps[p, 2, 2]) / 3, 1.0)
                ws[n] = 1 / (spread[s] ** 2 + variance[p] + lever)
                n += 1
            placed[s] = n >= 3 or has_prior
            if not placed[s]:
                continue
            weight = centre(n, xs, ys, ws, a, b)
            free_cost = rigid(n, xs, ys, ws, R, t, C)
            copy(unknown, G)
            if has_prior:
                times(Rs[p], middle[s], R0)
                information(R0, give[s], Ps[p], T, H)
                inverse(H, G)
                square = 0.0
                copy(zero, cross)
                for i in range(n):
                    for k in range(3):
                        square += ws[i] * (xs[i, k] * xs[i, k] + ys[i, k] * ys[i, k])
                        for m in range(3):
                            cross[k, m] += ws[i] * xs[i, k] * ys[i, m]
                cost = math.inf
                copy(R, start)
                for _ in range(2):
                    new_cost = fit_rotation(C, cross, square, R0, G, start)
                    if new_cost < cost:
                        cost = new_cost
                        copy(start, R)
                    times_transposed(R, R0, T)
                    if T[0, 0] + T[1, 1] + T[2, 2] >= 2.0:
                        break
                    copy(R0, start)  # a turn of more than a radian: there may be a nearer minimum
                if count > 0:
                    total += min(0.5 * (cost - free_cost), most)
            copy(R, Rs[s])
            variance[s] = 1 / weight
            for k in range(3):
                ts[s, k] = b[k] - R[k, 0] * a[0] - R[k, 1] * a[1] - R[k, 2] * a[2]
            information(R, C, G, T, H)
            inverse(H, Ps[s])
        out[h] = total


@jit
def centre(n, x, y, w, a, b):
    """Subtract from points x[:n] and y[:n] (n, 3) their means, by weights w (n,), written to a and b (3,): Σ w."""
    total = 0.0
    a[:], b[:] = 0.0, 0.0
    for i in range(n):
        total += w[i]
        for k in range(3):
            a[k] += w[i] * x[i, k]
            b[k] += w[i] * y[i, k]
    for k in range(3):
        a[k] /= total
        b[k] /= total
        for i in range(n):
            x[i, k] -= a[k]
            y[i, k] -= b[k]
    return total
