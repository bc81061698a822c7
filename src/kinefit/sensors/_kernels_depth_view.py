"""Many poses of a body against one small depth image; distances along a depth image's surface."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit._kernels_rendering import rasterise
from kinefit.bodies._kernels import forward
from kinefit.correspondences._kernels_space import capsule_gaps


@jit
def agreement(
    parents, dof_start, prismatic, axes, rest, roots, angles, vertices, owner, faces, T_view_world, lens,
    observed, behind, trust, base, tolerance, out,
):  # fmt: skip
    """How well each of B poses explains what was seen, both ways, in pixels.

    roots (B, 4, 4), angles (B, D); vertices (V, 3) at rest with their segments owner (V,), faces (T, 3); lens (4,):
    fx, fy, cx, cy of the view. observed (h, w) [m], 0 where the body was not seen; behind (h, w) [m]: what else was
    measured there, inf for nothing; trust (h, w) in 0..1: how sure it is that no body is at a pixel without one;
    base (h, w) [m]: parts that stay, drawn before, inf where none is.
    Out (B, 2): pixels explained, each 1 - |Δz| / tolerance; pixels contradicted: drawn where the sensor saw past it.
    """
    h, w = observed.shape
    frames, screws = np.empty((parents.size, 12)), np.empty((axes.shape[0], 6))
    x, room = np.empty(vertices.shape), np.empty((6, len(vertices)))
    depth, face = np.empty((h, w), np.float32), np.empty((h, w), np.int32)
    for b in range(len(roots)):
        forward(parents, dof_start, prismatic, axes, rest, roots[b], angles[b], frames, screws)
        for v in range(len(vertices)):
            f = frames[owner[v]]
            p, q, r = vertices[v, 0], vertices[v, 1], vertices[v, 2]
            x[v, 0] = f[0] * p + f[1] * q + f[2] * r + f[9]
            x[v, 1] = f[3] * p + f[4] * q + f[5] * r + f[10]
            x[v, 2] = f[6] * p + f[7] * q + f[8] * r + f[11]
        rasterise(x, T_view_world, faces, lens[0], lens[1], lens[2], lens[3], 0.05, False, room, depth, face)
        explained, contradicted = 0.0, 0.0
        for i in range(h):
            for j in range(w):
                z = depth[i, j]
                z = base[i, j] if base[i, j] < z else z
                if not z < math.inf:
                    continue
                o = observed[i, j]
                if o > 0.0:
                    gap = (z - o) / tolerance
                    size = abs(gap)
                    explained += 1.0 - size if size < 1.0 else 0.0
                    before = -0.5 * gap
                    contradicted += 0.0 if before < 0.0 else (before if before < 1.0 else 1.0)
                elif z < behind[i, j]:
                    contradicted += trust[i, j]
        out[b, 0], out[b, 1] = explained, contradicted


@jit
def overlaps(parents, dof_start, prismatic, axes, rest, roots, angles, owner, starts, ends, pairs, apart, out):
    """How deep capsules of a body lie in each other, summed [m], for each of B poses: out (B,).

    owner (C,), starts and ends (C, 3) [m] at rest; pairs (P, 2) and apart (P,) [m] as in `collision_pairs`.
    """
    frames, screws = np.empty((parents.size, 12)), np.empty((axes.shape[0], 6))
    p, q, n = np.empty((len(pairs), 3)), np.empty((len(pairs), 3)), np.empty((len(pairs), 3))
    distance = np.empty(len(pairs))
    for b in range(len(roots)):
        forward(parents, dof_start, prismatic, axes, rest, roots[b], angles[b], frames, screws)
        capsule_gaps(frames, owner, starts, ends, pairs, p, q, n, distance)
        total = 0.0
        for k in range(len(pairs)):
            missing = apart[k] - distance[k]
            total += missing if missing > 0.0 else 0.0
        out[b] = total


@jit
def spread(points, seen, jump, distance):
    """Shorten geodesic distances (h, w) [m] until no step to a neighbour, shorter than `jump` [m], shortens one.

    Sweeps over the image in turns of direction (as in fast sweeping): a few suffice for a body.
    """
    h, w = seen.shape
    for sweep in range(64):
        changed = False
        for ii in range(h):
            i = ii if sweep % 2 == 0 else h - 1 - ii
            for jj in range(w):
                j = jj if (sweep // 2) % 2 == 0 else w - 1 - jj
                if not seen[i, j]:
                    continue
                best = distance[i, j]
                for a in range(i - 1, i + 2):
                    for b in range(j - 1, j + 2):
                        if a < 0 or a >= h or b < 0 or b >= w or not seen[a, b] or not distance[a, b] < best:
                            continue
                        dx, dy, dz = (
                            points[a, b, 0] - points[i, j, 0],
                            points[a, b, 1] - points[i, j, 1],
                            points[a, b, 2] - points[i, j, 2],
                        )
                        step = math.sqrt(dx * dx + dy * dy + dz * dz)
                        if step < jump and distance[a, b] + step < best - 1e-6:
                            best = distance[a, b] + step
                            changed = True
                distance[i, j] = best
        if not changed:
            break
