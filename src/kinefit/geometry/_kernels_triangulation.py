"""Compiled triangulation: rays to a point, Gauss-Newton on pixels, consensus of cameras."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import ROT, TRANS, project_jacobian, ray

_NAN = math.nan


@jit
def _solve3(a00, a01, a02, a11, a12, a22, b0, b1, b2):
    """Solve a symmetric positive definite 3x3 system by LDL^T: (ok, x, y, z)."""
    tiny = 1e-9 * (a00 + a11 + a22)
    l10, l20 = a01 / a00, a02 / a00
    d1 = a11 - l10 * a01
    c12 = a12 - l10 * a02
    l21 = c12 / d1
    d2 = a22 - l20 * a02 - l21 * c12
    if not (a00 > tiny and d1 > tiny and d2 > tiny):
        return False, _NAN, _NAN, _NAN
    y1 = b1 - l10 * b0
    y2 = b2 - l20 * b0 - l21 * y1
    z = y2 / d2
    y = y1 / d1 - l21 * z
    return True, b0 / a00 - l10 * y - l20 * z, y, z


@jit
def _nearest_to_rays(centres, directions, weights):
    """Point of least weighted squared distance to rays: (ok, x, y, z); not ok if they are parallel."""
    a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = 0.0
    for c in range(weights.shape[0]):
        w = weights[c]
        if w > 0.0:
            dx, dy, dz = directions[c, 0], directions[c, 1], directions[c, 2]
            m00, m11, m22 = w * (1.0 - dx * dx), w * (1.0 - dy * dy), w * (1.0 - dz * dz)
            m01, m02, m12 = -w * dx * dy, -w * dx * dz, -w * dy * dz
            x, y, z = centres[c, 0], centres[c, 1], centres[c, 2]
            a00, a01, a02, a11, a12, a22 = a00 + m00, a01 + m01, a02 + m02, a11 + m11, a12 + m12, a22 + m22
            b0 += m00 * x + m01 * y + m02 * z
            b1 += m01 * x + m11 * y + m12 * z
            b2 += m02 * x + m12 * y + m22 * z
    return _solve3(a00, a01, a02, a11, a12, a22, b0, b1, b2)


@jit
def _normal_equations(cameras, uv, weights, x, y, z):
    """Weighted squared pixel error at a point, its normal matrix (6) and right side (3); infinite where invisible."""
    cost = a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = 0.0
    for c in range(weights.shape[0]):
        w = weights[c]
        if w > 0.0:
            ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[c], x, y, z)
            if not ok:
                return math.inf, a00, a01, a02, a11, a12, a22, b0, b1, b2
            eu, ev = uv[c, 0] - u, uv[c, 1] - v
            cost += w * (eu * eu + ev * ev)
            a00, a01, a02 = a00 + w * (ux * ux + vx * vx), a01 + w * (ux * uy + vx * vy), a02 + w * (ux * uz + vx * vz)
            a11, a12, a22 = a11 + w * (uy * uy + vy * vy), a12 + w * (uy * uz + vy * vz), a22 + w * (uz * uz + vz * vz)
            b0, b1, b2 = b0 + w * (ux * eu + vx * ev), b1 + w * (uy * eu + vy * ev), b2 + w * (uz * eu + vz * ev)
    return cost, a00, a01, a02, a11, a12, a22, b0, b1, b2


@jit
def _triangulate(cameras, centres, directions, uv, weights, steps):
    """Point of least weighted squared pixel error, by damped Gauss-Newton from the rays: (ok, x, y, z)."""
    ok, x, y, z = _nearest_to_rays(centres, directions, weights)
    if not ok:
        return False, _NAN, _NAN, _NAN
    cost, a00, a01, a02, a11, a12, a22, b0, b1, b2 = _normal_equations(cameras, uv, weights, x, y, z)
    if not cost < math.inf:
        return False, _NAN, _NAN, _NAN
    damping = 0.0
    for _ in range(steps):
        d = damping * (a00 + a11 + a22)
        ok, dx, dy, dz = _solve3(a00 + d, a01, a02, a11 + d, a12, a22 + d, b0, b1, b2)
        if not ok:
            damping = 1e-6 if damping == 0.0 else 10.0 * damping
            continue
        new_x, new_y, new_z = x + dx, y + dy, z + dz
        new, n00, n01, n02, n11, n12, n22, m0, m1, m2 = _normal_equations(cameras, uv, weights, new_x, new_y, new_z)
        if new <= cost:
            cost, a00, a01, a02, a11, a12, a22, b0, b1, b2 = new, n00, n01, n02, n11, n12, n22, m0, m1, m2
            x, y, z = new_x, new_y, new_z
            damping = damping * 0.1
        else:
            damping = 1e-6 if damping == 0.0 else 10.0 * damping
        if dx * dx + dy * dy + dz * dz <= 1e-14 * (1.0 + x * x + y * y + z * z):
            break
    return True, x, y, z


@jit
def _residuals(cameras, uv, weights, x, y, z, residual):
    """Pixel distance in every camera with weight; NaN in the others, infinite where the point is invisible."""
    for c in range(weights.shape[0]):
        residual[c] = _NAN
        if weights[c] > 0.0:
            result = project_jacobian(cameras[c], x, y, z)
            ok, eu, ev = result[0], uv[c, 0] - result[1], uv[c, 1] - result[2]
            residual[c] = math.sqrt(eu * eu + ev * ev) if ok else math.inf


@jit
def _centres(cameras, centres):
    """Optical centres in the world of packed cameras."""
    for c in range(cameras.shape[0]):
        for i in range(3):
            total = 0.0
            for j in range(3):
                total -= cameras[c, ROT + 3 * j + i] * cameras[c, TRANS + j]
            centres[c, i] = total


@jit
def _consensus(cameras, centres, directions, uv, usable, limit, chosen, residual):
    """Point of the consensus of cameras with the largest weight, within limit [px]: (ok, x, y, z), cameras in chosen.

    All cameras if they agree; else the pair whose point has most support, grown to all that agree with it.
    """
    count = usable.shape[0]
    ok, x, y, z = _triangulate(cameras, centres, directions, uv, usable, 20)
    if ok:
        _residuals(cameras, uv, usable, x, y, z, residual)
        agree = True
        for c in range(count):
            chosen[c] = usable[c]
            agree = agree and not residual[c] > limit
        if agree:
            return True, x, y, z
    if limit == math.inf:
        return False, _NAN, _NAN, _NAN
    best = best_x = best_y = best_z = 0.0
    for c in range(count):
        chosen[c] = 0.0
    for i in range(count):
        for j in range(i + 1, count):
            if usable[i] > 0.0 and usable[j] > 0.0:
                chosen[i], chosen[j] = usable[i], usable[j]
                ok, x, y, z = _triangulate(cameras, centres, directions, uv, chosen, 5)
                chosen[i] = chosen[j] = 0.0
                if ok:
                    _residuals(cameras, uv, usable, x, y, z, residual)
                    if residual[i] <= limit and residual[j] <= limit:
                        score = 0.0
                        for c in range(count):
                            if residual[c] <= limit:
                                score += usable[c] * (1.0 - 0.5 * (residual[c] / limit) ** 2)
                        if score > best:
                            best, best_x, best_y, best_z = score, x, y, z
    if best == 0.0:
        return False, _NAN, _NAN, _NAN
    x, y, z = best_x, best_y, best_z
    _residuals(cameras, uv, usable, x, y, z, residual)
    for _ in range(5):
        changed = False
        support = 0
        for c in range(count):
            weight = usable[c] if residual[c] <= limit else 0.0
            support += weight > 0.0
            changed = changed or weight != chosen[c]
            chosen[c] = weight
        if not changed:
            break
        if support < 2:
            return False, _NAN, _NAN, _NAN
        ok, x, y, z = _triangulate(cameras, centres, directions, uv, chosen, 20)
        if not ok:
            return False, _NAN, _NAN, _NAN
        _residuals(cameras, uv, usable, x, y, z, residual)
    support = 0
    for c in range(count):
        chosen[c] = chosen[c] if residual[c] <= limit else 0.0
        support += chosen[c] > 0.0
    return support >= 2, x, y, z


@jit
def triangulate_points(cameras, points, weights, limit, positions, inliers, residuals):
    """Triangulate points (N, C, 2) [px] with weights (N, C), 0 if not detected.

    limit : largest reprojection error of an inlier; infinite for plain least squares.
    Writes positions (N, 3) [m], inliers (N, C) bool and residuals (N, C) [px]; NaN where there is no point.
    """
    count = cameras.shape[0]
    centres, directions = np.empty((count, 3)), np.empty((count, 3))
    usable, chosen = np.empty(count), np.empty(count)
    _centres(cameras, centres)
    for n in range(points.shape[0]):
        seen = 0
        for c in range(count):
            ok = False
            if weights[n, c] > 0.0:
                ok, directions[c, 0], directions[c, 1], directions[c, 2] = ray(
                    cameras[c], points[n, c, 0], points[n, c, 1]
                )
            usable[c] = weights[n, c] if ok else 0.0
            seen += ok
            inliers[n, c], residuals[n, c] = False, _NAN
        ok, x, y, z = False, _NAN, _NAN, _NAN
        if seen >= 2:
            ok, x, y, z = _consensus(cameras, centres, directions, points[n], usable, limit, chosen, residuals[n])
        if ok:
            positions[n, 0], positions[n, 1], positions[n, 2] = x, y, z
            for c in range(count):
                inliers[n, c] = chosen[c] > 0.0
        else:
            for i in range(3):
                positions[n, i] = _NAN
            for c in range(count):
                residuals[n, c] = _NAN
