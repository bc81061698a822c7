"""Many poses of a body against one small depth image; distances along a depth image's surface."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.bodies._kernels import forward
from kinefit.bodies.rendering._kernels import rasterise
from kinefit.geometry._kernels_camera import ROT, TRANS
from kinefit.geometry._kernels_frames import moved
from kinefit.solving.correspondences.occupancy._kernels_space import capsule_gaps


@jit
def agreement(
    parents, dof_start, prismatic, axes, rest, roots, angles, vertices, owner, faces, fingers, T_view_world, lens,
    observed, behind, trust, base, tolerance, out,
):  # fmt: skip
    """Pixels that each of B poses explains, and pixels that contradict it.

    roots (B, 4, 4), angles (B, D); vertices (V, 3) at rest with their segments owner (V,), closed faces (T, 3) of
    them, and of which hand's fingers they are (T,), 0 for none; lens (4,): fx, fy, cx, cy of the view. observed (h, w)
    [m], 0 where the body was not seen; behind (h, w) [m]: depth of other objects, inf for none; trust (h, w) in 0..1:
    confidence that no body is at a pixel without one; base (h, w) [m]: rendered depth of fixed parts, inf for none.
    Fixed parts are counted once, and corrected where the pose's own parts are in front of them. Fingers of a hand are
    stretched if that explains more, else folded.
    Out (B, 2): pixels explained, each 1 - |Δz| / tolerance; pixels contradicted: rendered where the sensor saw past it.
    """
    h, w = observed.shape
    frames, screws = np.empty((parents.size, 12)), np.empty((axes.shape[0], 6))
    x, room = np.empty(vertices.shape), np.empty((6, len(vertices)))
    depth, face = np.empty((h, w), np.float32), np.empty((h, w), np.int32)
    whole_for, whole_against, hands = 0.0, 0.0, np.empty((max(fingers.max(), 0) + 1 if len(fingers) else 1, 2))
    for i in range(h):
        for j in range(w):
            if base[i, j] < math.inf:
                explained, contradicted = _judged(base[i, j], observed[i, j], behind[i, j], trust[i, j], tolerance)
                whole_for += explained
                whole_against += contradicted
    for b in range(len(roots)):
        forward(parents, dof_start, prismatic, axes, rest, roots[b], angles[b], frames, screws)
        for v in range(len(vertices)):
            x[v, 0], x[v, 1], x[v, 2] = moved(frames[owner[v]], vertices[v, 0], vertices[v, 1], vertices[v, 2])
        rasterise(x, T_view_world, faces, lens[0], lens[1], lens[2], lens[3], 0.05, True, room, depth, face)
        hands[:] = 0.0
        top, bottom, left, right = _box(room, h, w)
        for i in range(top, bottom):
            for j in range(left, right):
                z, before = depth[i, j], base[i, j]
                if not z < before:
                    continue
                hand = fingers[face[i, j]]
                explained, contradicted = _judged(z, observed[i, j], behind[i, j], trust[i, j], tolerance)
                if before < math.inf:
                    less, fewer = _judged(before, observed[i, j], behind[i, j], trust[i, j], tolerance)
                    explained, contradicted = explained - less, contradicted - fewer
                hands[hand, 0] += explained
                hands[hand, 1] += contradicted
        out[b, 0], out[b, 1] = whole_for + hands[0, 0], whole_against + hands[0, 1]
        for k in range(1, len(hands)):
            if hands[k, 0] > hands[k, 1]:
                out[b, 0] += hands[k, 0]
                out[b, 1] += hands[k, 1]


@jit
def _box(room, h, w):
    """First and last row and column (ends excluded) that vertices as `rasterise` has left them in its room may fill."""
    top, bottom, left, right = float(h), 0.0, float(w), 0.0
    for v in range(room.shape[1]):
        if not room[5, v] > 0.0:  # too near: its triangles are cut
            return 0, h, 0, w
        left, right = min(left, room[3, v]), max(right, room[3, v])
        top, bottom = min(top, room[4, v]), max(bottom, room[4, v])
    return int(max(top, 0.0)), int(min(bottom + 2.0, h)), int(max(left, 0.0)), int(min(right + 2.0, w))


@jit
def _judged(z, observed, behind, trust, tolerance):
    """Explained and contradicted part, each 0..1, of a pixel rendered at z [m]."""
    if observed > 0.0:
        gap = (z - observed) / tolerance
        size, before = abs(gap), -0.5 * gap
        explained = 1.0 - size if size < 1.0 else 0.0
        return explained, 0.0 if before < 0.0 else (before if before < 1.0 else 1.0)
    return 0.0, float(trust) if z < behind else 0.0


@jit
def of_hands(depth, hand, observed, behind, trust, tolerance, out):
    """Write to out (H, 2) the explained and contradicted pixels of each hand's fingers; hand (h, w)."""
    out[:] = 0.0
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            if hand[i, j] > 0:
                explained, contradicted = _judged(depth[i, j], observed[i, j], behind[i, j], trust[i, j], tolerance)
                out[hand[i, j], 0] += explained
                out[hand[i, j], 1] += contradicted


@jit
def overlaps(parents, dof_start, prismatic, axes, rest, roots, angles, owner, starts, ends, pairs, apart, out):
    """Write the summed penetration [m] of a body's capsules to out (B,), for each of B poses.

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


MAX_MEMORY_IMAGES = 50.0  # in the running mean: it follows a sensor that warms up


@jit
def learn(
    depth, rays, camera, low, high, drawn, cell, row, step, variance, gate, wait, learns_near,
    mean, spread, count, waiting, bound,
):  # fmt: skip
    """Learn one image, cell by cell (its upper left pixel), every `step`-th row of cells from `row` on.

    depth (H, W) [m], 0 for none; rays, camera as in `gated_points`; low, high (3,) [m]: box that the body may be in;
    drawn (h, w) at any size: 0 outside the body and its margin; variance = (a, b): a + b z⁴ of a depth
    z, until it is learnt; gate: squared sigmas of an outlier; wait: images that an object new in the box must stay;
    learns_near: whether such objects may be learnt at all.
    In place: mean [m], spread [m²] of it, count of measurements (0: unknown), waiting: images in which a new object was
    seen; bound [m]: mean minus √gate sigmas: anything nearer is new; inf where the background is unknown.
    """
    r00, r01, r02 = camera[ROT], camera[ROT + 1], camera[ROT + 2]
    r10, r11, r12 = camera[ROT + 3], camera[ROT + 4], camera[ROT + 5]
    r20, r21, r22 = camera[ROT + 6], camera[ROT + 7], camera[ROT + 8]
    t0, t1, t2 = camera[TRANS], camera[TRANS + 1], camera[TRANS + 2]
    across, up, along = r20 * (high[0] - low[0]), r21 * (high[1] - low[1]), r22 * (high[2] - low[2])
    front = t2 + r20 * low[0] + r21 * low[1] + r22 * low[2]  # depth at which the box begins
    front += (across if across < 0.0 else 0.0) + (up if up < 0.0 else 0.0) + (along if along < 0.0 else 0.0)
    rows, columns = mean.shape
    for i in range(row, rows, step):
        for j in range(columns):
            v, u = i * cell, j * cell
            z = float(depth[v, u])
            if z <= 0.0:
                continue
            prior = variance[0] + variance[1] * z * z * z * z
            off = z - mean[i, j]
            known = count[i, j] > 0.0
            if known and off * off <= gate * spread[i, j]:
                n = count[i, j] + 1.0 if count[i, j] < MAX_MEMORY_IMAGES else MAX_MEMORY_IMAGES
                mean[i, j] += off / n
                part = off * off * (n - 1.0) / n
                spread[i, j] += (part - spread[i, j]) / (n + 4.0)  # the prior counts for four
                count[i, j] = n
                waiting[i, j] = 0.0
                bound[i, j] = mean[i, j] - math.sqrt(gate * spread[i, j])
                continue
            if known and off < 0.0:
                waiting[i, j] = 0.0
                continue
            a, b, c = z * rays[0, v, u] - t0, z * rays[1, v, u] - t1, z - t2
            x = r00 * a + r10 * b + r20 * c
            y = r01 * a + r11 * b + r21 * c
            w = r02 * a + r12 * b + r22 * c
            near = low[0] < x < high[0] and low[1] < y < high[1] and low[2] < w < high[2]
            own = drawn[i * drawn.shape[0] // rows, j * drawn.shape[1] // columns] > 0
            forget = own and z < front  # it occludes the body, which may reappear behind it at any time
            if near:
                may = learns_near and not own
                waiting[i, j] = waiting[i, j] + 1.0 if may or known else 0.0
                enough = waiting[i, j] >= wait
                forget = known and (mean[i, j] < front or (enough and not may))  # gone: this may be the body
                if not enough and not forget:
                    continue
            if forget:
                count[i, j], waiting[i, j], bound[i, j] = 0.0, 0.0, math.inf
                continue
            mean[i, j], spread[i, j], count[i, j], waiting[i, j] = z, prior, 1.0, 0.0
            bound[i, j] = z - math.sqrt(gate * prior)


@jit
def mark(depth, bound, cell, first, last):
    """Negate the pixels of an image, in place, that show the background or lie behind it."""
    height, width = depth.shape
    for i in range(first[0], last[0]):
        bottom = (i + 1) * cell if (i + 1) * cell < height else height
        for v in range(i * cell, bottom):
            for j in range(first[1], last[1]):
                right = (j + 1) * cell if (j + 1) * cell < width else width
                for u in range(j * cell, right):
                    z = depth[v, u]
                    depth[v, u] = -z if z > bound[i, j] else z


@jit
def gated_points(
    depth, rays, camera, low, high, first_row, last_row, first_column, last_column, step, patches, out, share,
):  # fmt: skip
    """Write the world points (3, N) of every `step`-th pixel of a window that lie in the box low..high (3,) [m]; count.

    share (N,): patches of surface that a point stands for, about, at most 1: `patches` [1/m²] times z².
    """
    r00, r01, r02 = camera[ROT], camera[ROT + 1], camera[ROT + 2]
    r10, r11, r12 = camera[ROT + 3], camera[ROT + 4], camera[ROT + 5]
    r20, r21, r22 = camera[ROT + 6], camera[ROT + 7], camera[ROT + 8]
    t0, t1, t2 = camera[TRANS], camera[TRANS + 1], camera[TRANS + 2]
    n = 0
    for v in range(first_row, last_row, step):
        for u in range(first_column, last_column, step):
            m = depth[v, u]
            if m <= 0.0:
                continue
            a, b, c = m * rays[0, v, u] - t0, m * rays[1, v, u] - t1, m - t2
            x = r00 * a + r10 * b + r20 * c
            y = r01 * a + r11 * b + r21 * c
            z = r02 * a + r12 * b + r22 * c
            if low[0] < x < high[0] and low[1] < y < high[1] and low[2] < z < high[2]:
                out[0, n], out[1, n], out[2, n] = x, y, z
                part = patches * m * m
                share[n] = part if part < 1.0 else 1.0
                n += 1
    return n


@jit
def box(x, out):
    """Write the smallest and largest coordinates (2, 3) of points (N, 3)."""
    for k in range(3):
        low, high = math.inf, -math.inf
        for i in range(x.shape[0]):
            v = x[i, k]
            low = v if v < low else low
            high = v if v > high else high
        out[0, k], out[1, k] = low, high
