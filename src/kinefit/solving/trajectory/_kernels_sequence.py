"""Fit a whole sequence of frames in one call: points and planes on a body, Levenberg-Marquardt frame after frame."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies._kernels import forward, retract
from kinefit.solving._kernels import assemble
from kinefit.solving._kernels_linear import LEAST_DAMPING, adapt, damped_step
from kinefit.solving.correspondences._kernels import plane_rows, point_rows

_MAX_TRIES = 60  # of more damping, for a matrix that is not positive definite


@jit
def gather(order, x, n, weight, target, normal, weights):
    """Copy one frame's planes (P, 3) to (3, P) in another order; weight 0 and zeros for planes that are not finite."""
    for i in range(order.size):
        k = order[i]
        total = x[k, 0] + x[k, 1] + x[k, 2] + n[k, 0] + n[k, 1] + n[k, 2]
        known = abs(total) < math.inf
        for j in range(3):
            target[j, i] = x[k, j] if known else 0.0
            normal[j, i] = n[k, j] if known else 0.0
        weights[i] = weight if known else 0.0


@jit
def widen(C, depth, place, wide_depth, H):
    """Copy C into a wider pattern H, with C[k, t] at H[k, place[k, t]]."""
    for k in range(depth.size):
        for t in range(wide_depth[k] + 1):
            H[k, t] = 0.0
        for t in range(depth[k] + 1):
            H[k, place[k, t]] = C[k, t]


@jit
def add_posture(share, pair, precision, usual, angles, H, g):
    """Add a share of a Gaussian about `usual` (D,) to H and g; returns its cost.

    pair (E, 3): two angles, the second not after the first, and their entry in H's row of the first; precision (E,).
    """
    cost = 0.0
    for e in range(precision.size):
        i, j, p = pair[e, 0], pair[e, 1], share * precision[e]
        H[6 + i, pair[e, 2]] += p
        a, b = usual[i] - angles[i], usual[j] - angles[j]
        g[6 + i] += p * b
        cost += p * a * b
        if i != j:
            g[6 + j] += p * a
            cost += p * a * b
    return cost


@jit
def fit_sequence(
    parents, dof_start, chain, depth, prismatic, axes, rest_joints, lower, upper, locked,
    owner, rest, target, weight, plane_owner, plane_rest, plane_order, plane_x, plane_n, plane_w,
    usual, posture, prior_pairs, prior, wide, wide_depth, place, kind, scale, max_iterations, tolerance, damping_share,
    roots, angles, costs, iterations,
):  # fmt: skip
    """Fit all frames, each from the last one's solution; roots[0], angles[0] contain the start and are overwritten.

    owner (K,), rest (K, 3), target (F, K, 3) [m], weight (F, K) [1/m²]; planes sorted by segment: plane_owner (P,),
    plane_rest (3, P); not sorted, NaN for missing ones: plane_x, plane_n (F, P, 3); plane_order (P,) sorts them.
    usual (D,) is the mean of the posture prior with the share `posture`, see `add_posture`; with it the pattern of H
    is wide, wide_depth, see `widen`.
    roots (F, 4, 4), angles (F, D), costs (F,), iterations (F,) are filled. Damping starts at `damping_share` of the
    mean diagonal of H in the first frame, and continues from frame to frame. A frame ends when the predicted fall of
    the cost is below the share `tolerance` of it.
    """
    n_segments, n_angles = parents.size, axes.shape[0]
    n = n_angles + 6
    size = 3 * owner.size + plane_owner.size
    data, segment, group = np.empty((8, size)), np.empty(size, np.int64), np.empty(size, np.int64)
    factor, blocks = np.empty(size), np.empty((n_segments, 27))
    frames, screws = np.empty((n_segments, 12)), np.empty((n_angles, 6))
    H, g, other_H, other_g = np.empty(wide.shape), np.empty(n), np.empty(wide.shape), np.empty(n)
    C, L, delta = np.empty(chain.shape), np.empty(wide.shape), np.empty(n)
    planes = plane_owner.size
    target_lines, normal_lines, plane_weight = np.empty((3, planes)), np.empty((3, planes)), np.empty(planes)
    root, q = roots[0].copy(), angles[0].copy()
    new_root, new_q = np.empty((4, 4)), np.empty(n_angles)
    damping, growth = -1.0, 2.0
    for f in range(roots.shape[0]):
        delta[:] = 0.0
        retract(root, q, delta, lower, upper, root, q)
        cost, predicted, count, least = 0.0, 0.0, 0, 0.0
        used = 0
        gather(plane_order, plane_x[f], plane_n[f], plane_w, target_lines, normal_lines, plane_weight)
        for attempt in range(max_iterations + 1):
            first = attempt == 0
            trial_root, trial_q = (root, q) if first else (new_root, new_q)
            forward(parents, dof_start, prismatic, axes, rest_joints, trial_root, trial_q, frames, screws)
            count = point_rows(frames, owner, rest, target[f], weight[f], data, segment, group, 0)
            count = plane_rows(
                frames, plane_owner, plane_rest, target_lines, normal_lines, plane_weight, owner.size,
                data, segment, group, count,
            )  # fmt: skip
            new_cost = assemble(
                data, segment, group, count, kind, scale, trial_root[:3, 3], parents, dof_start, chain, depth, screws,
                factor, blocks, C, other_g,
            )  # fmt: skip
            widen(C, depth, place, wide_depth, other_H)
            if posture > 0.0:
                new_cost += add_posture(posture, prior_pairs, prior, usual, trial_q, other_H, other_g)
            if first:
                cost = new_cost
                H, other_H, g, other_g = other_H, H, other_g, g
                mean = 1e-300
                for i in range(n):
                    mean += H[i, wide_depth[i]] / n
                least, most = LEAST_DAMPING * mean, damping_share * mean
                if not 0.0 <= damping <= most:  # it is high after a frame with an exact fit
                    damping = most
                damping = max(damping, least)
                growth = 2.0
            else:
                damping, growth = adapt(damping, growth, cost - new_cost, predicted, least)
                if new_cost < cost:
                    cost = new_cost
                    H, other_H, g, other_g = other_H, H, other_g, g
                    root, new_root, q, new_q = new_root, root, new_q, q
            used = attempt
            if attempt == max_iterations:
                break
            predicted = damped_step(H, g, damping, wide, wide_depth, q, lower, upper, locked, L, delta)
            for _ in range(_MAX_TRIES):
                if predicted >= 0.0:
                    break
                damping = 10.0 * damping
                predicted = damped_step(H, g, damping, wide, wide_depth, q, lower, upper, locked, L, delta)
            retract(root, q, delta, lower, upper, new_root, new_q)
            if predicted <= tolerance * cost + 1e-30:
                break  # the quadratic model is accurate for such a small step, which is taken without evaluating it
        if predicted <= tolerance * cost + 1e-30 and predicted > 0.0:
            root, new_root, q, new_q = new_root, root, new_q, q
            cost -= predicted
        for i in range(4):
            for j in range(4):
                roots[f, i, j] = root[i, j]
        for i in range(n_angles):
            angles[f, i] = q[i]
        costs[f], iterations[f] = cost, used
