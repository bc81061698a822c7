"""Compiled signed distance grids of closed triangle meshes: construction, and search for the nearest surface."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit


@jit
def closest_on_triangle(px, py, pz, a, b, c):
    """Closest point of triangle abc to p and the feature that it lies on (Ericson 2004, 5.1.5).

    Returns x, y, z, feature: 0 the face, 1 to 3 corner a, b, c, 4 to 6 edge ab, bc, ca.
    """
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = px - a[0], py - a[1], pz - a[2]
    d1, d2 = ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
    if d1 <= 0.0 and d2 <= 0.0:
        return a[0], a[1], a[2], 1
    x, y, z = px - b[0], py - b[1], pz - b[2]
    d3, d4 = ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
    if d3 >= 0.0 and d4 <= d3:
        return b[0], b[1], b[2], 2
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return a[0] + t * ux, a[1] + t * uy, a[2] + t * uz, 4
    x, y, z = px - c[0], py - c[1], pz - c[2]
    d5, d6 = ux * x + uy * y + uz * z, vx * x + vy * y + vz * z
    if d6 >= 0.0 and d5 <= d6:
        return c[0], c[1], c[2], 3
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return a[0] + t * vx, a[1] + t * vy, a[2] + t * vz, 6
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return b[0] + t * (c[0] - b[0]), b[1] + t * (c[1] - b[1]), b[2] + t * (c[2] - b[2]), 5
    s = 1.0 / (va + vb + vc)
    v, w = vb * s, vc * s
    return a[0] + v * ux + w * vx, a[1] + v * uy + w * vy, a[2] + v * uz + w * vz, 0


@jit
def seed(corners, origin, cell, reach, squared, owner):
    """Exact squared distances [m²] in boxes around all triangles, enlarged by `reach` [m], and the nearest triangle.

    corners (T, 3, 3), squared (X, Y, Z) to start from inf, owner (X, Y, Z) to start from -1.
    """
    size = owner.shape
    low, high = [0, 0, 0], [0, 0, 0]
    for t in range(corners.shape[0]):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        for k in range(3):
            least = min(a[k], b[k], c[k]) - reach - origin[k]
            most = max(a[k], b[k], c[k]) + reach - origin[k]
            low[k] = max(0, math.ceil(least / cell))
            high[k] = min(size[k] - 1, math.floor(most / cell))
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    improve(corners, t, origin, cell, i, j, k, squared, owner)


@jit
def improve(corners, t, origin, cell, i, j, k, squared, owner):
    """Make triangle t the owner of a node if it is nearer than the present owner."""
    px, py, pz = origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell
    x, y, z, _ = closest_on_triangle(px, py, pz, corners[t, 0], corners[t, 1], corners[t, 2])
    d2 = (px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2
    if d2 < squared[i, j, k]:
        squared[i, j, k] = d2
        owner[i, j, k] = t


@jit
def sweep(corners, origin, cell, squared, owner):
    """Propagate the nearest triangles from node to node in eight sweeps (Zhao 2005; Tsai 2002 for exact distances)."""
    nx, ny, nz = owner.shape
    for direction in range(8):
        sx = 1 if direction & 1 == 0 else -1
        sy = 1 if direction & 2 == 0 else -1
        sz = 1 if direction & 4 == 0 else -1
        for ii in range(nx):
            i = ii if sx > 0 else nx - 1 - ii
            for jj in range(ny):
                j = jj if sy > 0 else ny - 1 - jj
                for kk in range(nz):
                    k = kk if sz > 0 else nz - 1 - kk
                    t = owner[i - sx, j, k] if ii > 0 else -1
                    if t >= 0 and t != owner[i, j, k]:
                        improve(corners, t, origin, cell, i, j, k, squared, owner)
                    u = owner[i, j - sy, k] if jj > 0 else -1
                    if u >= 0 and u != t and u != owner[i, j, k]:
                        improve(corners, u, origin, cell, i, j, k, squared, owner)
                    v = owner[i, j, k - sz] if kk > 0 else -1
                    if v >= 0 and v != t and v != u and v != owner[i, j, k]:
                        improve(corners, v, origin, cell, i, j, k, squared, owner)


@jit
def walk(corners, across, origin, cell, squared, owner):
    """Refine each node's owner by walking to neighbouring triangles as long as they are nearer.

    Sweeps alone have errors of up to a cell along the surface where triangles are smaller than cells.
    across (T, 3): the triangles across edges ab, bc, ca.
    """
    nx, ny, nz = owner.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                t = -1
                while t != owner[i, j, k]:
                    t = owner[i, j, k]
                    for e in range(3):
                        improve(corners, across[t, e], origin, cell, i, j, k, squared, owner)


@jit
def finish(corners, features, origin, cell, owner, values):
    """Write signed distance and gradient of every node to `values`, where smaller than the present (union of parts).

    features (T, 7, 3): normal of the face, angle-weighted normals of its corners and edges, whose side of p is the
    sign of the distance (Baerentzen & Aanaes 2005). values (X, Y, Z, 4): distance and gradient, to start from inf.
    """
    nx, ny, nz = owner.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                t = owner[i, j, k]
                px, py, pz = origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell
                x, y, z, f = closest_on_triangle(px, py, pz, corners[t, 0], corners[t, 1], corners[t, 2])
                n = features[t, f]
                dx, dy, dz = px - x, py - y, pz - z
                d = math.sqrt(dx * dx + dy * dy + dz * dz)
                side = dx * n[0] + dy * n[1] + dz * n[2]
                d = -d if side < 0.0 else d
                if not d < values[i, j, k, 0]:
                    continue
                values[i, j, k, 0] = d
                on_surface = abs(d) < 1e-6 * cell
                values[i, j, k, 1] = n[0] if on_surface else dx / d
                values[i, j, k, 2] = n[1] if on_surface else dy / d
                values[i, j, k, 3] = n[2] if on_surface else dz / d


@jit
def nearest_faces(corners, x, face, squared):
    """Nearest triangle of corners (T, 3, 3) for points (N, 3): face (N,) int64 and squared distances (N,) [m²]."""
    count = corners.shape[0]
    middle, radius = np.empty((count, 3)), np.empty(count)
    for t in range(count):
        largest = 0.0
        for k in range(3):
            middle[t, k] = (corners[t, 0, k] + corners[t, 1, k] + corners[t, 2, k]) / 3.0
        for c in range(3):
            square = 0.0
            for k in range(3):
                square += (corners[t, c, k] - middle[t, k]) ** 2
            largest = square if square > largest else largest
        radius[t] = math.sqrt(largest)
    for i in range(x.shape[0]):
        best, chosen, near = math.inf, 0, math.inf
        px, py, pz = x[i, 0], x[i, 1], x[i, 2]
        for t in range(count):
            dx, dy, dz = px - middle[t, 0], py - middle[t, 1], pz - middle[t, 2]
            if dx * dx + dy * dy + dz * dz > (near + radius[t]) ** 2:
                continue
            a, b, c, _ = closest_on_triangle(px, py, pz, corners[t, 0], corners[t, 1], corners[t, 2])
            d = (px - a) ** 2 + (py - b) ** 2 + (pz - c) ** 2
            if d < best:
                best, chosen, near = d, t, math.sqrt(d)
        face[i], squared[i] = chosen, best


@jit
def nearest_on_grids(x, frames, values, layout, boxes, only, best, normal, segment):
    """Update `best`, `normal`, `segment` where a mesh is nearer than the present surface.

    Parameters: x (3, N) [m] in the world; frames (S, 12); values, layout, boxes of a `GridTable`; only (N,) the segment
    that a point may belong to, -1 for any; best (N,) signed distance [m]; normal (3, N) outward at the closest point,
    which is x - best * normal; segment (N,).

    With the distances d_i and gradients g_i of a cell's eight nodes x_i and their trilinear weights w_i,
    d(x) = sum w_i (d_i + g_i·(x - x_i) / 2), which is exact for quadratic fields. Points outside of a grid get the
    closest point of the nearest position in the grid.
    """
    for g in range(layout.shape[0]):
        s, start, nx, ny, nz = layout[g, 0], layout[g, 1], layout[g, 2], layout[g, 3], layout[g, 4]
        f = frames[s]
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
        tx, ty, tz = f[9], f[10], f[11]
        ox, oy, oz, cell = boxes[g, 0], boxes[g, 1], boxes[g, 2], boxes[g, 3]
        mx, my, mz, hx, hy, hz = boxes[g, 4], boxes[g, 5], boxes[g, 6], boxes[g, 7], boxes[g, 8], boxes[g, 9]
        radius = math.sqrt(hx * hx + hy * hy + hz * hz)
        inverse = 1.0 / cell
        row, plane = nz, ny * nz
        # centre of the surface's box in the world
        wx = r00 * mx + r01 * my + r02 * mz + tx
        wy = r10 * mx + r11 * my + r12 * mz + ty
        wz = r20 * mx + r21 * my + r22 * mz + tz
        for p in range(x.shape[1]):
            dx, dy, dz = x[0, p] - wx, x[1, p] - wy, x[2, p] - wz
            bound = abs(best[p])
            reach = radius + bound
            if dx * dx + dy * dy + dz * dz > reach * reach or (only[p] >= 0 and only[p] != s):
                continue
            bx = r00 * dx + r10 * dy + r20 * dz
            by = r01 * dx + r11 * dy + r21 * dz
            bz = r02 * dx + r12 * dy + r22 * dz
            ex, ey, ez = abs(bx) - hx, abs(by) - hy, abs(bz) - hz
            ex, ey, ez = ex if ex > 0.0 else 0.0, ey if ey > 0.0 else 0.0, ez if ez > 0.0 else 0.0
            if ex * ex + ey * ey + ez * ez > bound * bound:
                continue
            ax, ay, az = (bx + mx - ox) * inverse, (by + my - oy) * inverse, (bz + mz - oz) * inverse  # in cells
            cx, cy, cz = ax if ax > 0.0 else 0.0, ay if ay > 0.0 else 0.0, az if az > 0.0 else 0.0
            cx = cx if cx < nx - 1.0 else nx - 1.0
            cy = cy if cy < ny - 1.0 else ny - 1.0
            cz = cz if cz < nz - 1.0 else nz - 1.0
            i, j, k = int(cx), int(cy), int(cz)
            i, j, k = i if i < nx - 2 else nx - 2, j if j < ny - 2 else ny - 2, k if k < nz - 2 else nz - 2
            u, v, w = cx - i, cy - j, cz - k
            node = start + i * plane + j * row + k
            d = gx = gy = gz = 0.0
            for corner in range(8):
                a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
                weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
                at = values[node + a * plane + b * row + c]
                d += weight * (at[0] + 0.5 * cell * (at[1] * (u - a) + at[2] * (v - b) + at[3] * (w - c)))
                gx += weight * at[1]
                gy += weight * at[2]
                gz += weight * at[3]
            scale = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz + 1e-30)
            gx, gy, gz = gx * scale, gy * scale, gz * scale
            if ax != cx or ay != cy or az != cz:  # outside of the grid
                gx, gy, gz = (ax - cx) * cell + d * gx, (ay - cy) * cell + d * gy, (az - cz) * cell + d * gz
                d = math.sqrt(gx * gx + gy * gy + gz * gz)
                gx, gy, gz = gx / d, gy / d, gz / d
            if abs(d) < bound:
                best[p] = d
                segment[p] = s
                normal[0, p] = r00 * gx + r01 * gy + r02 * gz
                normal[1, p] = r10 * gx + r11 * gy + r12 * gz
                normal[2, p] = r20 * gx + r21 * gy + r22 * gz
