"""Kernels of seams: intersections of two parts of a body in an image, and their derivatives."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian

_MAX_STRAY_PX = 3.0  # of a seam from the pixels where it was found: the body has moved a pixel since it was rendered


@jit
def borders(face, depth, segment, part, gap, every, out):
    """Write the pairs of adjacent pixels of two parts that meet; return their number.

    face, depth (h, w) [m] as rendered; segment, part (T,) of each face: the pair's parts differ, and their depths do by
    `gap` [m] at most. One in `every` such pairs is kept: out (N, 6) is face one, face two (of the segment with the
    higher number first), column and row between them, and the direction from the first to the second.
    """
    height, width = face.shape
    n, seen = 0, 0
    for j in range(height - 1):
        for i in range(width - 1):
            f = face[j, i]
            if f < 0:
                continue
            for d in range(2):
                q, p = (j, i + 1) if d == 0 else (j + 1, i)
                g = face[q, p]
                if g < 0 or part[g] == part[f] or abs(depth[q, p] - depth[j, i]) > gap:
                    continue
                seen += 1
                if seen % every or n >= len(out):
                    continue
                first = segment[f] > segment[g]
                sign = 1.0 if first else -1.0
                out[n, 0], out[n, 1] = (f, g) if first else (g, f)
                out[n, 2], out[n, 3] = i + (0.5 if d == 0 else 0.0), j + (0.5 if d == 1 else 0.0)
                out[n, 4], out[n, 5] = (sign, 0.0) if d == 0 else (0.0, sign)
                n += 1
    return n


@jit
def _plane(vertices, faces, f):
    """Unit normal of a triangle and its distance from the origin along it."""
    a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
    p, q, r = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    s, t, u = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = q * u - r * t, r * s - p * u, p * t - q * s
    length = math.sqrt(x * x + y * y + z * z)
    length = length if length > 1e-12 else 1e-12
    x, y, z = x / length, y / length, z / length
    return x, y, z, x * a[0] + y * a[1] + z * a[2]


@jit
def seams(camera, vertices, faces, found, uv, ray, least, outline, point, pulls):
    """Write points of the curves in which triangles of two parts intersect; return how many of `found` (N, 6) have one.

    camera packed; vertices (V, 3) [m] in the world; uv (N, 2) [px] where the curve is about, ray (N, 3) [m] the point
    of the surface there. Planes at an angle whose sine is below `least` are skipped. outline (4, N): pixel and unit
    normal, away from the first part; point (N, 3) [m]; pulls (2, N, 3) [px/m]: the seam moves along its normal by
    pulls[0] · dx of the first part's point and pulls[1] · dx of the second part's.
    """
    n = 0
    for k in range(len(found)):
        ax, ay, az, ha = _plane(vertices, faces, int(found[k, 0]))
        bx, by, bz, hb = _plane(vertices, faces, int(found[k, 1]))
        tx, ty, tz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        square = tx * tx + ty * ty + tz * tz
        if square < least * least:
            continue
        ht = tx * ray[k, 0] + ty * ray[k, 1] + tz * ray[k, 2]
        x = (ha * (by * tz - bz * ty) + hb * (ty * az - tz * ay) + ht * tx) / square
        y = (ha * (bz * tx - bx * tz) + hb * (tz * ax - tx * az) + ht * ty) / square
        z = (ha * (bx * ty - by * tx) + hb * (tx * ay - ty * ax) + ht * tz) / square
        ok, u, v, ux, uy, uz, vx, vy, vz = project_jacobian(camera, x, y, z)
        if not ok or abs(u - uv[k, 0]) > _MAX_STRAY_PX or abs(v - uv[k, 1]) > _MAX_STRAY_PX:
            continue
        du, dv = ux * tx + uy * ty + uz * tz, vx * tx + vy * ty + vz * tz
        length = math.sqrt(du * du + dv * dv)
        if length < 1e-9:
            continue
        a, b = -dv / length, du / length
        if a * found[k, 4] + b * found[k, 5] < 0.0:
            a, b = -a, -b
        gx, gy, gz = a * ux + b * vx, a * uy + b * vy, a * uz + b * vz
        c = ax * bx + ay * by + az * bz
        one, two = gx * ax + gy * ay + gz * az, gx * bx + gy * by + gz * bz
        alpha, beta = (one - c * two) / (1.0 - c * c), (two - c * one) / (1.0 - c * c)
        outline[0, n], outline[1, n], outline[2, n], outline[3, n] = u, v, a, b
        point[n, 0], point[n, 1], point[n, 2] = x, y, z
        pulls[0, n, 0], pulls[0, n, 1], pulls[0, n, 2] = alpha * ax, alpha * ay, alpha * az
        pulls[1, n, 0], pulls[1, n, 1], pulls[1, n, 2] = beta * bx, beta * by, beta * bz
        found[n, 0], found[n, 1] = found[k, 0], found[k, 1]
        n += 1
    return n
