"""Every frame's normal equations at once, and the motion prior that couples each frame to the next three.

A block of the prior between two frames has entries only within one joint: line i of it, (n, 3), holds the columns
first[i] .. first[i] + width[i] - 1.

Fit a whole sequence of frames in one call: points and planes on a body, Levenberg-Marquardt frame after frame.

Errors that a detector's points of one segment share in one view: a common shift, estimated with the pose.

With residuals r_i [px] of a group's points, weights w_i and a shift b of variance U, the cost is
Σ ρ(w_i |r_i − b|²) + |b|²/U. At its minimum over b the gradient by the pose is that of r_i − b, and the normal matrix
Σ d_i a_i a_iᵀ − U/(1 + U Σ d_i) (Σ d_i a_i)(Σ d_i a_i)ᵀ with d_i = w_i times the robust factor: correlated points
count as few.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies._kernels import difference, forward, retract
from kinefit.geometry._kernels_camera import project_jacobian
from kinefit.geometry.losses._kernels import robust, weigh
from kinefit.solving._kernels import accumulate, assemble, project
from kinefit.solving._kernels_linear import LEAST_DAMPING, adapt, damped_step
from kinefit.solving.correspondences._kernels import pixel_rows, place, plane_rows, point_rows

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
