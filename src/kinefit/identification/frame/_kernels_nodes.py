"""A segment's choices as the search keeps them, and what they cost beside a choice of the parent's: numba."""

import math

import numpy as np

from kinefit._jit import jit
from kinefit.identification.frame._kernels_identify import enumerate_segment, range_cost


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
    """Choices of a segment, the cheapest first, up to `kept` above the best; that of no point at all is always there.

    bits (N + 1, W) of each point, the last of none; taken (W,) those that nobody may take but as given; room: choices
    at most; the rest as `enumerate_segment` has it. Returns index (C, k), cost (C,), squares (C,), the bits (C, W) of
    points chosen here and of all, all of the first together (W,), and which is the choice of none.
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
    few = 0
    seen = False
    for c in range(count):
        if cost[order[c]] <= cost[order[0]] + kept:
            seen = seen or order[c] == 0
            few += 1
    total = few if seen else few + 1
    out, costs, rss = np.empty((total, k), np.int64), np.empty(total), np.empty(total)
    new, every, union = np.zeros((total, W), np.uint64), np.zeros((total, W), np.uint64), np.zeros(W, np.uint64)
    empty = few
    for c in range(total):
        o = order[c] if c < few else 0
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
def cheapest_beside(points, theirs, index, low, high, width, tells, new, best, taken):
    """Least cost (C,) `best` of a child's choices, with their ranges where those tell, that take none of `taken` (W,).

    theirs (k',) the points of the parent's choice, the rest as `range_cost` has it.
    """
    extra = np.zeros(len(best))
    if tells:
        range_cost(points, theirs, index, low, high, width, extra)
    least = math.inf
    for c in range(len(best)):
        free = True
        for i in range(len(taken)):
            free = free and (new[c, i] & taken[i]) == 0
        if free and best[c] + extra[c] < least:
            least = best[c] + extra[c]
    return least
