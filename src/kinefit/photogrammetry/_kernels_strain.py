"""Compiled strain: planes fitted to positions and displacements over a gauge length, on a grid of points."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit

# Row of results: E_xx, E_yy, E_xy, their variances, F - 1 (2x2, in the tangent plane), rotation [rad], points,
# variances of the displacements about their planes along the three axes.
COLUMNS = 15


@jit
def strains(x, d, columns, reach, overlap, filled, out):
    """Green-Lagrange strain of points (N, 3) displaced by d (N, 3), on a grid of `columns` per row.

    Positions and displacements within `reach` rows and columns are each fitted by a plane over the indices i, j; the
    change of the metric is the strain, in the tangent frame whose first axis runs along the row. Points with NaN are
    excluded.
    overlap : factor of the slopes' variance for windows of neighbours that share pixels.
    filled : least share of the (2 reach + 1)² points that must be present; else out (N, 15) is NaN.
    """
    count, height = x.shape[0], x.shape[0] // columns
    sums, right, a, b, c, e = np.empty(6), np.empty((6, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    second, one, two, scatter = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    for k in range(count):
        for i in range(COLUMNS):
            out[k, i] = math.nan
        if not abs(x[k, 0]) + abs(d[k, 0]) < math.inf:
            continue
        row, column = k // columns, k % columns
        sums[:] = 0.0
        right[:] = 0.0
        scatter[:] = 0.0
        for j in range(max(0, row - reach), min(height, row + reach + 1)):
            for i in range(max(0, column - reach), min(columns, column + reach + 1)):
                n = j * columns + i
                if not abs(x[n, 0]) + abs(d[n, 0]) < math.inf:
                    continue
                s, t = float(i - column), float(j - row)
                sums[0], sums[1], sums[2] = sums[0] + 1.0, sums[1] + s, sums[2] + t
                sums[3], sums[4], sums[5] = sums[3] + s * s, sums[4] + s * t, sums[5] + t * t
                for axis in range(3):
                    p, q = x[n, axis] - x[k, axis], d[n, axis] - d[k, axis]
                    right[0, axis] += p
                    right[1, axis] += s * p
                    right[2, axis] += t * p
                    right[3, axis] += q
                    right[4, axis] += s * q
                    right[5, axis] += t * q
                    for other in range(3):
                        scatter[axis, other] += q * (d[n, other] - d[k, other])
        total = sums[0]
        if total < filled * (2 * reach + 1) ** 2 or total < 6.0:
            continue
        ss, st, tt = (
            sums[3] - sums[1] * sums[1] / total,
            sums[4] - sums[1] * sums[2] / total,
            sums[5] - sums[2] * sums[2] / total,
        )
        det = ss * tt - st * st
        if not det > 1e-6 * ss * tt:
            continue
        for axis in range(3):
            p = right[1, axis] - sums[1] * right[0, axis] / total
            q = right[2, axis] - sums[2] * right[0, axis] / total
            a[axis], b[axis] = (tt * p - st * q) / det, (ss * q - st * p) / det
            p = right[4, axis] - sums[1] * right[3, axis] / total
            q = right[5, axis] - sums[2] * right[3, axis] / total
            c[axis], e[axis] = (tt * p - st * q) / det, (ss * q - st * p) / det
            for other in range(3):  # what the planes explain: by the mean, by c and by e
                mean = right[3, other] / total
                scatter[axis, other] -= right[3, axis] * mean
                p, q = right[4, other] - sums[1] * mean, right[5, other] - sums[2] * mean
                scatter[other, axis] -= c[axis] * p + e[axis] * q
        aa = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
        ab = (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / aa
        for axis in range(3):
            second[axis] = b[axis] - ab * a[axis] / aa
        bb = math.sqrt(second[0] ** 2 + second[1] ** 2 + second[2] ** 2)
        if not (aa > 0.0 and bb > 1e-6 * aa):
            continue
        # derivatives along the tangent axes: d/d1 = (d/di) / aa, d/d2 = (d/dj - ab / aa d/di) / bb
        g11 = g22 = g12 = 0.0
        f11 = f12 = f21 = f22 = 0.0
        for axis in range(3):
            one[axis], two[axis] = a[axis] / aa, second[axis] / bb
            p = c[axis] / aa
            q = (e[axis] - ab * p) / bb
            f11, f12 = f11 + one[axis] * p, f12 + one[axis] * q
            f21, f22 = f21 + two[axis] * p, f22 + two[axis] * q
            one[axis], two[axis] = one[axis] + p, two[axis] + q
            g11 += one[axis] * one[axis]
            g22 += two[axis] * two[axis]
            g12 += one[axis] * two[axis]
        out[k, 0], out[k, 1], out[k, 2] = 0.5 * (g11 - 1.0), 0.5 * (g22 - 1.0), 0.5 * g12
        s11 = s22 = s12 = 0.0  # how the displacements scatter along the moved axes, squared
        for axis in range(3):
            for other in range(3):
                s11 += one[axis] * scatter[axis, other] * one[other]
                s22 += two[axis] * scatter[axis, other] * two[other]
                s12 += one[axis] * scatter[axis, other] * two[other]
        noise = overlap / (total - 3.0)
        v11 = noise * tt / det / (aa * aa)
        cross = noise * -st / det
        v22 = (noise * ss / det - 2.0 * ab / aa * cross + ab * ab * v11) / (bb * bb)
        v12 = (cross / aa - ab * v11) / bb
        out[k, 3], out[k, 4] = max(s11, 0.0) * v11, max(s22, 0.0) * v22
        out[k, 5] = max(0.25 * (s22 * v11 + s11 * v22 + 2.0 * s12 * v12), 0.0)
        out[k, 6], out[k, 7], out[k, 8], out[k, 9] = f11, f12, f21, f22
        out[k, 10] = math.atan2(f21 - f12, 2.0 + f11 + f22)
        out[k, 11] = total
        for axis in range(3):
            out[k, 12 + axis] = max(scatter[axis, axis], 0.0) / (total - 3.0)
