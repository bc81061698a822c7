"""Compiled normalised cross-correlation of windows in search boxes, to the pixel."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit


@jit
def search_boxes(first, second, at, centres, half, reach, places, best, runner_up):
    """Search windows at points (N, 2) of one image (H, W) float32 in boxes of another with centres (N, 2), all [px].

    Fills the positions (N, 2) of highest correlation, with the template's fraction of a pixel; the correlation (N,);
    and the highest correlation more than half a window away (N,). NaN where window or box is outside of the images.
    """
    height, width = second.shape
    n = 2 * half + 1
    f = np.empty((n, n), np.float32)
    side = 2 * reach + 1
    score = np.empty((side, side))
    for k in range(at.shape[0]):
        places[k, 0] = places[k, 1] = best[k] = runner_up[k] = math.nan
        if not (abs(at[k, 0]) + abs(at[k, 1]) + abs(centres[k, 0]) + abs(centres[k, 1]) < math.inf):
            continue
        i, j = math.floor(at[k, 0] + 0.5), math.floor(at[k, 1] + 0.5)
        if i < half or j < half or i + half >= first.shape[1] or j + half >= first.shape[0]:
            continue
        part_u, part_v = at[k, 0] - i, at[k, 1] - j
        total = 0.0
        for y in range(n):
            for x in range(n):
                f[y, x] = first[j - half + y, i - half + x]
                total += f[y, x]
        mean = np.float32(total / (n * n))
        energy = 0.0
        for y in range(n):
            for x in range(n):
                f[y, x] -= mean
                energy += f[y, x] * f[y, x]
        if not energy > 0.0:
            continue
        a, b = math.floor(centres[k, 0] - part_u + 0.5), math.floor(centres[k, 1] - part_v + 0.5)
        top, high_a, high_b = -2.0, 0, 0
        for dy in range(side):
            for dx in range(side):
                left, up = a - reach + dx - half, b - reach + dy - half
                score[dy, dx] = -2.0
                if left < 0 or up < 0 or left + n > width or up + n > height:
                    continue
                h0 = h1 = hh = 0.0
                for y in range(n):
                    r0 = r1 = rr = np.float32(0.0)
                    for x in range(n):
                        h = second[up + y, left + x] - mean
                        r0 += h
                        r1 += h * f[y, x]
                        rr += h * h
                    h0, h1, hh = h0 + float(r0), h1 + float(r1), hh + float(rr)
                variance = hh - h0 * h0 / (n * n)
                value = h1 / math.sqrt(energy * variance) if variance > 0.0 else 0.0
                score[dy, dx] = value
                if value > top:
                    top, high_a, high_b = value, dx, dy
        if not top > -2.0:
            continue
        second_best = -1.0
        for dy in range(side):
            for dx in range(side):
                far = abs(dx - high_a) > half or abs(dy - high_b) > half
                if far and score[dy, dx] > second_best:
                    second_best = score[dy, dx]
        places[k, 0], places[k, 1] = a - reach + high_a + part_u, b - reach + high_b + part_v
        best[k], runner_up[k] = top, second_best
