"""Cost of the joint rotations of an explanation under their learnt distribution, from the root outwards: numba."""

import math

import numpy as np

from kinefit._jit import jit
from kinefit.correspondences._kernels_closures import rotation_vector
from kinefit.identification.frame._kernels_evidence import rigid

MAX_ITERATIONS = 8
_UNKNOWN_TURN_INFORMATION = 0.1  # [1/rad²] prior of an unknown turn


@jit
def fit_rotation(C, S, square, R0, G, R):
    """Minimise f = Σ w |y - R x|² + vᵀ G v, v = log(R R0ᵀ), over R (3, 3) in place by Gauss-Newton; returns f.

    Of points about their weighted centroids: C = Σ w (|x|² I - x xᵀ), S = Σ w x yᵀ (3, 3), square = Σ w (|x|² + |y|²).
    """
    v, f, length = np.empty(3), 0.0, 1.0
    for iteration in range(MAX_ITERATIONS + 1):
        M = R @ S
        rotation_vector(R @ R0.T, v)
        pull = G @ v
        f = square - 2.0 * np.trace(M) + v @ pull
        if length < 1e-3 or iteration == MAX_ITERATIONS:
            break
        g = np.array([M[1, 2] - M[2, 1], M[2, 0] - M[0, 2], M[0, 1] - M[1, 0]]) - pull
        v[:] = np.linalg.solve(R @ C @ R.T + G, g)
        length = math.sqrt(v @ v)
        angle = min(length, 1.0)
        K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]]) / max(length, 1e-300)
        R += math.sin(angle) * K @ R + (1.0 - math.cos(angle)) * K @ (K @ R)
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
    S, size = len(parent), np.max(np.diff(starts)) + 1
    xs, ys, ws = np.empty((size, 3)), np.empty((size, 3)), np.empty(size)
    Rs, ts, Ps = np.zeros((S, 3, 3)), np.zeros((S, 3)), np.zeros((S, 3, 3))
    placed, variance = np.zeros(S, np.bool_), np.zeros(S)
    R, C, t = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for h in range(len(labels)):
        total = 0.0
        for s in range(S):
            p, count = parent[s], 0
            for i in range(starts[s], starts[s + 1]):
                q = labels[h, markers[i]]
                if q >= 0:
                    xs[count], ys[count], ws[count] = x[i], points[q], 1 / sigma[i] ** 2
                    count += 1
            has_parent = p >= 0 and placed[p]
            has_prior = has_parent and give[s, 0, 0] >= 0
            n = count
            if has_parent:
                xs[n], ys[n] = here[s], ts[p] + Rs[p] @ there[s]
                lever = 2 / 3 * (there[s] @ there[s]) * min(np.trace(Ps[p]) / 3, 1.0)
                ws[n] = 1 / (spread[s] ** 2 + variance[p] + lever)
                n += 1
            placed[s] = n >= 3 or has_prior
            if not placed[s]:
                continue
            w, weight = ws[:n], ws[:n].sum()
            a, b = w @ xs[:n] / weight, w @ ys[:n] / weight
            xs[:n] -= a
            ys[:n] -= b
            free_cost, G = rigid(n, xs, ys, ws, R, t, C), _UNKNOWN_TURN_INFORMATION * np.eye(3)
            if has_prior:
                R0 = Rs[p] @ middle[s]
                G = np.linalg.inv(Ps[p] + R0 @ give[s] @ R0.T)
                cross, other = (w * xs[:n].T) @ ys[:n], R0.copy()
                square = (w @ (xs[:n] ** 2 + ys[:n] ** 2)).sum()
                cost = fit_rotation(C, cross, square, R0, G, R)
                if np.trace(R @ R0.T) < 2.0:  # a turn of more than a radian: there may be a nearer minimum
                    other_cost = fit_rotation(C, cross, square, R0, G, other)
                    if other_cost < cost:
                        cost, R[:] = other_cost, other
                if count > 0:
                    total += min(0.5 * (cost - free_cost), most)
            Rs[s], ts[s], variance[s] = R, b - R @ a, 1 / weight
            Ps[s] = np.linalg.inv(R @ C @ R.T + G)
        out[h] = total
