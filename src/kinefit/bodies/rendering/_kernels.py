"""Compiled z-buffer: triangles in a camera's frame -> depth and face of every pixel. Arrays in, arrays out.

A pixel (column i, row j) is its centre (u, v) = (i, j). A triangle covers the rows v_top <= j < v_bottom and in each
the pixels between the crossings of its edges, left included, right not. A crossing is computed from the upper end of
its edge alone, so two triangles that share an edge leave no gap and no pixel to both.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit

OK, NOT_FINITE, NO_VERTEX = 0, 1, 2
_MIN_DOUBLE_AREA = 1e-12  # [px²] twice the area of a triangle; smaller ones are below the precision of float64


@jit
def _clamped(v, size):
    """First row or column at or beyond v, within 0..size."""
    v = v if v > 0.0 else 0.0
    return math.ceil(v if v < size else size)


@jit
def _may_cover(u0, v0, u1, v1, u2, v2, width, height, cull):
    """Whether a triangle may cover a pixel: it faces the camera, is not degenerate, and overlaps a pixel's centre."""
    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if not (abs(area) > _MIN_DOUBLE_AREA and abs(area) < math.inf) or (cull and area > 0.0):
        return False
    low, high = v0 if v0 < v1 else v1, v0 if v0 > v1 else v1
    if _clamped(low if low < v2 else v2, height) == _clamped(high if high > v2 else v2, height):
        return False
    low, high = u0 if u0 < u1 else u1, u0 if u0 > u1 else u1
    return _clamped(low if low < u2 else u2, width) < _clamped(high if high > u2 else u2, width)


@jit
def _triangle(depth, face, name, u0, v0, w0, u1, v1, w1, u2, v2, w2):
    """Render one triangle with pixels (u, v) and inverse depths w [1/m]."""
    if v1 < v0:  # corners from the top down
        u0, v0, w0, u1, v1, w1 = u1, v1, w1, u0, v0, w0
    if v2 < v1:
        u1, v1, w1, u2, v2, w2 = u2, v2, w2, u1, v1, w1
        if v1 < v0:
            u0, v0, w0, u1, v1, w1 = u1, v1, w1, u0, v0, w0
    height = depth.shape[0]
    first, middle, last = _clamped(v0, height), _clamped(v1, height), _clamped(v2, height)
    inverse = 1.0 / ((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
    a = ((w1 - w0) * (v2 - v0) - (w2 - w0) * (v1 - v0)) * inverse
    b = ((w2 - w0) * (u1 - u0) - (w1 - w0) * (u2 - u0)) * inverse
    c = w0 - a * u0 - b * v0
    low, high = w0 if w0 < w1 else w1, w0 if w0 > w1 else w1  # bounds against rounding in slivers
    low, high = low if low < w2 else w2, high if high > w2 else w2
    width = depth.shape[1]
    slope, upper, lower = (u2 - u0) / (v2 - v0), (u1 - u0) / (v1 - v0), (u2 - u1) / (v2 - v1)
    for j in range(first, last):
        left = u0 + (j - v0) * slope
        right = u0 + (j - v0) * upper if j < middle else u1 + (j - v1) * lower
        swap = left > right
        row = b * j + c
        for i in range(_clamped(right if swap else left, width), _clamped(left if swap else right, width)):
            w = a * i + row  # 1/z is linear in the image
            w = low if w < low else w
            z = np.float32(1.0 / (w if w < high else high))
            if z < depth[j, i]:
                depth[j, i] = z
                face[j, i] = name


@jit
def _clipped(depth, face, name, x, y, z, corners, fx, fy, cx, cy, near, cull):
    """Render the part of a triangle with z >= near: a triangle or a quadrilateral."""
    u, v, w = np.empty(4), np.empty(4), np.empty(4)
    count = 0
    for k in range(3):
        p, q = corners[k], corners[(k + 1) % 3]
        if z[p] >= near:
            u[count], v[count], w[count] = fx * x[p] / z[p] + cx, fy * y[p] / z[p] + cy, 1.0 / z[p]
            count += 1
        if (z[p] >= near) != (z[q] >= near):
            r, s = (p, q) if z[p] < z[q] else (q, p)  # from the nearer end, the same for both triangles
            t = (near - z[r]) / (z[s] - z[r])
            u[count] = fx * (x[r] + t * (x[s] - x[r])) / near + cx
            v[count] = fy * (y[r] + t * (y[s] - y[r])) / near + cy
            w[count] = 1.0 / near
            count += 1
    height, width = depth.shape
    for k in range(2, count):
        if _may_cover(u[0], v[0], u[k - 1], v[k - 1], u[k], v[k], width, height, cull):
            _triangle(depth, face, name, u[0], v[0], w[0], u[k - 1], v[k - 1], w[k - 1], u[k], v[k], w[k])


@jit
def rasterise(vertices, T, faces, fx, fy, cx, cy, near, cull, room, depth, face):
    """Write depth and face of every pixel; returns OK, NOT_FINITE or NO_VERTEX (the image is then invalid).

    vertices (V, 3) [m]; T (4, 4) takes them to the camera's frame (z forward, y down); faces (T, 3); room (6, V or
    more): work space; depth (H, W) float32 [m] and face (H, W) int32: overwritten, inf and -1 for the background.
    cull: whether to skip triangles seen from behind (clockwise in the image).
    """
    x, y, z, u, v, w = room[0], room[1], room[2], room[3], room[4], room[5]
    count, size = len(vertices), 0.0
    for i in range(count):
        a, b, c = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        x[i] = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y[i] = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z[i] = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        size += abs(x[i]) + abs(y[i]) + abs(z[i])
        inverse = 1.0 / (z[i] if z[i] >= near else near)
        u[i] = fx * x[i] * inverse + cx
        v[i] = fy * y[i] * inverse + cy
        w[i] = inverse if z[i] >= near else -1.0
    depth[:] = math.inf
    face[:] = -1
    if not size < math.inf:
        return NOT_FINITE
    height, width = depth.shape
    for t in range(len(faces)):
        i, j, k = faces[t, 0], faces[t, 1], faces[t, 2]
        if i < 0 or j < 0 or k < 0 or i >= count or j >= count or k >= count:
            return NO_VERTEX
        if w[i] > 0.0 and w[j] > 0.0 and w[k] > 0.0:
            if _may_cover(u[i], v[i], u[j], v[j], u[k], v[k], width, height, cull):
                _triangle(depth, face, t, u[i], v[i], w[i], u[j], v[j], w[j], u[k], v[k], w[k])
        elif w[i] > 0.0 or w[j] > 0.0 or w[k] > 0.0:
            _clipped(depth, face, t, x, y, z, faces[t], fx, fy, cx, cy, near, cull)
    return OK
