"""Fit a pose to pixels in one kernel: `least_squares.levenberg_marquardt` with rows of pixels and a prediction."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies._kernels import difference, forward, retract
from kinefit.solving._kernels import assemble
from kinefit.solving._kernels_linear import LEAST_DAMPING, adapt, damped_step
from kinefit.solving.correspondences._kernels import pixel_rows


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
