"""Compiled search for windows of one image along lines of sight in another."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit


@jit
def search_lines(first, second, at, lines, maps, half, least_variance, best_uv, best_map, best, runner_up):
    """Search windows around points (S, 2) [px] of one image (H, W) float32 along polylines in the other.

    A line has K corners (S, K, 2) [px], each with a map (S, K, 4) of an offset in the first image to the second. It is
    sampled in steps of one pixel, with the window's pixels at the nearest pixels of their mapped positions. Corners
    with NaN interrupt it. Windows with less than the least variance are skipped. Fills the position (S, 2) of highest
    correlation, its map (S, 4), the correlation (S,), and the highest correlation more than half a window away (S,).
    NaN where nothing was searched.
    """
    height, width = second.shape
    n = 2 * half + 1
    f = np.empty((n, n))
    most = 0
    for s in range(lines.shape[0]):
        length = 0
        for k in range(lines.shape[1] - 1):
            du, dv = lines[s, k + 1, 0] - lines[s, k, 0], lines[s, k + 1, 1] - lines[s, k, 1]
            gap = math.sqrt(du * du + dv * dv)
            if gap < math.inf:
                length += int(gap) + 2
        most = max(most, length)
    score, place = np.empty(most), np.empty((most, 6))
    for s in range(at.shape[0]):
        best_uv[s, :], best_map[s, :], best[s], runner_up[s] = math.nan, math.nan, math.nan, math.nan
        i, j = math.floor(at[s, 0] + 0.5), math.floor(at[s, 1] + 0.5)
        if i < half or j < half or i + half >= first.shape[1] or j + half >= first.shape[0]:
            continue
        mean = 0.0
        for y in range(n):
            for x in range(n):
                f[y, x] = first[j - half + y, i - half + x]
                mean += f[y, x]
        mean /= n * n
        energy = 0.0
        for y in range(n):
            for x in range(n):
                f[y, x] -= mean
                energy += f[y, x] * f[y, x]
        if not energy > least_variance * n * n:
            continue
        count, top = 0, -1
        for k in range(lines.shape[1] - 1):
            du, dv = lines[s, k + 1, 0] - lines[s, k, 0], lines[s, k + 1, 1] - lines[s, k, 1]
            gap = math.sqrt(du * du + dv * dv)
            if not gap < math.inf:
                continue
            steps = int(gap) + 1
            for step in range(steps):
                t = step / steps
                u, v = lines[s, k, 0] + t * du, lines[s, k, 1] + t * dv
                a = maps[s, k, 0] + t * (maps[s, k + 1, 0] - maps[s, k, 0])
                b = maps[s, k, 1] + t * (maps[s, k + 1, 1] - maps[s, k, 1])
                c = maps[s, k, 2] + t * (maps[s, k + 1, 2] - maps[s, k, 2])
                d = maps[s, k, 3] + t * (maps[s, k + 1, 3] - maps[s, k, 3])
                wide, high = (abs(a) + abs(b)) * half + 1.0, (abs(c) + abs(d)) * half + 1.0
                if u < wide or v < high or u + wide >= width - 1 or v + high >= height - 1:
                    continue
                h0 = h1 = hh = 0.0
                for y in range(n):
                    for x in range(n):
                        p = int(u + a * (x - half) + b * (y - half) + 0.5)
                        q = int(v + c * (x - half) + d * (y - half) + 0.5)
                        h = second[q, p] - mean
                        h0 += h
                        h1 += h * f[y, x]
                        hh += h * h
                variance = hh - h0 * h0 / (n * n)
                score[count] = h1 / math.sqrt(energy * variance) if variance > 0.0 else 0.0
                place[count, 0], place[count, 1] = u, v
                place[count, 2], place[count, 3], place[count, 4], place[count, 5] = a, b, c, d
                if top < 0 or score[count] > score[top]:
                    top = count
                count += 1
        if top < 0:
            continue
        runner_up[s] = -1.0
        for k in range(count):
            du, dv = place[k, 0] - place[top, 0], place[k, 1] - place[top, 1]
            if du * du + dv * dv > half * half and score[k] > runner_up[s]:
                runner_up[s] = score[k]
        best_uv[s, 0], best_uv[s, 1], best[s] = place[top, 0], place[top, 1], score[top]
        for q in range(4):
            best_map[s, q] = place[top, 2 + q]
