"""Compiled row makers: they fill the row buffers from line `start` on and return the next free line.

Common parameters: frames (S, 12) from forward kinematics; owner (K,) segments and rest (K, 3) points in the root frame
at rest; buffers data (8, N) = x, n, r, w; segment (N,); group (N,).

Compiled rows of nearest surface points, and of fixed correspondences.

Compiled values of closures, and their derivatives by the degrees of freedom.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian
from kinefit.geometry._kernels_frames import moved, turned


@jit
def place(frames, owner, rest, k):
    """Position (x, y, z) [m] of point k in the world."""
    return moved(frames[owner[k]], rest[k, 0], rest[k, 1], rest[k, 2])


@jit
def _put(data, segment, group, i, s, g, x, y, z, nx, ny, nz, r, w):
    data[0, i], data[1, i], data[2, i] = x, y, z
    data[3, i], data[4, i], data[5, i] = nx, ny, nz
    data[6, i], data[7, i] = r, w
    segment[i], group[i] = s, g


@jit
def point_rows(frames, owner, rest, target, weight, data, segment, group, start):
    """Three rows for each point, along the world's axes: target (K, 3) [m], weight (K,) [1/m²], 0 for none."""
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        s = owner[k]
        _put(data, segment, group, i, s, k, x, y, z, 1.0, 0.0, 0.0, target[k, 0] - x, w)
        _put(data, segment, group, i + 1, s, k, x, y, z, 0.0, 1.0, 0.0, target[k, 1] - y, w)
        _put(data, segment, group, i + 2, s, k, x, y, z, 0.0, 0.0, 1.0, target[k, 2] - z, w)
        i += 3
    return i


@jit
def plane_rows(frames, owner, rest, target, normal, weight, first_group, data, segment, group, start):
    """One row for each point, along the normal of the plane through target; weight (K,) [1/m²].

    For thousands of points: rest, target and normal are (3, K), points are sorted by segment, and a point without
    weight gets a row without effect.
    """
    k = 0
    while k < owner.size:
        s, first = owner[k], k
        while k < owner.size and owner[k] == s:
            k += 1
        f = frames[s]
        f0, f1, f2, f3, f4, f5, f6, f7, f8 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
        t0, t1, t2 = f[9], f[10], f[11]
        i, n = start + first, k - first
        rx, ry, rz = (
            rest[0, first:k],
            rest[1, first:k],
            rest[2, first:k],
        )  # slices, so that the compiler vectorises the loop
        tx, ty, tz = target[0, first:k], target[1, first:k], target[2, first:k]
        nx, ny, nz, w = normal[0, first:k], normal[1, first:k], normal[2, first:k], weight[first:k]
        px, py, pz = data[0, i : i + n], data[1, i : i + n], data[2, i : i + n]
        ox, oy, oz, r, v = (
            data[3, i : i + n],
            data[4, i : i + n],
            data[5, i : i + n],
            data[6, i : i + n],
            data[7, i : i + n],
        )
        for j in range(n):
            x = f0 * rx[j] + f1 * ry[j] + f2 * rz[j] + t0
            y = f3 * rx[j] + f4 * ry[j] + f5 * rz[j] + t1
            z = f6 * rx[j] + f7 * ry[j] + f8 * rz[j] + t2
            px[j], py[j], pz[j] = x, y, z
            r[j] = nx[j] * (tx[j] - x) + ny[j] * (ty[j] - y) + nz[j] * (tz[j] - z)
        for j in range(n):
            ox[j], oy[j], oz[j], v[j] = nx[j], ny[j], nz[j], w[j]
        for j in range(n):
            segment[i + j], group[i + j] = s, first_group + first + j
    return start + owner.size


@jit
def pixel_rows(frames, owner, rest, cameras, camera, target, weight, data, segment, group, start):
    """Two rows for each pixel: the exact linearisation of reprojection with distortion.

    cameras (C, P) packed, camera (K,) index, target (K, 2) [px], weight (K,) [1/px²]. With g = ∂u/∂x: n = g/|g|,
    r = Δu/|g|, w = weight |g|². A point that does not project into its camera makes no row.
    """
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[camera[k]], x, y, z)
        if not ok:
            continue
        s = owner[k]
        g2 = ux * ux + uy * uy + uz * uz
        g = 1.0 / math.sqrt(g2)
        _put(data, segment, group, i, s, k, x, y, z, ux * g, uy * g, uz * g, (target[k, 0] - u) * g, w * g2)
        g2 = vx * vx + vy * vy + vz * vz
        g = 1.0 / math.sqrt(g2)
        _put(data, segment, group, i + 1, s, k, x, y, z, vx * g, vy * g, vz * g, (target[k, 1] - v) * g, w * g2)
        i += 2
    return i


@jit
def image_line_rows(frames, owner, rest, cameras, camera, line, weight, data, segment, group, start):
    """One row for each point, from its pixel to the image line a u + b v + c = 0 (K, 3); weight (K,) [1/px²]."""
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(cameras[camera[k]], x, y, z)
        if not ok:
            continue
        a, b, c = line[k, 0], line[k, 1], line[k, 2]
        scale = 1.0 / math.sqrt(a * a + b * b)
        a, b, c = a * scale, b * scale, c * scale
        gx, gy, gz = a * ux + b * vx, a * uy + b * vy, a * uz + b * vz
        g2 = gx * gx + gy * gy + gz * gz
        g = 1.0 / math.sqrt(g2)
        r = -(a * u + b * v + c) * g
        _put(data, segment, group, i, owner[k], k, x, y, z, gx * g, gy * g, gz * g, r, w * g2)
        i += 1
    return i


@jit
def ray_rows(frames, owner, rest, line, weight, data, segment, group, start):
    """Two rows for each point: its offset from the Plücker line (K, 6) along two directions normal to it."""
    i = start
    for k in range(owner.size):
        w = weight[k]
        if w <= 0.0:
            continue
        x, y, z = place(frames, owner, rest, k)
        n0, n1, n2 = line[k, 0], line[k, 1], line[k, 2]
        fx, fy, fz = (
            n1 * line[k, 5] - n2 * line[k, 4],
            n2 * line[k, 3] - n0 * line[k, 5],
            n0 * line[k, 4] - n1 * line[k, 3],
        )
        # a branch-free frame about n (Duff et al. 2017)
        sign = math.copysign(1.0, n2)
        p = -1.0 / (sign + n2)
        q = n0 * n1 * p
        ax, ay, az = 1.0 + sign * n0 * n0 * p, sign * q, -sign * n0
        bx, by, bz = q, sign + n1 * n1 * p, -n1
        ra = ax * (fx - x) + ay * (fy - y) + az * (fz - z)
        rb = bx * (fx - x) + by * (fy - y) + bz * (fz - z)
        _put(data, segment, group, i, owner[k], k, x, y, z, ax, ay, az, ra, w)
        _put(data, segment, group, i + 1, owner[k], k, x, y, z, bx, by, bz, rb, w)
        i += 2
    return i


@jit
def buffers(count):
    """Empty row buffers of N = count lines: data (8, N), segment (N,), group (N,)."""
    return np.empty((8, count)), np.empty(count, np.int64), np.empty(count, np.int64)


@jit
def surface_rows(x, distance, normal, owner, weight, eye, least, data, segment, group):
    """One row for each point with a nearest surface; returns their number.

    x, normal (3, N); distance, owner, weight (N,); eye (3,): rows need normal·(eye - p) above `least`. Out: data (8, N)
    = p, n, r, w; segment (N,); group (N,).
    """
    ex, ey, ez = eye[0], eye[1], eye[2]
    i = 0
    for k in range(owner.size):
        if owner[k] < 0 or weight[k] <= 0.0:
            continue
        d, nx, ny, nz = distance[k], normal[0, k], normal[1, k], normal[2, k]
        px, py, pz = x[0, k] - d * nx, x[1, k] - d * ny, x[2, k] - d * nz
        if nx * (ex - px) + ny * (ey - py) + nz * (ez - pz) <= least:
            continue
        data[0, i], data[1, i], data[2, i] = px, py, pz
        data[3, i], data[4, i], data[5, i] = nx, ny, nz
        data[6, i], data[7, i] = d, weight[k]
        segment[i], group[i] = owner[k], k
        i += 1
    return i


@jit
def anchors(data, segment, group, frames, measured, x, rest, normal):
    """Surface point and normal of each row (8, N) of `surface_rows`, in the root frame at rest.

    measured (M, 3) [m]; frames (S, 12). Out: x (N, 3), the row's measured point; rest, normal (N, 3).
    """
    for k in range(segment.size):
        f, i = frames[segment[k]], group[k]
        nx, ny, nz = data[3, k], data[4, k], data[5, k]
        x[k, 0], x[k, 1], x[k, 2] = measured[i, 0], measured[i, 1], measured[i, 2]
        back = data[6, k] / (nx * nx + ny * ny + nz * nz)
        px, py, pz = x[k, 0] - back * nx - f[9], x[k, 1] - back * ny - f[10], x[k, 2] - back * nz - f[11]
        for j in range(3):
            rest[k, j] = f[j] * px + f[3 + j] * py + f[6 + j] * pz
            normal[k, j] = f[j] * nx + f[3 + j] * ny + f[6 + j] * nz


@jit
def anchored_rows(frames, owner, rest, normal, target, weight, at_surface, data):
    """One row for each surface point: the measured point lies r further along the surface's normal.

    frames (S, 12); owner (N,), rest and normal (N, 3) in the root frame at rest; target (N, 3) [m] in the world, weight
    (N,) [1/m²]; at_surface: whether a row's point is the target's projection on the tangent plane, or the target; the
    derivative is the same. Out: data (8, N).
    """
    for k in range(owner.size):
        f = frames[owner[k]]
        nx, ny, nz = turned(f, normal[k, 0], normal[k, 1], normal[k, 2])
        x, y, z = moved(f, rest[k, 0], rest[k, 1], rest[k, 2])
        qx, qy, qz = target[k, 0], target[k, 1], target[k, 2]
        r = nx * (qx - x) + ny * (qy - y) + nz * (qz - z)
        back = r if at_surface else 0.0
        data[0, k], data[1, k], data[2, k] = qx - back * nx, qy - back * ny, qz - back * nz
        data[3, k], data[4, k], data[5, k] = nx, ny, nz
        data[6, k], data[7, k] = r, weight[k]


@jit
def target_rows(frames, owner, rest, camera, target, slack, weight, data):
    """One row for each point: its pixel should lie within `slack` [px] of target (N, 2) [px].

    frames (S, 12); owner (N,), rest (N, 3) in the root frame at rest; camera packed; weight [1/px²]. Points within
    `slack`, or outside of the camera's view, get weight 0. Out: data (8, N).
    """
    for k in range(owner.size):
        f = frames[owner[k]]
        x, y, z = moved(f, rest[k, 0], rest[k, 1], rest[k, 2])
        data[0, k], data[1, k], data[2, k] = x, y, z
        data[3, k], data[4, k], data[5, k], data[6, k], data[7, k] = 0.0, 0.0, 1.0, 0.0, 0.0
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(camera, x, y, z)
        if not ok:
            continue
        du, dv = target[k, 0] - u, target[k, 1] - v
        distance = math.sqrt(du * du + dv * dv)
        if distance <= slack or distance < 1e-9:
            continue
        du, dv = du / distance, dv / distance
        gx, gy, gz = du * ux + dv * vx, du * uy + dv * vy, du * uz + dv * vz
        square = gx * gx + gy * gy + gz * gz
        g = 1.0 / math.sqrt(square)
        data[3, k], data[4, k], data[5, k] = gx * g, gy * g, gz * g
        data[6, k], data[7, k] = (distance - slack) * g, weight * square


@jit
def rotation_vector(R, e):
    """Write the rotation vector of R (3, 3), of length 0..π, to e (3,) [rad], by the largest quaternion component."""
    q, trace = np.empty(4), R[0, 0] + R[1, 1] + R[2, 2]
    best, k = trace, 3
    for i in range(3):
        if R[i, i] > best:
            best, k = R[i, i], i
    if k == 3:
        q[3] = 1.0 + trace
        q[0], q[1], q[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q[k] = 1.0 + 2.0 * R[k, k] - trace
        q[i], q[j], q[3] = R[i, k] + R[k, i], R[j, k] + R[k, j], R[j, i] - R[i, j]
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    sign = -1.0 if q[3] < 0.0 else 1.0
    angle = 2.0 * math.atan2(length, sign * q[3])
    scale = sign * angle / length if length > 1e-300 else 0.0
    for i in range(3):
        e[i] = scale * q[i]


@jit
def turn_rows(e, M, out):
    """Write J_l⁻¹(e) Mᵀ to out (3, 3), for a rotation vector e (3,) and a frame M (3, 3); Barfoot, eq. 7.77."""
    t2 = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    if t2 < 1e-6:
        d = 1.0 / 12.0 + t2 / 720.0
    else:
        half = 0.5 * math.sqrt(t2)
        d = (1.0 - half * math.cos(half) / math.sin(half)) / t2
    for c in range(3):
        a, b, g = M[c, 0], M[c, 1], M[c, 2]
        x, y, z = e[1] * g - e[2] * b, e[2] * a - e[0] * g, e[0] * b - e[1] * a
        out[0, c] = a - 0.5 * x + d * (e[1] * z - e[2] * y)
        out[1, c] = b - 0.5 * y + d * (e[2] * x - e[0] * z)
        out[2, c] = g - 0.5 * z + d * (e[0] * y - e[1] * x)


@jit
def close(
    frames, screws, centre, segments, rest, directions, first, rigid, turns, dof_parent, last_dof, value, J,
):  # fmt: skip
    """Write the values (m,) of K closures, and their Jacobian J (m, n) unless it is empty.

    frames (S, 12), screws (D, 6): of a pose about centre (3,). segments (K, 2): -1 for the world. rest (K, 2, 3) [m]:
    points in the root frame at rest, or in the world. directions (m, 3): in the other frame. first (K + 1,): first
    equation of each closure. rigid (K,) bool: the last three equations of these are rotations relative to frames turns
    (K, 3, 3) in the other frame.
    """
    R, x = np.empty((2, 3, 3)), np.empty((2, 3))
    M, relative, e, rows, a = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(6)
    for k in range(segments.shape[0]):
        for side in range(2):
            s = segments[k, side]
            for i in range(3):
                x[side, i] = frames[s, 9 + i] if s >= 0 else 0.0
                for j in range(3):
                    R[side, i, j] = frames[s, 3 * i + j] if s >= 0 else (1.0 if i == j else 0.0)
                    x[side, i] += R[side, i, j] * rest[k, side, j]
        shifts = first[k + 1] - 3 if rigid[k] else first[k + 1]
        if rigid[k]:
            for i in range(3):
                for j in range(3):
                    M[i, j] = R[1, i, 0] * turns[k, 0, j] + R[1, i, 1] * turns[k, 1, j] + R[1, i, 2] * turns[k, 2, j]
            for i in range(3):
                for j in range(3):
                    relative[i, j] = M[0, i] * R[0, 0, j] + M[1, i] * R[0, 1, j] + M[2, i] * R[0, 2, j]
            rotation_vector(relative, e)
            turn_rows(e, M, rows)
        for q in range(first[k], first[k + 1]):
            if q < shifts:
                value[q] = 0.0
                for i in range(3):
                    a[i] = (
                        R[1, i, 0] * directions[q, 0] + R[1, i, 1] * directions[q, 1] + R[1, i, 2] * directions[q, 2]
                    )
                    value[q] += a[i] * (x[0, i] - x[1, i])
                u, v, w = x[0, 0] - centre[0], x[0, 1] - centre[1], x[0, 2] - centre[2]
                a[3], a[4], a[5] = v * a[2] - w * a[1], w * a[0] - u * a[2], u * a[1] - v * a[0]
            else:
                value[q] = e[q - shifts]
                for i in range(3):
                    a[i], a[3 + i] = 0.0, rows[q - shifts, i]
            if J.shape[0] == 0:
                continue
            for side in range(2):
                s, sign = segments[k, side], 1.0 - 2.0 * side
                if s < 0:
                    continue
                for i in range(6):
                    J[q, i] += sign * a[i]
                d = last_dof[s]
                while d >= 6:
                    total = 0.0
                    for i in range(6):
                        total += a[i] * screws[d - 6, i]
                    J[q, d] += sign * total
                    d = dof_parent[d]
