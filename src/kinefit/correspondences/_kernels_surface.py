"""Nearest points of surfaces as rows."""

from __future__ import annotations

from kinefit._jit import jit


@jit
def surface_rows(x, distance, normal, owner, weight, eye, least, data, segment, group):
    """One row for each point that has a surface; returns how many.

    x, normal (3, N); distance, owner, weight (N,); eye (3,): rows whose normal·(eye - p) is not above `least` are left
    out. Out: data (8, N) = p, n, r, w; segment (N,); group (N,).
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
