"""Which points can be a segment's markers, and how likely they are: depth-first search over distances."""

import math

import numpy as np

from kinefit._jit import jit
from kinefit.identification.frame._kernels_evidence import evidence, place_joint

_HALF_LOG = 1.5 * math.log(2 * math.pi)
MOST_STEPS = 100_000  # of the search in one segment, about 10 ms: reached only where noise is as large as the segment
LEAST_WORK = 4_000  # a call that begins without any left is granted this much
CALL, LEAF = 8_000, 5  # a call with what Python does around it, and a point of a rigid fit, in tries of a distance
MOST_EXCESS = 4.0
LEAST = 4.0  # what a choice must earn that nothing above holds: accidents are many


@jit
def apart(a, b):
    """Distance of two points (3,)."""
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@jit
def reach_cost(joint, variance, anchors, reach, anchor_sigma):
    """-log density [1/m³] of a joint that lies `reach` from one anchor (a sphere) or from two (a circle)."""
    cost = 0.0
    for a in range(len(anchors)):
        d = apart(joint, anchors[a])
        v = variance + anchor_sigma[a] ** 2
        cost += 0.5 * (d - reach[a]) ** 2 / v + 0.5 * math.log(2 * math.pi * v)
    if len(anchors) == 1:
        return cost + math.log(4 * math.pi * reach[0] ** 2)
    return cost + math.log(2 * math.pi * reach[0] * reach[1] / apart(anchors[0], anchors[1]))


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
    """All likely choices of points for a segment's k markers, and their costs (-log likelihood against no choice).

    points (N, 3), gaps (N, N) their distances, blocked (N,) those taken already; x (k, 3), D (k, k) of the model;
    sigma (k,) per coordinate;
    given (k,) the point of a marker that the parent has too, -1 where the parent misses it, -2 where it is to be found;
    pivot (3,) where the parent says that x_pivot is, with pivot_sigma (none where <= 0); without one, x_pivot may be
    known to lie `reach` (A,) [m] from `anchors` (A, 3), A <= 2, else anywhere in the volume; gain (k,): what a match
    earns against a miss; slack: costs this much above the best are kept. A choice differs from the model's distances by
    `gate` deviations at most; work_left (1,) float: tries that are left for the frame, here used up; at none the search
    ends with what it has. Fills out_*; returns how many there are (those beyond the room are dropped).
    """
    k, N = len(x), len(points)
    xs, ys, ss = np.empty((k + 1, 3)), np.empty((k + 1, 3)), np.empty(k + 1)
    work = np.empty((8 + k // 3 + 1, 3))
    choice = np.full(k, -1)
    nxt = np.zeros(k, np.int64)
    used = blocked.copy()
    order = np.empty(k, np.int64)
    known, m = 0, 0
    for i in range(k):
        if given[i] >= 0:
            order[m] = i
            choice[i] = given[i]
            used[given[i]] = True
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
        arm[i] = apart(x[i], x_pivot)
    if has_pivot:
        all_w += 1 / pivot_sigma**2
    # points that each marker may be by what is known without any choice, and what that costs at least
    maybe, least, many = np.empty((last + 1, N), np.int64), np.empty((last + 1, N)), np.zeros(last + 1, np.int64)
    for depth in range(known, last):
        i = order[depth]
        for q in range(N):
            if used[q]:
                continue
            lb = 0.0
            if has_pivot:
                e2 = (apart(points[q], pivot) - arm[i]) ** 2
                if e2 > gate * gate * (sigma[i] ** 2 + pivot_sigma**2):
                    continue
                lb += e2 / (sigma[i] ** 2 * pivot_sigma**2)
            ok = True
            for a in range(len(anchors)):
                d = apart(points[q], anchors[a])
                ok = ok and abs(d - reach[a]) <= arm[i] + gate * (anchor_sigma[a] + sigma[i])
            for j in range(known):
                o = order[j]
                e2 = (gaps[q, choice[o]] - D[i, o]) ** 2
                ok = ok and e2 <= gate * gate * (sigma[i] ** 2 + sigma[o] ** 2)
                lb += e2 / (sigma[i] ** 2 * sigma[o] ** 2)
            if ok:
                maybe[depth, many[depth]], least[depth, many[depth]] = q, lb
                many[depth] += 1
    left = max(work_left[0] - CALL - N * (last - known), LEAST_WORK)
    rest = np.zeros(last + 1)  # what the markers still to come may earn
    for j in range(last - 1, known - 1, -1):
        earn = gain[order[j]] - _HALF_LOG - 3 * math.log(sigma[order[j]])
        rest[j] = rest[j + 1] + (earn if earn > 0 and many[j] > 0 else 0.0)
    # what is known without any choice
    n = 0
    for j in range(known):
        xs[n], ys[n], ss[n] = x[order[j]], points[choice[order[j]]], sigma[order[j]]
        n += 1
    if has_pivot:
        xs[n], ys[n], ss[n] = x_pivot, pivot, pivot_sigma
        n += 1
    loose = n == 0
    J = np.empty(3)
    base, base_rss = evidence(n, xs, ys, ss, work)
    out_cost[0], out_rss[0] = 0.0, base_rss
    for i in range(k):
        out_index[0, i] = choice[i]
    count = 1
    best, best_crude = (-slack - LEAST if loose else 0.0), 0.0
    bound = np.zeros(last + 1)
    matched, earned = np.zeros(last + 1, np.int64), np.zeros(last + 1)
    depth = known
    if depth < last:
        nxt[depth] = 0
    steps = 0
    while depth >= known and known < last and steps < MOST_STEPS and left > 0:
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
                left -= LEAF * n
                cost, rss = evidence(n, xs, ys, ss, work)
                cost -= base + earned[depth]
                if loose and (len(anchors) == 0 or n < 3):
                    cost += log_volume
                elif loose:
                    variance = place_joint(n, xs, ys, ss, x_pivot, J)
                    closer = reach_cost(J, variance, anchors, reach, anchor_sigma)
                    cost += closer if variance < 0.01 else log_volume
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
            used[choice[i]] = False
        choice[i] = -1
        place = nxt[depth]
        found = False
        while place < many[depth] and not found:
            q = maybe[depth, place]
            left -= 1 + 0.3 * (depth - known)
            if not used[q]:
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
            nxt[depth] = place
            choice[i] = q
            used[q] = True
            depth += 1
            if depth < last:
                nxt[depth] = 0
        elif nxt[depth] <= N:  # the marker is missing
            nxt[depth] = N + 1  # beyond all points
            if bound[depth] - rest[depth + 1] <= best_crude + slack + 10:
                bound[depth + 1] = bound[depth]
                matched[depth + 1] = matched[depth]
                earned[depth + 1] = earned[depth]
                depth += 1
                if depth < last:
                    nxt[depth] = 0
        else:
            depth -= 1
    work_left[0] = left if work_left[0] - CALL > 0 else 0.0
    return count


@jit
def range_cost(points, theirs, index, low, high, width, out):
    """out (C,): how far a segment's choices leave the distances to the parent's points that training showed.

    theirs (k',) the parent's points, index (C, k) the choices; low, high, width (k', k) [m]. Three times the mean over
    pairs (a joint turns in three ways) of half the squared excess over `width`, each at most MOST_EXCESS.
    """
    for c in range(len(out)):
        total, count = 0.0, 0
        for i in range(len(theirs)):
            p = theirs[i]
            for j in range(index.shape[1]):
                q = index[c, j]
                if p < 0 or q < 0 or p == q or width[i, j] <= 0:
                    continue
                d = apart(points[p], points[q])
                e = low[i, j] - d if d < low[i, j] else (d - high[i, j] if d > high[i, j] else 0.0)
                e = 0.5 * (e / width[i, j]) ** 2
                total += e if e < MOST_EXCESS else MOST_EXCESS
                count += 1
        out[c] = 3 * total / count if count > 0 else 0.0
