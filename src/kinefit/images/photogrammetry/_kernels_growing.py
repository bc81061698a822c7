"""Compiled region growing from seeds over a grid, the best neighbour first (Otto and Chau 1989)."""

from __future__ import annotations

import numpy as np

from kinefit._jit import jit
from kinefit.images.photogrammetry.matching import _kernels_matching as matching


@jit
def push(keys, items, size, key, item):
    """Push an item with its key onto a max-heap of `size`; returns the new size."""
    i = size
    while i > 0:
        up = (i - 1) // 2
        if keys[up] >= key:
            break
        keys[i], items[i] = keys[up], items[up]
        i = up
    keys[i], items[i] = key, item
    return size + 1


@jit
def pop(keys, items, size):
    """Pop the item of the largest key from a max-heap of `size` > 0; returns the item and the new size."""
    item, size = items[0], size - 1
    key, last = keys[size], items[size]
    i = 0
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and keys[child + 1] > keys[child]:
            child += 1
        if key >= keys[child]:
            break
        keys[i], items[i] = keys[child], items[child]
        i = child
    keys[i], items[i] = key, last
    return item, size


@jit
def grow(first, second, at, columns, seeds, starts, halves, steps, tolerance, share, own, least, reach, out):
    """Match a grid of points (N, 2) [px], `columns` per row, from seeds (S,) with starts (S, 6) in the second spline.

    A point starts from the map of its matched neighbour with the highest correlation, and again from later neighbours
    if that fails. A match is rejected if its correlation is below `least` or if it is more than `reach` [px] from the
    neighbour's prediction. Points with NaN are skipped. Fills out (N, 15); returns the number of attempts.
    """
    count = at.shape[0]
    f, fx, fy, rows, m, b, kept = matching.room(halves)
    keys, items, size = np.empty(count + 1), np.empty(count + 1, np.int64), 0
    start, tried = np.empty(6), 0
    for k in range(count):
        out[k, :] = np.nan
        out[k, matching.STATUS] = matching.NOT_VISITED
    for s in range(seeds.shape[0]):
        k = seeds[s]
        if out[k, matching.STATUS] == matching.FOUND or not (abs(at[k, 0]) < np.inf and abs(at[k, 1]) < np.inf):
            continue
        matching.match_point(
            first, second, at[k, 0], at[k, 1], starts[s], halves[k], steps, tolerance, share, own,
            f, fx, fy, rows, m, b, kept, out[k],
        )  # fmt: skip
        tried += 1
        if out[k, matching.STATUS] == matching.FOUND and out[k, matching.CORRELATION] >= least:
            size = push(keys, items, size, out[k, matching.CORRELATION], k)
        elif out[k, matching.STATUS] == matching.FOUND:
            out[k, matching.STATUS] = matching.DIVERGED
    while size > 0:
        k, size = pop(keys, items, size)
        for side in range(4):
            if side == 0 and k % columns > 0:
                other = k - 1
            elif side == 1 and k % columns < columns - 1:
                other = k + 1
            elif side == 2 and k >= columns:
                other = k - columns
            elif side == 3 and k + columns < count:
                other = k + columns
            else:
                continue
            state = out[other, matching.STATUS]
            if not (state == matching.NOT_VISITED or state == matching.DIVERGED or state == matching.OUTSIDE_IMAGE):
                continue
            x, y = at[other, 0] - at[k, 0], at[other, 1] - at[k, 1]
            if not (abs(x) < np.inf and abs(y) < np.inf):
                continue
            start[0] = out[k, matching.U] + out[k, matching.A] * x + out[k, matching.A + 1] * y
            start[1] = out[k, matching.V] + out[k, matching.A + 2] * x + out[k, matching.A + 3] * y
            for i in range(4):
                start[2 + i] = out[k, matching.A + i]
            matching.match_point(
                first, second, at[other, 0], at[other, 1], start, halves[other], steps, tolerance, share, own,
                f, fx, fy, rows, m, b, kept, out[other],
            )  # fmt: skip
            tried += 1
            if out[other, matching.STATUS] == matching.FOUND:
                du, dv = out[other, matching.U] - start[0], out[other, matching.V] - start[1]
                if out[other, matching.CORRELATION] >= least and du * du + dv * dv <= reach * reach:
                    size = push(keys, items, size, out[other, matching.CORRELATION], other)
                else:
                    out[other, matching.STATUS] = matching.DIVERGED
    return tried
