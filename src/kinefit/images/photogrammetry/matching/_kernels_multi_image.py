"""Compiled multi-image matching: one window jointly in several images along its line of sight.

The geometrically constrained form of Gruen and Baltsavias (1988), with one unknown place for all images: the distance
along the template's ray. Each image contributes its own shift and its normal matrix, reduced by the affine map and the
grey values. The distance follows from all images, then maps and grey values at that distance.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian
from kinefit.images.photogrammetry.matching import _kernels_matching as lsm

# Row of results: distance [m], its variance, correlation, parallax [px], images, iterations, status.
DISTANCE, VARIANCE, SIMILARITY, PARALLAX, IMAGES, STEPS, STATE = 0, 1, 2, 3, 4, 5, 6
COLUMNS = 7


@jit
def conditional(m, y, b, gain, du, dv):
    """Solve for unknowns 0..5 given the last two (scaled by the gain), from the forward-substituted right side y."""
    b[6], b[7] = gain * du, gain * dv
    for i in range(5, -1, -1):
        s = y[i]
        for k in range(i + 1, lsm.SIZE):
            s -= m[k, i] * b[k]
        b[i] = s / m[i, i]


@jit
def match_rays(
    first, images, sizes, cameras, at, origin, rays, starts, halves, steps, tolerance, share, own, out, each
):  # fmt: skip
    """Match windows at points (N, 2) [px] of a template in K images (K, H, W) of `sizes` (K, 2) and packed cameras.

    rays : (N, 3) unit directions of the points; origin (3,) [m] of the rays.
    starts : (N, 1 + 4 K) distance [m], and the 2x2 map into each image; an image with NaN is excluded.
    Fills out (N, 7) and, for each image, each (N, K, 15).
    """
    count = images.shape[0]
    f, fx, fy, rows, m, b, _ = lsm.room(halves)
    y, moves, squares = np.empty((count, lsm.SIZE)), np.empty((count, 6)), np.empty(count)
    used = np.empty(count, np.bool_)
    for k in range(at.shape[0]):
        _match_ray(
            first, images, sizes, cameras, at[k], origin, rays[k], starts[k], halves[k], steps, tolerance, share, own,
            f, fx, fy, rows, m, b, y, moves, squares, used, out[k], each[k],
        )  # fmt: skip


@jit
def _match_ray(
    first, images, sizes, cameras, at, origin, ray, start, half, steps, tolerance, share, own,
    f, fx, fy, rows, m, b, y, moves, squares, used, out, each,
):  # fmt: skip
    n, count = (2 * half + 1) ** 2, images.shape[0]
    for c in range(COLUMNS):
        out[c] = math.nan
    for i in range(count):
        for c in range(lsm.ROW):
            each[i, c] = math.nan
    mean = lsm.template(first, at[0], at[1], half, f, fx, fy, rows)
    if not (abs(mean) < math.inf and abs(start[0]) < math.inf):
        out[STATE] = lsm.OUTSIDE_IMAGE
        return
    lsm.normal_matrix(f, fx, fy, half, mean, m)
    f_f = m[5, 5]
    if not lsm.factor(m, lsm.SIZE):
        out[STATE] = lsm.FLAT
        return
    s00, s01, s11 = m[6, 6] ** 2, m[7, 6] * m[6, 6], m[7, 6] ** 2 + m[7, 7] ** 2
    distance, status, taken = start[0], lsm.DIVERGED, 0
    for i in range(count):
        used[i] = True
        each[i, lsm.GAIN] = 1.0
        for c in range(4):
            each[i, lsm.A + c] = start[1 + 4 * i + c]
            used[i] = used[i] and abs(start[1 + 4 * i + c]) < math.inf
        squares[i] = 1.0
    parallax = correlation = 0.0
    for step in range(steps):
        x, yy, z = origin[0] + distance * ray[0], origin[1] + distance * ray[1], origin[2] + distance * ray[2]
        above = below = correlation = 0.0
        taken = 0
        for i in range(count):
            if not used[i]:
                continue
            ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[i], x, yy, z)
            a11, a12, a21, a22 = each[i, lsm.A], each[i, lsm.A + 1], each[i, lsm.A + 2], each[i, lsm.A + 3]
            c = images[i, : sizes[i, 0], : sizes[i, 1]]
            if not ok or not lsm.fits(c, u, v, a11, a12, a21, a22, half):
                used[i] = False
                continue
            _, hh = lsm.right_side(c, f, fx, fy, half, mean, u, v, a11, a12, a21, a22, b)
            variance = hh - b[4] * b[4] / n
            each[i, lsm.CORRELATION] = b[5] / math.sqrt(f_f * variance) if variance > 0.0 else 0.0
            squares[i] = hh
            for r in range(lsm.SIZE):  # forward substitution
                s = b[r]
                for q in range(r):
                    s -= m[r, q] * y[i, q]
                y[i, r] = s / m[r, r]
                squares[i] -= y[i, r] * y[i, r]
            b[7] = y[i, 7] / m[7, 7]
            b[6] = (y[i, 6] - m[7, 6] * b[7]) / m[6, 6]
            free_u, free_v = b[6], b[7]
            conditional(m, y[i], b, 1.0, free_u, free_v)
            gain = b[5]
            if not gain > 0.05:
                used[i] = False
                continue
            each[i, lsm.GAIN], each[i, lsm.U], each[i, lsm.V] = gain, u, v
            pu, pv = ux * ray[0] + uy * ray[1] + uz * ray[2], vx * ray[0] + vy * ray[1] + vz * ray[2]
            det = a11 * a22 - a12 * a21
            qu, qv = (a22 * pu - a12 * pv) / det, (a11 * pv - a21 * pu) / det
            du, dv = free_u / gain, free_v / gain
            weight = gain * gain * (n - lsm.SIZE) / (squares[i] if squares[i] > 1e-9 * hh else 1e-9 * hh + 1e-30)
            above -= weight * (qu * (s00 * du + s01 * dv) + qv * (s01 * du + s11 * dv))
            below += weight * (s00 * qu * qu + 2.0 * s01 * qu * qv + s11 * qv * qv)
            moves[i, 0], moves[i, 1], moves[i, 2], moves[i, 3], moves[i, 4], moves[i, 5] = qu, qv, du, dv, pu, pv
            correlation += each[i, lsm.CORRELATION]
            taken += 1
        if taken == 0 or not below > 0.0:
            status = lsm.OUTSIDE_IMAGE
            break
        change = above / below
        distance += change
        moved, parallax = 0.0, 0.0
        for i in range(count):
            if not used[i]:
                continue
            gain = each[i, lsm.GAIN]
            du, dv = -moves[i, 0] * change, -moves[i, 1] * change
            off_u, off_v = moves[i, 2] - du, moves[i, 3] - dv
            squares[i] += gain * gain * (s00 * off_u * off_u + 2.0 * s01 * off_u * off_v + s11 * off_v * off_v)
            conditional(m, y[i], b, gain, du, dv)
            a11, a12, a21, a22 = each[i, lsm.A], each[i, lsm.A + 1], each[i, lsm.A + 2], each[i, lsm.A + 3]
            ou, ov = a11 * off_u + a12 * off_v, a21 * off_u + a22 * off_v
            parallax += ou * ou + ov * ov
            ok, n11, n12, n21, n22 = lsm.composed(a11, a12, a21, a22, b, 1.0 / (gain * half))
            if not ok:
                used[i] = False
                continue
            each[i, lsm.A], each[i, lsm.A + 1], each[i, lsm.A + 2], each[i, lsm.A + 3] = n11, n12, n21, n22
            turned = half * (abs(n11 - a11) + abs(n12 - a12) + abs(n21 - a21) + abs(n22 - a22))
            step2 = change * change * (moves[i, 4] ** 2 + moves[i, 5] ** 2) + turned * turned
            moved = step2 if step2 > moved else moved
        parallax = math.sqrt(parallax / taken)
        out[STEPS] = step + 1.0
        if moved <= tolerance * tolerance:
            status = lsm.FOUND
            break
    out[DISTANCE], out[STATE], out[PARALLAX], out[IMAGES] = distance, status, parallax, taken
    out[SIMILARITY] = correlation / taken if taken else math.nan
    if status != lsm.FOUND:
        return
    total = 0.0
    for i in range(count):
        each[i, lsm.STATUS] = lsm.FOUND if used[i] else lsm.OUTSIDE_IMAGE
        if used[i]:
            lsm.covariance(m, at[0], at[1], half, each[i, lsm.GAIN], squares[i], share, own, each[i])
            if each[i, lsm.STATUS] == lsm.FOUND:
                total += _information(each[i], moves[i, 4], moves[i, 5])
    if not total > 0.0:
        out[STATE] = lsm.FLAT
        return
    variance = mu = mv = 0.0  # the template's noise shifts all images' windows equally, so it may cancel
    for i in range(count):
        if used[i] and each[i, lsm.STATUS] == lsm.FOUND:
            information, qu, qv = _information(each[i], moves[i, 4], moves[i, 5]), moves[i, 0], moves[i, 1]
            variance += (1.0 - share) * information / (total * total)
            root = math.sqrt(information / (s00 * qu * qu + 2.0 * s01 * qu * qv + s11 * qv * qv))  # 1 / sigma
            mu, mv = mu + root * qu, mv + root * qv
    out[VARIANCE] = variance + share * (s00 * mu * mu + 2.0 * s01 * mu * mv + s11 * mv * mv) / (total * total)


@jit
def _information(row, pu, pv):
    """Information of an image about the distance: p' C^-1 p for its shift p per distance and covariance C."""
    a, b, d = row[lsm.VAR_U], row[lsm.COV], row[lsm.VAR_V]
    return (pu * pu * d - 2.0 * pu * pv * b + pv * pv * a) / (a * d - b * b)
