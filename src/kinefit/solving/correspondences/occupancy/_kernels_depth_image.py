"""Compiled rows of the body's surface samples against a depth image."""

from __future__ import annotations

import math

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
