"""Compiled rows of space where the body cannot be: seen through by a depth sensor, or occupied by other parts.

Compiled rows of the body's surface samples against a depth image.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import HEIGHT, ROT, TRANS, WIDTH, project_jacobian
from kinefit.geometry._kernels_frames import moved, turned


@jit
def depth_image_rows(
    frames, owner, rest, normal, camera, depth, rays, shown, ratio, skin, reach, facing, weight,
    data, segment, group, start,
):  # fmt: skip
    """One row for each visible sample, along its normal; returns the next free line.

    owner (N,), rest and normal (3, N) in the root frame at rest; camera packed; depth (H, W) [m], 0 for none; rays
    (2, H, W): x/z and y/z of every pixel in the camera; shown (h, w) [m]: the body's rendered depth at `ratio` of the
    size, inf for none; skin [m]: how far a visible sample may lie behind it; reach [m]: correspondence distance;
    facing: smallest cosine between normal and line of sight; weight [1/m²].
    """
    r00, r01, r02 = camera[ROT], camera[ROT + 1], camera[ROT + 2]
    r10, r11, r12 = camera[ROT + 3], camera[ROT + 4], camera[ROT + 5]
    r20, r21, r22 = camera[ROT + 6], camera[ROT + 7], camera[ROT + 8]
    t0, t1, t2 = camera[TRANS], camera[TRANS + 1], camera[TRANS + 2]
    cx, cy, cz = -(r00 * t0 + r10 * t1 + r20 * t2), -(r01 * t0 + r11 * t1 + r21 * t2), -(r02 * t0 + r12 * t1 + r22 * t2)
    width, height = camera[WIDTH], camera[HEIGHT]
    rows, columns = shown.shape
    i = start
    for k in range(owner.size):
        f = frames[owner[k]]
        nx, ny, nz = turned(f, normal[0, k], normal[1, k], normal[2, k])
        x, y, z = moved(f, rest[0, k], rest[1, k], rest[2, k])
        sx, sy, sz = cx - x, cy - y, cz - z
        along = nx * sx + ny * sy + nz * sz
        if along <= facing * math.sqrt(sx * sx + sy * sy + sz * sz):
            continue
        found = project_jacobian(camera, x, y, z)
        if not found[0]:
            continue
        u, v = found[1], found[2]
        if not (-0.5 < u < width - 0.5 and -0.5 < v < height - 0.5):
            continue
        zc = r20 * x + r21 * y + r22 * z + t2
        row, column = int(v * ratio + 0.5), int(u * ratio + 0.5)
        row = rows - 1 if row >= rows else row
        column = columns - 1 if column >= columns else column
        if shown[row, column] < zc - skin:
            continue
        iu, iv = int(u + 0.5), int(v + 0.5)
        m = depth[iv, iu]
        if m <= 0.0 or m < zc - reach or m > zc + reach:
            continue
        mx, my = m * rays[0, iv, iu] - t0, m * rays[1, iv, iu] - t1
        mz = m - t2
        qx = r00 * mx + r10 * my + r20 * mz
        qy = r01 * mx + r11 * my + r21 * mz
        qz = r02 * mx + r12 * my + r22 * mz
        data[0, i], data[1, i], data[2, i] = qx, qy, qz  # at q, so that to first order n rotates with it
        data[3, i], data[4, i], data[5, i] = nx, ny, nz
        data[6, i] = nx * (qx - x) + ny * (qy - y) + nz * (qz - z)
        data[7, i] = weight
        segment[i], group[i] = owner[k], k
        i += 1
    return i


CONTOUR_TOLERANCE = 3  # [cells] between contours of the body and of the depth image


@jit
def nearest_cells(depth, farthest, cell, shown, tolerance, nearest):
    """Nearest possible cell of the body, for every cell of `cell` x `cell` pixels.

    A cell is possible if at least half of its pixels (of every second row and column) measured a depth up to `farthest`
    [m], which gives an unbiased edge. shown (h', w') [m]: the body's rendered depth at any size, inf for none; cells
    that it explains within `tolerance` [m], and their neighbours, are excluded; (0, 0) for none. nearest (h, w) int32:
    row * w + column, -1 for none at all. Exact: nearest in each column, then the lower envelope of parabolas along each
    row (Felzenszwalb & Huttenlocher 2012).
    """
    h, w = nearest.shape
    rows, columns = depth.shape
    step = 2 if cell > 1 else 1
    compared = shown.size > 0
    taken = np.zeros((h, w), np.bool_)
    for i in range(h):
        last = (i + 1) * cell if (i + 1) * cell < rows else rows
        for j in range(w):
            end = (j + 1) * cell if (j + 1) * cell < columns else columns
            own = shown[i * shown.shape[0] // h, j * shown.shape[1] // w] if compared else math.inf
            balance, known = 0, 0
            for a in range(i * cell, last, step):
                for b in range(j * cell, end, step):
                    m = depth[a, b]
                    balance += 1 if 0.0 < m <= farthest else -1
                    known += 1 if abs(m - own) <= tolerance else 0
            nearest[i, j] = i if balance >= 0 else -1
            taken[i, j] = known > 0
    if compared:
        for i in range(h):
            for j in range(w):
                if taken[i, j]:
                    for a in range(i - 1 if i > 0 else 0, i + 2 if i + 2 < h else h):
                        for b in range(j - 1 if j > 0 else 0, j + 2 if j + 2 < w else w):
                            nearest[a, b] = -1
    for i in range(1, h):  # row of the nearest in the column: from above, then from below
        for j in range(w):
            nearest[i, j] = nearest[i, j] if nearest[i, j] >= 0 else nearest[i - 1, j]
    for i in range(h - 2, -1, -1):
        for j in range(w):
            own, below = nearest[i, j], nearest[i + 1, j]
            nearest[i, j] = below if below >= 0 and (own < 0 or abs(below - i) < i - own) else own
    apex, height, bound = np.empty(w, np.int64), np.empty(w), np.empty(w + 1)
    line = np.empty(w, np.int32)
    for i in range(h):
        top = -1
        for j in range(w):
            if nearest[i, j] < 0:
                continue
            gap = nearest[i, j] - i
            y = float(gap * gap + j * j)
            at = -math.inf
            while top >= 0:
                at = (y - height[top]) / (2.0 * (j - apex[top]))
                if at > bound[top]:
                    break
                top -= 1
                at = -math.inf
            top += 1
            apex[top], height[top], bound[top] = j, y, at
        if top < 0:
            continue
        bound[top + 1] = math.inf
        k = 0
        for j in range(w):
            while bound[k + 1] < j:
                k += 1
            line[j] = nearest[i, apex[k]] * w + apex[k]
        for j in range(w):
            nearest[i, j] = line[j]


@jit
def free_space_rows(
    frames, owner, rest, normal, camera, depth, nearest, missing, cell, tolerance, reach, weight, chosen,
    data, segment, group, start,
):  # fmt: skip
    """One row for each sample that faces the camera in seen-through space, towards the nearest possible cell.

    owner (N,), rest and normal (3, N) in the root frame at rest; camera packed; depth (H, W) [m], 0 for none; nearest
    and missing (h, w) from `nearest_cells`, of all cells and of those that the body does not explain yet: a sample more
    than `CONTOUR_TOLERANCE` cells away goes to the latter, if there are any within reach; tolerance, reach [m]; weight
    [1/px²]. Out: chosen (N,) the cell of every sample, -1 for none. Returns the next free line.
    """
    r00, r01, r02 = camera[ROT], camera[ROT + 1], camera[ROT + 2]
    r10, r11, r12 = camera[ROT + 3], camera[ROT + 4], camera[ROT + 5]
    r20, r21, r22 = camera[ROT + 6], camera[ROT + 7], camera[ROT + 8]
    t0, t1, t2 = camera[TRANS], camera[TRANS + 1], camera[TRANS + 2]
    cx, cy, cz = -(r00 * t0 + r10 * t1 + r20 * t2), -(r01 * t0 + r11 * t1 + r21 * t2), -(r02 * t0 + r12 * t1 + r22 * t2)
    width, height, columns = camera[WIDTH], camera[HEIGHT], nearest.shape[1]
    half = 0.5 * cell
    i = start
    for k in range(owner.size):
        chosen[k] = -1
        f = frames[owner[k]]
        x, y, z = moved(f, rest[0, k], rest[1, k], rest[2, k])
        nx, ny, nz = turned(f, normal[0, k], normal[1, k], normal[2, k])
        if nx * (cx - x) + ny * (cy - y) + nz * (cz - z) <= 0.0:
            continue
        found = project_jacobian(camera, x, y, z)
        if not found[0]:
            continue
        u, v = found[1], found[2]
        if not (-0.5 < u < width - 0.5 and -0.5 < v < height - 0.5):
            continue
        iu, iv = int(u + 0.5), int(v + 0.5)
        if not abs(depth[iv, iu]) > r20 * x + r21 * y + r22 * z + t2 + tolerance:
            continue
        gap, gx, gy, gz, g2, g, goal = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1
        for place in range(2):
            target = nearest[iv // cell, iu // cell] if place == 0 else missing[iv // cell, iu // cell]
            if target < 0 or (place == 1 and gap <= CONTOUR_TOLERANCE * cell):
                break
            du = (target % columns) * cell + half - 0.5 - u
            dv = (target // columns) * cell + half - 0.5 - v
            distance = math.sqrt(du * du + dv * dv)
            if distance <= half:
                break
            du, dv = du / distance, dv / distance
            tx, ty, tz = du * found[3] + dv * found[6], du * found[4] + dv * found[7], du * found[5] + dv * found[8]
            square = tx * tx + ty * ty + tz * tz
            t = 1.0 / math.sqrt(square)
            if place == 0 or (distance - half) * t <= reach:
                gap, gx, gy, gz, g2, g = distance - half, tx, ty, tz, square, t  # to the edge, not the middle
                goal = target
        if gap <= 0.0 or gap * g > reach:
            continue
        data[0, i], data[1, i], data[2, i] = x, y, z
        data[3, i], data[4, i], data[5, i] = gx * g, gy * g, gz * g
        data[6, i], data[7, i] = gap * g, weight * g2
        segment[i], group[i], chosen[k] = owner[k], k, goal
        i += 1
    return i


@jit
def closest_on_segments(p0, p1, p2, d0, d1, d2, q0, q1, q2, e0, e1, e2):
    """Closest points (s, t in 0..1) of the segments p + s d and q + t e (Ericson 2005, 5.1.9)."""
    r0, r1, r2 = p0 - q0, p1 - q1, p2 - q2
    a, e, f = d0 * d0 + d1 * d1 + d2 * d2, e0 * e0 + e1 * e1 + e2 * e2, e0 * r0 + e1 * r1 + e2 * r2
    c, b = d0 * r0 + d1 * r1 + d2 * r2, d0 * e0 + d1 * e1 + d2 * e2
    tiny = 1e-12  # [m²]: a point
    if a <= tiny and e <= tiny:
        return 0.0, 0.0
    if a <= tiny:
        t = f / e
        return 0.0, 0.0 if t < 0.0 else (1.0 if t > 1.0 else t)
    if e <= tiny:
        s = -c / a
        return 0.0 if s < 0.0 else (1.0 if s > 1.0 else s), 0.0
    square = a * e - b * b
    s = (b * f - c * e) / square if square > 1e-9 * a * e else 0.5
    s = 0.0 if s < 0.0 else (1.0 if s > 1.0 else s)
    t = (b * s + f) / e
    if t < 0.0:
        t, s = 0.0, -c / a
    elif t > 1.0:
        t, s = 1.0, (b - c) / a
    return 0.0 if s < 0.0 else (1.0 if s > 1.0 else s), t


@jit
def capsule_gaps(frames, owner, starts, ends, pairs, point_a, point_b, direction, distance):
    """Distance between the axes of pairs (P, 2) of capsules.

    owner (C,) segments; starts, ends (C, 3) in the root frame at rest.
    Out: closest points point_a, point_b (P, 3) in the world; direction (P, 3) unit from b to a; distance (P,) [m].
    """
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        f, g, a, b = frames[owner[i]], frames[owner[j]], starts[i], starts[j]
        p0, p1, p2 = moved(f, a[0], a[1], a[2])
        q0, q1, q2 = moved(g, b[0], b[1], b[2])
        d0, d1, d2 = turned(f, ends[i, 0] - a[0], ends[i, 1] - a[1], ends[i, 2] - a[2])
        e0, e1, e2 = turned(g, ends[j, 0] - b[0], ends[j, 1] - b[1], ends[j, 2] - b[2])
        s, t = closest_on_segments(p0, p1, p2, d0, d1, d2, q0, q1, q2, e0, e1, e2)
        p0, p1, p2 = p0 + s * d0, p1 + s * d1, p2 + s * d2
        q0, q1, q2 = q0 + t * e0, q1 + t * e1, q2 + t * e2
        n0, n1, n2 = p0 - q0, p1 - q1, p2 - q2
        length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        distance[k] = length
        if length < 1e-9:  # the axes intersect: use their common perpendicular
            n0, n1, n2 = d1 * e2 - d2 * e1, d2 * e0 - d0 * e2, d0 * e1 - d1 * e0
            length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            if length < 1e-12:
                n0, n1, n2, length = 1.0, 0.0, 0.0, 1.0
        point_a[k, 0], point_a[k, 1], point_a[k, 2] = p0, p1, p2
        point_b[k, 0], point_b[k, 1], point_b[k, 2] = q0, q1, q2
        direction[k, 0], direction[k, 1], direction[k, 2] = n0 / length, n1 / length, n2 / length
