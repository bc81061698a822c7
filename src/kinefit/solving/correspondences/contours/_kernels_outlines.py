"""Compiled contours: rim points of a mesh in a rendered image, and correspondences between two contours.

A contour consists of points (u, v) [px] with unit normals (a, b) that point away from the body.
"""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import CX, CY, DIST, FX, FY, MODEL, ROT, SKEW, TRANS, project_jacobian

OUTER, INNER = 0, 1
_SIDE_OFFSET_PX = 1.0  # from the rim to the pixels that are tested on both sides of it


@jit
def _pixel(v, size):
    """Nearest pixel, or -1 outside of the image."""
    i = math.floor(v + 0.5)
    return i if 0 <= i < size else -1


@jit
def seen(camera, vertices, x, uv):
    """Project vertices (V, 3) [m] of the world into a camera (packed): pixels uv (V, 2), and x (V, 3) [m].

    x has the same pixels and depths in a pinhole camera without distortion; vertices that do not project have z = 0.
    """
    c = camera
    bent = c[MODEL] != 0.0 or c[SKEW] != 0.0
    for k in range(8):
        bent = bent or c[DIST + k] != 0.0
    if not bent:
        for i in range(len(vertices)):
            a, b, d = vertices[i, 0], vertices[i, 1], vertices[i, 2]
            x[i, 0] = c[ROT] * a + c[ROT + 1] * b + c[ROT + 2] * d + c[TRANS]
            x[i, 1] = c[ROT + 3] * a + c[ROT + 4] * b + c[ROT + 5] * d + c[TRANS + 1]
            z = c[ROT + 6] * a + c[ROT + 7] * b + c[ROT + 8] * d + c[TRANS + 2]
            x[i, 2] = z
            inverse = 1.0 / (z if z > 1e-9 else 1e-9)
            uv[i, 0], uv[i, 1] = c[FX] * x[i, 0] * inverse + c[CX], c[FY] * x[i, 1] * inverse + c[CY]
        return
    for i in range(len(vertices)):
        a, b, d = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        z = c[ROT + 6] * a + c[ROT + 7] * b + c[ROT + 8] * d + c[TRANS + 2]
        ok, u, v, _, _, _, _, _, _ = project_jacobian(c, a, b, d)
        z = z if ok else 0.0
        u = u if ok else c[CX]
        v = v if ok else c[CY]
        uv[i, 0], uv[i, 1] = u, v
        x[i, 0], x[i, 1], x[i, 2] = (u - c[CX]) / c[FX] * z, (v - c[CY]) / c[FY] * z, z


@jit
def shift(a, b, together):
    """Common shift [px] of points (N, 2) from b to a, if `together`, and the largest remaining change [px]."""
    x, y, largest = 0.0, 0.0, 0.0
    if together:
        for i in range(len(a)):
            x += a[i, 0] - b[i, 0]
            y += a[i, 1] - b[i, 1]
        x, y = x / len(a), y / len(a)
    for i in range(len(a)):
        u, v = abs(a[i, 0] - b[i, 0] - x), abs(a[i, 1] - b[i, 1] - y)
        largest = u if u > largest else largest
        largest = v if v > largest else largest
    return x, y, largest


@jit
def bounds(uv):
    """Smallest and largest coordinates of points (N, 2): left, top, right, bottom."""
    left, top, right, bottom = uv[0, 0], uv[0, 1], uv[0, 0], uv[0, 1]
    for i in range(len(uv)):
        left, right = min(left, uv[i, 0]), max(right, uv[i, 0])
        top, bottom = min(top, uv[i, 1]), max(bottom, uv[i, 1])
    return left, top, right, bottom


@jit
def rims(x, uv, faces, label, edges, sides, depth, face, spacing, near, apart, inner, front, out, place, kind):
    """Write the rim points of a rendered mesh; returns their number.

    Rims are edges between a face towards the camera and one away from it, sampled `spacing` [px] apart. The images of
    depth and faces show whether a point is visible, and what is behind: nothing (OUTER), or the body, by more than
    `apart` [m] (INNER). Next to another body (face below -1) there are none.

    x (V, 3) [m] in the camera's frame, uv (V, 2) [px]: the vertices. faces (T, 3) with label (T,). edges (E, 2) with
    the faces on both sides (E, 2), -1 for none. depth, face (H, W): as rendered. near [m]: largest depth difference of
    the surface just inside of the rim. inner: whether to write INNER points. front (T,) int8: work space.
    out (4, N): u, v, a, b. place (N, 2): edge, and weight of its second vertex. kind (N,).
    """
    height, width = depth.shape
    nearest = math.inf
    for i in range(len(x)):
        nearest = x[i, 2] if x[i, 2] < nearest else nearest
    for t in range(len(faces)):
        i, j, k = faces[t, 0], faces[t, 1], faces[t, 2]
        u, v = uv[i, 0], uv[i, 1]
        area = (uv[j, 0] - u) * (uv[k, 1] - v) - (uv[k, 0] - u) * (uv[j, 1] - v)
        front[t] = 1 if area < 0.0 else 0
    if nearest <= 0.0:
        for t in range(len(faces)):
            if x[faces[t, 0], 2] <= 0.0 or x[faces[t, 1], 2] <= 0.0 or x[faces[t, 2], 2] <= 0.0:
                front[t] = -1
    n, carried, room = 0, 0.5, out.shape[1]
    for e in range(len(edges)):
        one, two = sides[e, 0], sides[e, 1]
        if two < 0:
            if front[one] != 1:
                continue
        elif front[one] < 0 or front[two] < 0 or front[one] == front[two]:
            continue
        own = one if front[one] == 1 else two
        i, j = edges[e, 0], edges[e, 1]
        du, dv = uv[j, 0] - uv[i, 0], uv[j, 1] - uv[i, 1]
        length = math.sqrt(du * du + dv * dv)
        if not (1e-9 < length < 1e6):
            continue
        a, b = -dv / length, du / length
        k = faces[own, 0] + faces[own, 1] + faces[own, 2] - i - j
        if a * (uv[k, 0] - uv[i, 0]) + b * (uv[k, 1] - uv[i, 1]) > 0.0:
            a, b = -a, -b
        carried += length / spacing
        count = math.floor(carried)
        carried -= count
        for s in range(count):
            if n >= room:
                return n
            t = (s + 0.5) / count
            u, v = uv[i, 0] + t * du, uv[i, 1] + t * dv
            p, q = _pixel(u - _SIDE_OFFSET_PX * a, width), _pixel(v - _SIDE_OFFSET_PX * b, height)
            r, w = _pixel(u + _SIDE_OFFSET_PX * a, width), _pixel(v + _SIDE_OFFSET_PX * b, height)
            if p < 0 or q < 0 or r < 0 or w < 0 or face[q, p] < 0:
                continue
            z = 1.0 / ((1.0 - t) / x[i, 2] + t / x[j, 2])
            inside, outside = depth[q, p], depth[w, r]
            allowed = 3.0 * near if label[face[q, p]] == label[own] else near
            if inside < z - allowed or inside > z + near or face[w, r] < -1:
                continue
            if face[w, r] >= 0 and (not inner or outside < z + apart):
                continue
            out[0, n], out[1, n], out[2, n], out[3, n] = u, v, a, b
            place[n, 0], place[n, 1] = e, t * z / x[j, 2]
            kind[n] = OUTER if face[w, r] < 0 else INNER
            n += 1
    return n


@jit
def match(model, image, reach, cosine, to_image, to_model):
    """For every point of each contour (4, N), (4, M), the nearest point of the other with a similar normal, else -1.

    reach [px]: largest distance; cosine: of the largest angle between normals. The distance is d² (2 - cos).
    """
    most = reach * reach
    best = to_model[1]
    for k in range(image.shape[1]):
        best[k], to_model[0, k] = math.inf, -1.0
    for i in range(model.shape[1]):
        u, v, a, b = model[0, i], model[1, i], model[2, i], model[3, i]
        least, chosen = math.inf, -1
        for k in range(image.shape[1]):
            du, dv = image[0, k] - u, image[1, k] - v
            square = du * du + dv * dv
            if square > most:
                continue
            c = a * image[2, k] + b * image[3, k]
            if c < cosine:
                continue
            square *= 2.0 - c
            if square < least:
                least, chosen = square, k
            if square < best[k]:
                best[k], to_model[0, k] = square, float(i)
        to_image[i] = chosen


@jit
def tangent_rows(camera, vertices, ends, share, owner, image, weight, data, segment, group):
    """One row for each pair: the pixel of a rim point should lie on the contour point's tangent. Returns their number.

    camera packed; vertices (V, 3) [m] in the world; of N rim points ends (N, 2), share (N,), owner (N,); image (4, N):
    the contour's point of each; weight [1/px²]; row buffers as in `_kernels`.
    """
    n = 0
    for i in range(len(share)):
        one, two, t = ends[i, 0], ends[i, 1], share[i]
        x = (1.0 - t) * vertices[one, 0] + t * vertices[two, 0]
        y = (1.0 - t) * vertices[one, 1] + t * vertices[two, 1]
        z = (1.0 - t) * vertices[one, 2] + t * vertices[two, 2]
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(camera, x, y, z)
        if not ok:
            continue
        a, b = image[2, i], image[3, i]
        gx, gy, gz = a * ux + b * vx, a * uy + b * vy, a * uz + b * vz
        square = gx * gx + gy * gy + gz * gz
        g = 1.0 / math.sqrt(square)
        data[0, n], data[1, n], data[2, n] = x, y, z
        data[3, n], data[4, n], data[5, n] = gx * g, gy * g, gz * g
        data[6, n] = (a * (image[0, i] - u) + b * (image[1, i] - v)) * g
        data[7, n] = weight * square
        segment[n], group[n] = owner[i], i
        n += 1
    return n
