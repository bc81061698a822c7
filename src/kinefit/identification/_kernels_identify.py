"""Which points can be a segment's markers, and how likely they are: depth-first search over distances, rigid fits."""

import math

import numpy as np

from kinefit._jit import jit

_HALF_LOG = 1.5 * math.log(2 * math.pi)
_TURNS = math.log(8 * math.pi**2) - 1.5 * math.log(2 * math.pi)
MOST_EXCESS = 4.0
LEAST = 4.0  # what a choice must earn that nothing above holds: accidents are many
MOST_STEPS = 100_000  # of the search in one segment, about 10 ms: reached only where noise is as large as the segment
_FLAT = 1 / (2 * math.pi)  # [1/rad²] curvature whose Gaussian has the width of a whole turn


@jit
def largest_quaternion(N, q):
    """q: unit eigenvector (w, x, y, z) of the largest eigenvalue of the symmetric 4 x 4 N (Jacobi; N is destroyed)."""
    V = np.eye(4)
    for _ in range(12):
        off = 0.0
        for i in range(3):
            for j in range(i + 1, 4):
                off += N[i, j] * N[i, j]
        if off <= 1e-30 * (N[0, 0] ** 2 + N[1, 1] ** 2 + N[2, 2] ** 2 + N[3, 3] ** 2):
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if N[i, j] == 0.0:
                    continue
                theta = (N[j, j] - N[i, i]) / (2 * N[i, j])
                t = 1 / (abs(theta) + math.sqrt(theta * theta + 1))
                t = t if theta >= 0 else -t
                c = 1 / math.sqrt(t * t + 1)
                s = t * c
                for k in range(4):
                    a, b = N[k, i], N[k, j]
                    N[k, i], N[k, j] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = N[i, k], N[j, k]
                    N[i, k], N[j, k] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = V[k, i], V[k, j]
                    V[k, i], V[k, j] = c * a - s * b, s * a + c * b
    best = 0
    for i in range(1, 4):
        best = i if N[i, i] > N[best, best] else best
    for k in range(4):
        q[k] = V[k, best]


@jit
def rigid(n, x, y, w, R, t, H):
    """Weighted rigid motion of x[:n] onto y[:n] by proper rotations: Σ w |y - R x - t|².

    Fills R, t and H = Σ w (|x|² I - x xᵀ) about the weighted centroid, in the frame of x.
    """
    total = 0.0
    a, b = np.zeros(3), np.zeros(3)
    for i in range(n):
        total += w[i]
        for k in range(3):
            a[k] += w[i] * x[i, k]
            b[k] += w[i] * y[i, k]
    a /= total
    b /= total
    S = np.zeros((3, 3))
    H[:] = 0.0
    for i in range(n):
        x0, x1, x2 = x[i, 0] - a[0], x[i, 1] - a[1], x[i, 2] - a[2]
        for k in range(3):
            d = w[i] * (y[i, k] - b[k])
            S[0, k] += x0 * d
            S[1, k] += x1 * d
            S[2, k] += x2 * d
        H[0, 0] += w[i] * (x1 * x1 + x2 * x2)
        H[1, 1] += w[i] * (x0 * x0 + x2 * x2)
        H[2, 2] += w[i] * (x0 * x0 + x1 * x1)
        H[0, 1] -= w[i] * x0 * x1
        H[0, 2] -= w[i] * x0 * x2
        H[1, 2] -= w[i] * x1 * x2
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    N = np.empty((4, 4))
    N[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
    N[1, 1] = S[0, 0] - S[1, 1] - S[2, 2]
    N[2, 2] = S[1, 1] - S[0, 0] - S[2, 2]
    N[3, 3] = S[2, 2] - S[0, 0] - S[1, 1]
    N[0, 1] = N[1, 0] = S[1, 2] - S[2, 1]
    N[0, 2] = N[2, 0] = S[2, 0] - S[0, 2]
    N[0, 3] = N[3, 0] = S[0, 1] - S[1, 0]
    N[1, 2] = N[2, 1] = S[0, 1] + S[1, 0]
    N[1, 3] = N[3, 1] = S[2, 0] + S[0, 2]
    N[2, 3] = N[3, 2] = S[1, 2] + S[2, 1]
    q = np.empty(4)
    largest_quaternion(N, q)
    qw, qx, qy, qz = q[0], q[1], q[2], q[3]
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
    rss = 0.0
    for k in range(3):
        t[k] = b[k] - R[k, 0] * a[0] - R[k, 1] * a[1] - R[k, 2] * a[2]
    for i in range(n):
        for k in range(3):
            e = y[i, k] - t[k] - R[k, 0] * x[i, 0] - R[k, 1] * x[i, 1] - R[k, 2] * x[i, 2]
            rss += w[i] * e * e
    return rss


@jit
def evidence(n, x, y, sigma, work):
    """-log of the density of n points of a rigid segment, its place and turn integrated out; and the weighted squares.

    ∫∫ Π N(y; R x + t, σ²) dt dR = Π (2πσ²)^-3/2 (2π/W)^3/2 (2π)^3/2 det(H)^-1/2 / 8π² exp(-rss/2), W = Σ 1/σ².
    """
    if n == 0:
        return 0.0, 0.0
    R, t, H, w = work[0:3], work[3], work[4:7], work[7:].reshape(-1)
    total, cost = 0.0, 0.0
    for i in range(n):
        w[i] = 1 / (sigma[i] * sigma[i])
        total += w[i]
        cost += _HALF_LOG + 3 * math.log(sigma[i])
    rss = 0.0
    if n > 1:
        rss = rigid(n, x, y, w, R, t, H)
        a, b, c = H[0, 0] + _FLAT, H[1, 1] + _FLAT, H[2, 2] + _FLAT
        d, e, f = H[0, 1], H[0, 2], H[1, 2]
        det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
        turn = _TURNS + 0.5 * math.log(det if det > 1e-12 else 1e-12)
        cost += turn if turn > 0.0 else 0.0
    return 0.5 * rss + cost - _HALF_LOG + 1.5 * math.log(total), rss


@jit
def place_joint(n, x, y, sigma, joint, out):
    """out: where a segment's fit puts a joint [m]; returns the variance of that per coordinate [m²], averaged."""
    R, t, H, w = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(n)
    total = 0.0
    for i in range(n):
        w[i] = 1 / (sigma[i] * sigma[i])
        total += w[i]
    rigid(n, x, y, w, R, t, H)
    r = np.empty(3)
    for k in range(3):
        out[k] = t[k] + R[k, 0] * joint[0] + R[k, 1] * joint[1] + R[k, 2] * joint[2]
        r[k] = joint[k]
        for i in range(n):
            r[k] -= w[i] * x[i, k] / total
    a, b, c, d, e, f = H[0, 0] + _FLAT, H[1, 1] + _FLAT, H[2, 2] + _FLAT, H[0, 1], H[0, 2], H[1, 2]
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    i00, i11, i22 = b * c - f * f, a * c - e * e, a * b - d * d
    i01, i02, i12 = e * f - d * c, d * f - b * e, d * e - a * f
    square = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    inner = r[0] ** 2 * i00 + r[1] ** 2 * i11 + r[2] ** 2 * i22 + 2 * (r[0] * r[1] * i01 + r[0] * r[2] * i02 + r[1] * r[2] * i12)
    return 1 / total + (square * (i00 + i11 + i22) - inner) / (3 * det)


@jit
def reach_cost(joint, variance, anchors, reach, anchor_sigma):
    """-log density [1/m³] of a joint that lies `reach` from one anchor (a sphere) or from two (a circle)."""
    cost = 0.0
    for a in range(len(anchors)):
        d = math.sqrt((joint[0] - anchors[a, 0]) ** 2 + (joint[1] - anchors[a, 1]) ** 2 + (joint[2] - anchors[a, 2]) ** 2)
        v = variance + anchor_sigma[a] ** 2
        cost += 0.5 * (d - reach[a]) ** 2 / v + 0.5 * math.log(2 * math.pi * v)
    if len(anchors) == 1:
        return cost + math.log(4 * math.pi * reach[0] ** 2)
    apart = math.sqrt(
        (anchors[0, 0] - anchors[1, 0]) ** 2 + (anchors[0, 1] - anchors[1, 1]) ** 2 + (anchors[0, 2] - anchors[1, 2]) ** 2
    )
    return cost + math.log(2 * math.pi * reach[0] * reach[1] / apart)


@jit
def enumerate_segment(
    points, gaps, blocked, x, D, sigma, given, x_pivot, pivot, pivot_sigma, anchors, reach, anchor_sigma, log_volume,
    gate, gain, slack, fewest, out_index, out_cost, out_rss,
):
    """All likely choices of points for a segment's k markers, and their costs (-log likelihood against no choice).

    points (N, 3), gaps (N, N) their distances, blocked (N,) those taken already; x (k, 3), D (k, k) of the model; sigma (k,) per coordinate;
    given (k,) the point of a marker that the parent has too, -1 where the parent misses it, -2 where it is to be found;
    pivot (3,) where the parent says that x_pivot is, with pivot_sigma (none where <= 0); without one, x_pivot may be
    known to lie `reach` (A,) [m] from `anchors` (A, 3), A <= 2, else anywhere in the volume; gain: what a match earns
    against a miss; slack: costs this much above the best are kept. A choice differs from the model's distances by
    `gate` deviations at most. Fills out_*; returns how many there are (those beyond the room are dropped).
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
    if has_pivot:
        all_w += 1 / pivot_sigma**2
    rest = np.zeros(last + 1)  # what the markers still to come may earn
    for j in range(last - 1, known - 1, -1):
        earn = gain - 2 * _HALF_LOG / 2 - 3 * math.log(sigma[order[j]])
        rest[j] = rest[j + 1] + (earn if earn > 0 else 0.0)
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
    matched = np.zeros(last + 1, np.int64)
    depth = known
    if depth < last:
        nxt[depth] = 0
    steps = 0
    while depth >= known and known < last and steps < MOST_STEPS:
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
                cost, rss = evidence(n, xs, ys, ss, work)
                cost -= base + matched[depth] * gain
                if loose and (len(anchors) == 0 or n < 3):
                    cost += log_volume
                elif loose:
                    variance = place_joint(n, xs, ys, ss, x_pivot, J)
                    closer = reach_cost(J, variance, anchors, reach, anchor_sigma)
                    cost += closer if variance < 0.01 else log_volume
                if cost < best + slack and matched[depth] > 0:
                    best = cost if cost < best else best
                    crude = 0.5 * rss + bound[depth] * 0.0
                    for j in range(known, last):
                        if choice[order[j]] >= 0:
                            crude -= gain - _HALF_LOG - 3 * math.log(sigma[order[j]])
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
        q = nxt[depth]
        found = False
        while q < N and not found:
            if not used[q]:
                ok = True
                lb = 0.0
                if has_pivot:
                    d = math.sqrt(
                        (points[q, 0] - pivot[0]) ** 2 + (points[q, 1] - pivot[1]) ** 2 + (points[q, 2] - pivot[2]) ** 2
                    )
                    D0 = math.sqrt((x[i, 0] - x_pivot[0]) ** 2 + (x[i, 1] - x_pivot[1]) ** 2 + (x[i, 2] - x_pivot[2]) ** 2)
                    v = sigma[i] ** 2 + pivot_sigma**2
                    e2 = (d - D0) ** 2
                    ok = e2 <= gate * gate * v
                    lb += e2 / (sigma[i] ** 2 * pivot_sigma**2)
                for a in range(len(anchors)):
                    d = math.sqrt(
                        (points[q, 0] - anchors[a, 0]) ** 2
                        + (points[q, 1] - anchors[a, 1]) ** 2
                        + (points[q, 2] - anchors[a, 2]) ** 2
                    )
                    D0 = math.sqrt((x[i, 0] - x_pivot[0]) ** 2 + (x[i, 1] - x_pivot[1]) ** 2 + (x[i, 2] - x_pivot[2]) ** 2)
                    ok = ok and abs(d - reach[a]) <= D0 + gate * (anchor_sigma[a] + sigma[i])
                if ok:
                    for j in range(depth):
                        o = order[j]
                        if choice[o] >= 0:
                            e2 = (gaps[q, choice[o]] - D[i, o]) ** 2
                            if e2 > gate * gate * (sigma[i] ** 2 + sigma[o] ** 2):
                                ok = False
                                break
                            lb += e2 / (sigma[i] ** 2 * sigma[o] ** 2)
                if ok:
                    earn = gain - _HALF_LOG - 3 * math.log(sigma[i])
                    total = bound[depth] + 0.5 * lb / all_w - earn
                    if total - rest[depth + 1] <= best_crude + slack + 10:
                        found = True
                        bound[depth + 1] = total
                        matched[depth + 1] = matched[depth] + 1
            q += 1
        if found:
            nxt[depth] = q
            choice[i] = q - 1
            used[q - 1] = True
            depth += 1
            if depth < last:
                nxt[depth] = 0
        elif nxt[depth] <= N:  # the marker is missing
            nxt[depth] = N + 1
            if bound[depth] - rest[depth + 1] <= best_crude + slack + 10:
                bound[depth + 1] = bound[depth]
                matched[depth + 1] = matched[depth]
                depth += 1
                if depth < last:
                    nxt[depth] = 0
        else:
            depth -= 1
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
                d = math.sqrt(
                    (points[p, 0] - points[q, 0]) ** 2 + (points[p, 1] - points[q, 1]) ** 2 + (points[p, 2] - points[q, 2]) ** 2
                )
                e = low[i, j] - d if d < low[i, j] else (d - high[i, j] if d > high[i, j] else 0.0)
                e = 0.5 * (e / width[i, j]) ** 2
                total += e if e < MOST_EXCESS else MOST_EXCESS
                count += 1
        out[c] = 3 * total / count if count > 0 else 0.0


@jit
def weigh_child(new, best, total, extra, taken):
    """Least of `best`, and -log Σ exp(-total), over the choices (C, W bits) that take none of the points `taken`."""
    low, low_total = math.inf, math.inf
    for c in range(len(best)):
        free = True
        for i in range(len(taken)):
            free = free and (new[c, i] & taken[i]) == 0
        if free:
            low = best[c] + extra[c] if best[c] + extra[c] < low else low
            low_total = total[c] + extra[c] if total[c] + extra[c] < low_total else low_total
    mass = 0.0
    for c in range(len(best)):
        free = True
        for i in range(len(taken)):
            free = free and (new[c, i] & taken[i]) == 0
        if free:
            mass += math.exp(low_total - total[c] - extra[c])
    return low, low_total - math.log(mass)
