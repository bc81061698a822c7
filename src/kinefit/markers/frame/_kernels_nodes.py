"""The choices of a segment as the search keeps them, and their costs given a choice of the parent: numba."""

import math

import numpy as np

from kinefit._jit import jit
from kinefit.markers.frame._kernels_identify import enumerate_segment, range_cost


@jit
def expand_segment(
    points,
    gaps,
    bits,
    taken,
    x,
    D,
    sigma,
    given,
    x_pivot,
    pivot,
    pivot_sigma,
    anchors,
    reach,
    anchor_sigma,
    log_volume,
    gate,
    gain,
    slack,
    fewest,
    work_left,
    room,
    kept,
):
    """Choices of a segment in order of cost, up to `kept` above the best; always includes the empty choice (no point).

    bits (N + 1, W): one bit per point, the last row empty; taken (W,): points that may only be used as given; room:
    most choices. Other arguments as in `enumerate_segment`. Returns index (C, k), cost (C,), squares (C,), the bits
    (C, W) of points chosen here and of all points, the union (W,) of those chosen here, and the empty choice's index.
    """
    k, N, W = len(x), len(points), bits.shape[1]
    blocked = np.zeros(N, np.bool_)
    for q in range(N):
        for b in range(W):
            blocked[q] = blocked[q] or (bits[q, b] & taken[b]) != 0
    for i in range(k):
        if given[i] >= 0:
            blocked[given[i]] = False
    index, cost, squares = np.empty((room, k), np.int64), np.empty(room), np.empty(room)
    count = enumerate_segment(
        points, gaps, blocked, x, D, sigma, given, x_pivot, pivot, pivot_sigma, anchors, reach, anchor_sigma,
        log_volume, gate, gain, slack, fewest, work_left, index, cost, squares,
    )  # fmt: skip
    order = np.argsort(cost[:count])
    kept_count = 0
    has_empty = False
    for c in range(count):
        if cost[order[c]] <= cost[order[0]] + kept:
            has_empty = has_empty or order[c] == 0
            kept_count += 1
    total = kept_count if has_empty else kept_count + 1
    out, costs, rss = np.empty((total, k), np.int64), np.empty(total), np.empty(total)
    new, every, union = np.zeros((total, W), np.uint64), np.zeros((total, W), np.uint64), np.zeros(W, np.uint64)
    empty = kept_count
    for c in range(total):
        o = order[c] if c < kept_count else 0
        empty = c if o == 0 else empty
        costs[c], rss[c] = cost[o], squares[o]
        for i in range(k):
            q = index[o, i]
            out[c, i] = q
            for b in range(W if q >= 0 else 0):
                every[c, b] |= bits[q, b]
                if given[i] == -2:
                    new[c, b] |= bits[q, b]
                    union[b] |= bits[q, b]
    return out, costs, rss, new, every, union, empty


@jit
def cheapest_compatible(points, parent_points, index, low, high, width, has_ranges, new, best, taken):
    """Least cost, `best` (C,) plus range costs, of a child's choices that use no point of `taken` (W,).

    parent_points (k',) of the parent's choice; other arguments as in `range_cost`.
    """
    extra = np.zeros(len(best))
    if has_ranges:
        range_cost(points, parent_points, index, low, high, width, extra)
    least = math.inf
    for c in range(len(best)):
        free = True
        for i in range(len(taken)):
            free = free and (new[c, i] & taken[i]) == 0
        if free and best[c] + extra[c] < least:
            least = best[c] + extra[c]
    return least
