"""Enumerate the likely assignments of points to a segment's markers: depth-first search over distances."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.markers.frame._kernels_evidence import evidence, place_joint

_HALF_LOG = 1.5 * math.log(2 * math.pi)
MAX_STEPS = 100_000  # in one segment, about 10 ms: reached only if the noise is as large as the segment
MIN_CALL_WORK = 4_000  # granted to each call, even if the frame's work is used up
WORK_PER_CALL = 8_000  # cost of a call with its Python part; the unit of work is one distance test
WORK_PER_POINT = 5  # cost of one point in a rigid fit
MAX_RANGE_COST = 4.0  # of one distance outside its training range
MIN_FREE_GAIN = 4.0  # of a choice without any constraint from the parent: accidental matches are frequent


@jit
def distance(a, b):
    """Distance [m] of two points (3,)."""
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@jit
def reach_cost(joint, variance, anchors, reach, anchor_sigma):
    """-log density [1/m³] of a joint (3,) at distance `reach` [m] from one anchor (a sphere) or two (a circle)."""
    cost = 0.0
    for a in range(len(anchors)):
        d = distance(joint, anchors[a])
        v = variance + anchor_sigma[a] ** 2
        cost += 0.5 * (d - reach[a]) ** 2 / v + 0.5 * math.log(2 * math.pi * v)
    if len(anchors) == 1:
        return cost + math.log(4 * math.pi * reach[0] ** 2)
    return cost + math.log(2 * math.pi * reach[0] * reach[1] / distance(anchors[0], anchors[1]))


@jit
def enumerate_segment(
    points,
    gaps,
    blocked,
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
    out_index,
    out_cost,
    out_rss,
):
    """Enumerate likely choices of points for a segment's k markers, with costs (-log likelihood ratio to no choice).

    points (N, 3) [m], gaps (N, N) [m] their distances, blocked (N,) bool those taken; x (k, 3), D (k, k) [m] positions
    and distances in the model; sigma (k,) [m] per coordinate.
    given (k,): the point of a marker shared with the parent, -1 if the parent misses it, -2 if it is to be found.
    pivot (3,) [m]: place of x_pivot by the parent, with pivot_sigma [m] (<= 0: unknown). Without it x_pivot lies at
    distance `reach` (A,) [m] from `anchors` (A, 3), A <= 2, or else anywhere in the volume. gain (k,): gain of a match
    over a miss. Choices with a cost up to `slack` above the best are kept. Distances may differ from the model's by
    `gate` standard deviations. work_left (1,): remaining work of the frame, reduced here; at zero the search ends.
    Fills out_*; returns the number of choices. If there are more than out_* holds, the worst are dropped.
    """
    k, N = len(x), len(points)
    xs, ys, ss = np.empty((k + 1, 3)), np.empty((k + 1, 3)), np.empty(k + 1)
    work = np.empty((8 + k // 3 + 1, 3))
    choice = np.full(k, -1)
    next_place = np.zeros(k, np.int64)
    taken = blocked.copy()
    order = np.empty(k, np.int64)
    known, m = 0, 0
    for i in range(k):
        if given[i] >= 0:
            order[m] = i
            choice[i] = given[i]
            taken[given[i]] = True
            m += 1
    known = m
    for i in range(k):
        if given[i] == -2:
            order[m] = i
            m += 1
    last = m
    all_w = 0.0
    for j in range(last):
        all_w += 1 / sigma[order[j]] ** 2
    has_pivot = pivot_sigma > 0
    arm = np.empty(k)
    for i in range(k):
        arm[i] = distance(x[i], x_pivot)
    if has_pivot:
        all_w += 1 / pivot_sigma**2
    # candidate points of each marker before any choice, and the least cost of each
    candidates, least, many = np.empty((last + 1, N), np.int64), np.empty((last + 1, N)), np.zeros(last + 1, np.int64)
    for depth in range(known, last):
        i = order[depth]
        for q in range(N):
            if taken[q]:
                continue
            lb = 0.0
            if has_pivot:
                e2 = (distance(points[q], pivot) - arm[i]) ** 2
                if e2 > gate * gate * (sigma[i] ** 2 + pivot_sigma**2):
                    continue
                lb += e2 / (sigma[i] ** 2 * pivot_sigma**2)
            ok = True
            for a in range(len(anchors)):
                d = distance(points[q], anchors[a])
                ok = ok and abs(d - reach[a]) <= arm[i] + gate * (anchor_sigma[a] + sigma[i])
            for j in range(known):
                o = order[j]
                e2 = (gaps[q, choice[o]] - D[i, o]) ** 2
                ok = ok and e2 <= gate * gate * (sigma[i] ** 2 + sigma[o] ** 2)
                lb += e2 / (sigma[i] ** 2 * sigma[o] ** 2)
            if ok:
                candidates[depth, many[depth]], least[depth, many[depth]] = q, lb
                many[depth] += 1
    left = max(work_left[0] - WORK_PER_CALL - N * (last - known), MIN_CALL_WORK)
    rest = np.zeros(last + 1)  # largest gain of the remaining markers
    for j in range(last - 1, known - 1, -1):
        earn = gain[order[j]] - _HALF_LOG - 3 * math.log(sigma[order[j]])
        rest[j] = rest[j + 1] + (earn if earn > 0 and many[j] > 0 else 0.0)
    # cost before any choice
    n = 0
    for j in range(known):
        xs[n], ys[n], ss[n] = x[order[j]], points[choice[order[j]]], sigma[order[j]]
        n += 1
    if has_pivot:
        xs[n], ys[n], ss[n] = x_pivot, pivot, pivot_sigma
        n += 1
    unconstrained = n == 0
    J = np.empty(3)
    base, base_rss = evidence(n, xs, ys, ss, work)
    out_cost[0], out_rss[0] = 0.0, base_rss
    for i in range(k):
        out_index[0, i] = choice[i]
    count = 1
    best, best_crude = (-slack - MIN_FREE_GAIN if unconstrained else 0.0), 0.0
    bound = np.zeros(last + 1)
    matched, earned = np.zeros(last + 1, np.int64), np.zeros(last + 1)
    depth = known
    if depth < last:
        next_place[depth] = 0
    steps = 0
    while depth >= known and known < last and steps < MAX_STEPS and left > 0:
        steps += 1
        if depth == last:
            if matched[depth] >= fewest:
                n = 0
                for j in range(last):
                    i = order[j]
                    if choice[i] >= 0:
                        xs[n], ys[n], ss[n] = x[i], points[choice[i]], sigma[i]
                        n += 1
                if has_pivot:
                    xs[n], ys[n], ss[n] = x_pivot, pivot, pivot_sigma
                    n += 1
                left -= WORK_PER_POINT * n
                cost, rss = evidence(n, xs, ys, ss, work)
                cost -= base + earned[depth]
                if unconstrained and (len(anchors) == 0 or n < 3):
                    cost += log_volume
                elif unconstrained:
                    variance = place_joint(n, xs, ys, ss, x_pivot, J)
                    joint_cost = reach_cost(J, variance, anchors, reach, anchor_sigma)
                    cost += joint_cost if variance < 0.01 else log_volume
                if cost < best + slack and matched[depth] > 0:
                    best = cost if cost < best else best
                    crude = 0.5 * rss
                    for j in range(known, last):
                        if choice[order[j]] >= 0:
                            crude -= gain[order[j]] - _HALF_LOG - 3 * math.log(sigma[order[j]])
                    best_crude = crude if crude < best_crude else best_crude
                    if count < len(out_cost):
                        for i in range(k):
                            out_index[count, i] = choice[i]
                        out_cost[count], out_rss[count] = cost, rss
                        count += 1
                    else:  # replace the worst
                        worst = 1
                        for c in range(2, count):
                            worst = c if out_cost[c] > out_cost[worst] else worst
                        if cost < out_cost[worst]:
                            for i in range(k):
                                out_index[worst, i] = choice[i]
                            out_cost[worst], out_rss[worst] = cost, rss
            depth -= 1
            continue
        i = order[depth]
        if choice[i] >= 0:
            taken[choice[i]] = False
        choice[i] = -1
        place = next_place[depth]
        found = False
        while place < many[depth] and not found:
            q = candidates[depth, place]
            left -= 1 + 0.3 * (depth - known)
            if not taken[q]:
                ok = True
                lb = least[depth, place]
                for j in range(known, depth):
                    o = order[j]
                    if choice[o] >= 0:
                        e2 = (gaps[q, choice[o]] - D[i, o]) ** 2
                        if e2 > gate * gate * (sigma[i] ** 2 + sigma[o] ** 2):
                            ok = False
                            break
                        lb += e2 / (sigma[i] ** 2 * sigma[o] ** 2)
                if ok:
                    earn = gain[i] - _HALF_LOG - 3 * math.log(sigma[i])
                    total = bound[depth] + 0.5 * lb / all_w - earn
                    if total - rest[depth + 1] <= best_crude + slack + 10:
                        found = True
                        bound[depth + 1] = total
                        matched[depth + 1] = matched[depth] + 1
                        earned[depth + 1] = earned[depth] + gain[i]
            place += 1
        if found:
            next_place[depth] = place
            choice[i] = q
            taken[q] = True
            depth += 1
            if depth < last:
                next_place[depth] = 0
        elif next_place[depth] <= N:  # the marker is missing
            next_place[depth] = N + 1  # past the last point
            if bound[depth] - rest[depth + 1] <= best_crude + slack + 10:
                bound[depth + 1] = bound[depth]
                matched[depth + 1] = matched[depth]
                earned[depth + 1] = earned[depth]
                depth += 1
                if depth < last:
                    next_place[depth] = 0
        else:
            depth -= 1
    work_left[0] = left if work_left[0] - WORK_PER_CALL > 0 else 0.0
    return count


@jit
def range_cost(points, parent_points, index, low, high, width, out):
    """Write to out (C,) the cost of distances to the parent's points that lie outside their training range.

    parent_points (k',) the parent's points, index (C, k) the choices; low, high, width (k', k) [m]. The cost is the
    mean over pairs of half the squared excess over `width`, each at most MAX_RANGE_COST, times three rotations.
    """
    for c in range(len(out)):
        total, count = 0.0, 0
        for i in range(len(parent_points)):
            p = parent_points[i]
            for j in range(index.shape[1]):
                q = index[c, j]
                if p < 0 or q < 0 or p == q or width[i, j] <= 0:
                    continue
                d = distance(points[p], points[q])
                e = low[i, j] - d if d < low[i, j] else (d - high[i, j] if d > high[i, j] else 0.0)
                e = 0.5 * (e / width[i, j]) ** 2
                total += e if e < MAX_RANGE_COST else MAX_RANGE_COST
                count += 1
        out[c] = 3 * total / count if count > 0 else 0.0


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
