"""Background model of a depth camera: mean and variance of the depth of each cell, learnt while it tracks."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import ROT, TRANS

MAX_MEMORY_IMAGES = 50.0  # in the running mean: it follows a sensor that warms up


@jit
def learn(
    depth, rays, camera, low, high, drawn, cell, row, step, variance, gate, wait, learns_near,
    mean, spread, count, waiting, bound,
):  # fmt: skip
    """Learn one image, cell by cell (its upper left pixel), every `step`-th row of cells from `row` on.

    depth (H, W) [m], 0 for none; rays, camera as in `gated_points`; low, high (3,) [m]: box that the body may be in;
    drawn (h, w) at any size: inf outside the body and its margin; variance = (a, b): a + b z⁴ of a depth
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
            own = drawn[i * drawn.shape[0] // rows, j * drawn.shape[1] // columns] < math.inf
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
def widened(drawn, reach, out):
    """Write to out (h, w) 0 where a body is rendered, and up to `reach` pixels about it; inf elsewhere."""
    rows, columns = drawn.shape
    for i in range(rows):
        for j in range(columns):
            out[i, j] = math.inf
    for i in range(rows):
        for j in range(columns):
            if drawn[i, j] < math.inf:
                for a in range(i - reach if i > reach else 0, i + reach + 1 if i + reach < rows else rows):
                    for b in range(j - reach if j > reach else 0, j + reach + 1 if j + reach < columns else columns):
                        out[a, b] = 0.0
