"""Compiled passes over depth images: flying pixels, points, normals. Arrays in, arrays out."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit


@jit
def drop_flying(depth, near, far, noise, slope, out):
    """Copy (H, W) `depth` [m] to `out`, with 0 outside of [near, far] and at flying pixels.

    A pixel flies if both of two opposite neighbours differ from it by more than max(noise, slope * depth) [m]. A
    missing neighbour counts as different.
    """
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            out[v, u] = z if z >= near and z <= far else 0.0
    if slope <= 0.0:
        return
    for v in range(height):
        above, below = v - 1 if v > 0 else v, v + 1 if v + 1 < height else v
        for u in range(width):
            z = out[v, u]
            if z > 0.0:
                t = slope * z
                t = t if t > noise else noise
                a, b = depth[v, u - 1 if u > 0 else u], depth[v, u + 1 if u + 1 < width else u]
                c, d = depth[above, u], depth[below, u]
                across = abs(a - z) > t and abs(b - z) > t
                along = abs(c - z) > t and abs(d - z) > t
                out[v, u] = 0.0 if across or along else z


@jit
def around(depth, out, v, u, noise, slope, min_fill, neighbours):
    """Mean depth [m] of a pixel's valid neighbours if at least `min_fill` of them lie on one surface; else 0.

    Neighbours that `drop_speckles` has set to 0 are not valid. neighbours (8,): work space for the valid ones.
    """
    height, width = depth.shape
    n = 0
    for i in range(v - 1 if v > 0 else v, v + 2 if v + 1 < height else v + 1):
        for j in range(u - 1 if u > 0 else u, u + 2 if u + 1 < width else u + 1):
            if out[i, j] > 0.0 and out[i, j] == depth[i, j]:
                neighbours[n] = out[i, j]
                n += 1
    if n >= min_fill:
        for k in range(n - min_fill + 1):
            total, alike = np.float32(0.0), 0
            for m in range(n):
                if abs(neighbours[m] - neighbours[k]) <= noise + slope * neighbours[k]:
                    total += neighbours[m]
                    alike += 1
            if alike >= min_fill:
                return total / np.float32(alike)
    return np.float32(0.0)


@jit
def drop_speckles(depth, noise, slope, min_neighbours, min_fill, out):
    """Copy (H, W) float32 `depth` [m] to `out` without isolated pixels; returns how many were measured and kept.

    A pixel is isolated if it shares a surface with fewer than `min_neighbours` of its eight neighbours: they differ by
    at most noise + slope * depth [m]. It becomes 0, or the mean of its valid neighbours if at least `min_fill` of them
    lie on one surface. The image needs two columns. Rows are processed without branches, so that the compiler
    vectorises them.
    """
    height, width = depth.shape
    none, one, empty = np.int32(0), np.int32(1), np.float32(0.0)
    noise, slope, min_neighbours = np.float32(noise), np.float32(slope), np.int32(min_neighbours)
    empty_row = np.zeros(width, np.float32)
    measured_count = kept = 0
    for v in range(height):
        above, below = depth[v - 1] if v > 0 else empty_row, depth[v + 1] if v + 1 < height else empty_row
        own, line = depth[v], out[v]
        for u in range(width - 2):
            z = own[u + 1]
            t = noise + slope * z
            n = one if abs(own[u] - z) <= t else none
            n += one if abs(own[u + 2] - z) <= t else none
            n += one if abs(above[u] - z) <= t else none
            n += one if abs(above[u + 1] - z) <= t else none
            n += one if abs(above[u + 2] - z) <= t else none
            n += one if abs(below[u] - z) <= t else none
            n += one if abs(below[u + 1] - z) <= t else none
            n += one if abs(below[u + 2] - z) <= t else none
            line[u + 1] = z if n >= min_neighbours else empty
        for u in (0, width - 1):
            z, inner = own[u], 1 if u == 0 else u - 1
            t = noise + slope * z
            n = none
            for row in (above, own, below):
                n += one if abs(row[inner] - z) <= t else none
                n += one if abs(row[u] - z) <= t else none
            line[u] = z if n > min_neighbours else empty  # it has counted itself
        before = after = none
        for u in range(width):
            before += one if own[u] > empty else none
            after += one if line[u] > empty else none
        measured_count, kept = measured_count + int(before), kept + int(after)
    if measured_count > kept and min_fill <= 8:
        neighbours = np.empty(8, np.float32)
        for v in range(height):
            for u in range(width):
                if depth[v, u] > empty and out[v, u] == empty:
                    out[v, u] = around(depth, out, v, u, noise, slope, min_fill, neighbours)
    return measured_count, kept


@jit
def points(depth, table, R, t, step, near, far, out):
    """Write the world points [m] of every step-th pixel in [near, far] to `out` (N, 3); returns their number.

    table (2, H, W): x/z and y/z of every pixel's ray, NaN where it has none. R (3, 3), t (3,) [m]: camera to world.
    """
    height, width = depth.shape
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, tx, ty, tz = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    n = 0
    for v in range(step // 2, height, step):
        for u in range(step // 2, width, step):
            z = depth[v, u]
            if z > 0.0 and z >= near and z <= far:
                a, b = table[0, v, u], table[1, v, u]
                if abs(a) < math.inf and abs(b) < math.inf:
                    x, y = a * z, b * z
                    out[n, 0] = r00 * x + r01 * y + r02 * z + tx
                    out[n, 1] = r10 * x + r11 * y + r12 * z + ty
                    out[n, 2] = r20 * x + r21 * y + r22 * z + tz
                    n += 1
    return n


@jit
def normals(depth, table, R, step, reach, noise, slope, out):
    """Write unit normals in the world to `out` (N, 3), for the pixels of `points` without range gate; 0 at edges.

    A normal is the cross product of the chords between the neighbours `reach` [px] away. It points to the sensor.
    """
    height, width = depth.shape
    n = 0
    for v in range(step // 2, height, step):
        for u in range(step // 2, width, step):
            z = depth[v, u]
            if not (z > 0.0 and abs(table[0, v, u]) < math.inf and abs(table[1, v, u]) < math.inf):
                continue
            out[n, 0] = out[n, 1] = out[n, 2] = 0.0
            if u >= reach and v >= reach and u + reach < width and v + reach < height:
                zl, zr, za, zb = depth[v, u - reach], depth[v, u + reach], depth[v - reach, u], depth[v + reach, u]
                t = slope * z * reach
                t = t if t > noise else noise
                if abs(zl - z) <= t and abs(zr - z) <= t and abs(za - z) <= t and abs(zb - z) <= t:
                    ax = table[0, v, u + reach] * zr - table[0, v, u - reach] * zl
                    ay = table[1, v, u + reach] * zr - table[1, v, u - reach] * zl
                    az = float(zr) - zl
                    bx = table[0, v + reach, u] * zb - table[0, v - reach, u] * za
                    by = table[1, v + reach, u] * zb - table[1, v - reach, u] * za
                    bz = float(zb) - za
                    nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
                    length = math.sqrt(nx * nx + ny * ny + nz * nz)
                    if length > 0.0 and length < math.inf:
                        nx, ny, nz = nx / length, ny / length, nz / length
                        for i in range(3):
                            out[n, i] = R[i, 0] * nx + R[i, 1] * ny + R[i, 2] * nz
            n += 1
    return n
