"""Compiled rows of nearest surface points, and of fixed correspondences."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian
from kinefit.geometry._kernels_frames import moved, turned


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
