"""Closest points of tapered elliptical cylinders.

In a cylinder's own coordinates (p along its first half axis, q along the second, h along the axis) its side is
X(θ, h) = (a(h) cos θ, b(h) sin θ, h) with a = a0 + ga h, b = b0 + gb h and 0 <= h <= L. By symmetry p and q are
positive. For given h the closest point is that of an ellipse, for given θ that of a line. Alternating both converges
within a few rounds, because the slopes are small. Newton's method makes the result exact.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_frames import moved, turned

BLOCK = 1024  # points at a time, whose buffers fit into the cache
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)  # literals would promote to double precision
_EPSILON = np.float32(1e-30)  # avoids divisions by 0
_MIN_DIRECTION = np.float32(1e-4)  # added to cos θ and sin θ, for points on the axis
_MIN_OFFSET = np.float32(1e-6)  # [m] between point and surface, below which the offset has no direction
_MAX_GUESS_OFFSET = np.float32(1e-2)  # [m] up to which a first guess is trusted
_INFINITY = np.float32(1e9)  # [m]
_MAX_ROUND_RATIO = np.float32(1.5)  # of half axes, for one round: 0.2 mm for 99 % of points within 10 cm
_MIN_COSINE_SQUARE = np.float32(0.96)  # between normal and offset of a point; below, the guess is not the closest point
_MAX_SLOPE = 0.5  # of a radius along the axis: up to 0.6 one start always found the closest point (60 shapes)
_SKIP_MARGIN = 0.005  # [m] by which a first guess must exceed the best to skip a cylinder; its error is 1 mm
_MAX_ITERATIONS = 30  # of Newton's method
_MIN_STEP = 1e-10  # [m] at which it ends


@jit
def _start(p, q, h, a0, b0, ga, gb, length):
    """First guess (cos θ, sin θ, h), and the elliptic radius squared of the point: below 1 inside at its height."""
    h = h if h > ZERO else ZERO
    h = h if h < length else length
    a, b = a0 + ga * h, b0 + gb * h
    inverse = ONE / (a * b)
    c, s = p * b * inverse, q * a * inverse
    out = c * c + s * s
    deep = ONE - out if out < ONE else ZERO  # near the axis all angles are possible: start at 45°
    c, s = c + HALF * deep + _MIN_DIRECTION, s + HALF * deep + _MIN_DIRECTION
    k = ONE / math.sqrt(c * c + s * s)
    return c * k, s * k, h, out


@jit
def _round(p, q, z, c, s, h, a0, b0, ga, gb, length):
    """One alternating step: θ on the ellipse at h by its circle of curvature, then h on the line at that angle."""
    a, b = a0 + ga * h, b0 + gb * h
    inverse = ONE / (a * b)
    squares, ia, ib = a * a - b * b, b * inverse, a * inverse
    ex, ey = squares * c * c * c * ia, -squares * s * s * s * ib
    rx, ry, qx, qy = a * c - ex, b * s - ey, p - ex, q - ey
    ratio = math.sqrt((rx * rx + ry * ry) / (qx * qx + qy * qy + _EPSILON))
    c, s = (qx * ratio + ex) * ia, (qy * ratio + ey) * ib
    c, s = c if c > ZERO else ZERO, s if s > ZERO else ZERO
    k = ONE / math.sqrt(c * c + s * s + _EPSILON)
    c, s = c * k, s * k
    u, v = ga * c, gb * s
    h = (u * (p - a0 * c) + v * (q - b0 * s) + z) / (u * u + v * v + ONE)
    h = h if h > ZERO else ZERO
    h = h if h < length else length
    return c, s, h


@jit
def _polish(p, q, z, c, s, h, a0, b0, ga, gb, length):
    """Newton's method for θ and h, with h clipped to the cylinder."""
    for _ in range(_MAX_ITERATIONS):
        a, b, u, v = a0 + ga * h, b0 + gb * h, ga * c, gb * s
        ep, eq, ez = a * c - p, b * s - q, h - z
        tp, tq = -a * s, b * c  # ∂X/∂θ; ∂X/∂h is (u, v, 1)
        g1, g2 = ep * tp + eq * tq, ep * u + eq * v + ez
        h11 = tp * tp + tq * tq - ep * a * c - eq * b * s
        h12 = tp * u + tq * v - ep * ga * s + eq * gb * c
        h22 = u * u + v * v + 1.0
        at_end = (h <= 0.0 and g2 > 0.0) or (h >= length and g2 < 0.0)
        determinant = h11 * h22 - h12 * h12
        if at_end:
            turn, slide = -g1 / (h11 if h11 > 0.0 else tp * tp + tq * tq + _EPSILON), 0.0
        elif determinant > 1e-9 * (tp * tp + tq * tq) * h22 and h11 > 0.0:
            turn, slide = (h12 * g2 - h22 * g1) / determinant, (h12 * g1 - h11 * g2) / determinant
        else:  # not convex: a gradient step
            turn, slide = -g1 / (tp * tp + tq * tq + abs(h11) + _EPSILON), -g2 / h22
        turn = turn if turn < 0.3 else 0.3
        turn = turn if turn > -0.3 else -0.3
        before = h
        h += slide
        h = h if h > 0.0 else 0.0
        h = h if h < length else length
        c, s = c - s * turn - 0.5 * c * turn * turn, s + c * turn - 0.5 * s * turn * turn
        c, s = c if c > 0.0 else 0.0, s if s > 0.0 else 0.0
        k = 1.0 / math.sqrt(c * c + s * s + _EPSILON)
        c, s = c * k, s * k
        if abs(turn) * (a + b) + abs(h - before) < _MIN_STEP:
            break
    return c, s, h


@jit
def _squared_distance(p, q, z, c, s, h, a0, b0, ga, gb):
    """Squared distance to the surface point at θ and h."""
    x, y = (a0 + ga * h) * c - p, (b0 + gb * h) * s - q
    return x * x + y * y + (h - z) * (h - z)


@jit
def _best_of_many(p, q, z, c, s, h, a0, b0, ga, gb, length):
    """Newton's method from a first guess and four other starts: a steep side may have several local minima."""
    c, s, h = _polish(p, q, z, c, s, h, a0, b0, ga, gb, length)
    least = _squared_distance(p, q, z, c, s, h, a0, b0, ga, gb)
    for k in range(4):
        ck, sk = 0.6 if k < 2 else 0.98 if k == 2 else 0.2, 0.8 if k < 2 else 0.2 if k == 2 else 0.98
        hk = 0.0 if k == 0 else length if k == 1 else 0.5 * length
        ck, sk, hk = _polish(p, q, z, ck, sk, hk, a0, b0, ga, gb, length)
        d = _squared_distance(p, q, z, ck, sk, hk, a0, b0, ga, gb)
        if d < least:
            c, s, h, least = ck, sk, hk, d
    return c, s, h


@jit
def _side(p, q, z, c, s, h, a0, b0, ga, gb, length, out):
    """Signed distance to the side and the outward unit normal (at an edge, the direction from it).

    Also a number above 0 if the point is inside. out: see `_start`.
    """
    np_, nq, nz = c * (b0 + gb * h), s * (a0 + ga * h), -(c * c * ga * (b0 + gb * h) + s * s * gb * (a0 + ga * h))
    k = ONE / math.sqrt(np_ * np_ + nq * nq + nz * nz)
    np_, nq, nz = np_ * k, nq * k, nz * k
    ep, eq, ez = p - (a0 + ga * h) * c, q - (b0 + gb * h) * s, z - h
    d = ep * np_ + eq * nq + ez * nz
    way = math.sqrt(ep * ep + eq * eq + ez * ez)
    room = z if z < length - z else length - z
    room = room if room < ONE - out else ONE - out
    signed = -way if room > ZERO else way
    inverse = ONE / (signed + _EPSILON)
    on = h if h < length - h else length - h  # 0 on an edge
    on = ZERO if way > _MAX_GUESS_OFFSET and d * d < _MIN_COSINE_SQUARE * way * way else on
    on = on if way > _MIN_OFFSET else ONE  # too near for a direction
    d = d if on > ZERO else signed
    np_ = np_ if on > ZERO else ep * inverse
    nq = nq if on > ZERO else eq * inverse
    nz = nz if on > ZERO else ez * inverse
    return d, np_, nq, nz, room


@jit
def _caps(p, q, z, d, np_, nq, nz, room, a0, b0, a1, b1, length):
    """Signed distance and normal of the whole cylinder, caps included, from those of its side."""
    limit = d if room > ZERO else ZERO
    inside = a0 * a0 * b0 * b0 - p * p * (b0 * b0) - q * q * (a0 * a0)
    below = -z if inside > ZERO else -_INFINITY
    inside = a1 * a1 * b1 * b1 - p * p * (b1 * b1) - q * q * (a1 * a1)
    above = z - length if inside > ZERO else -_INFINITY
    cap = below if below > above else above
    sign = -ONE if below > above else ONE
    np_, nq, nz = ZERO if cap >= limit else np_, ZERO if cap >= limit else nq, sign if cap >= limit else nz
    return cap if cap >= limit else d, np_, nq, nz


@jit
def _gather(x, first, count, f, t, best, only, place, buffer):
    """Points of a block near the cylinder's box: indices place (n,), buffer p, q, h; n, origin and directions."""
    ox, oy, oz = moved(f, t[1], t[2], t[3])
    ax, ay, az = turned(f, t[4], t[5], t[6])
    bx, by, bz = turned(f, t[7], t[8], t[9])
    ux, uy, uz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length, a0, b0 = t[13], t[14], t[15]
    a1, b1 = a0 + t[16] * length, b0 + t[17] * length
    wide, deep, half = a0 if a0 > a1 else a1, b0 if b0 > b1 else b1, 0.5 * length
    px, py, pz = x[0, first : first + count], x[1, first : first + count], x[2, first : first + count]
    reach, wanted, s = best[first : first + count], only[first : first + count], int(t[0])
    p, q, h = buffer[0:BLOCK], buffer[BLOCK : 2 * BLOCK], buffer[2 * BLOCK : 3 * BLOCK]
    spare = buffer[3 * BLOCK : 4 * BLOCK]
    for i in range(count):
        dx, dy, dz = px[i] - ox, py[i] - oy, pz[i] - oz
        pi = ax * dx + ay * dy + az * dz
        qi = bx * dx + by * dy + bz * dz
        hi = ux * dx + uy * dy + uz * dz
        ep, eq, eh = abs(pi) - wide, abs(qi) - deep, abs(hi - half) - half
        ep, eq, eh = ep if ep > 0.0 else 0.0, eq if eq > 0.0 else 0.0, eh if eh > 0.0 else 0.0
        room = reach[i] * reach[i] - (ep * ep + eq * eq + eh * eh)
        spare[i] = room if (wanted[i] - s) * (wanted[i] + 1) == 0 else -1.0
        p[i], q[i], h[i] = pi, qi, hi
    n = 0
    for i in range(count):
        place[n] = i
        n += 1 if spare[i] > ZERO else 0
    for k in range(n):  # in place, for k <= place[k]
        i = place[k]
        p[k], q[k], h[k] = p[i], q[i], h[i]
    return n, ox, oy, oz, ax, ay, az, bx, by, bz


@jit
def _guess(t, buffer, n):
    """Approximate closest points of a cylinder t (18,) for n points, in single precision.

    buffer (10 BLOCK,) = p, q, h. Appended: cos θ, sin θ and h of the closest point, signed distance, normal.
    """
    p, q, h = buffer[0:BLOCK], buffer[BLOCK : 2 * BLOCK], buffer[2 * BLOCK : 3 * BLOCK]
    c, s, at = buffer[3 * BLOCK : 4 * BLOCK], buffer[4 * BLOCK : 5 * BLOCK], buffer[5 * BLOCK : 6 * BLOCK]
    d, n0 = buffer[6 * BLOCK : 7 * BLOCK], buffer[7 * BLOCK : 8 * BLOCK]
    n1, n2 = buffer[8 * BLOCK : 9 * BLOCK], buffer[9 * BLOCK : 10 * BLOCK]
    room = d
    length, a0, b0 = np.float32(t[13]), np.float32(t[14]), np.float32(t[15])
    ga, gb = np.float32(t[16]), np.float32(t[17])
    a1, b1 = a0 + ga * length, b0 + gb * length
    flat = a0 / b0 if a0 > b0 else b0 / a0
    end = a1 / b1 if a1 > b1 else b1 / a1
    for k in range(n):
        c[k], s[k], at[k], room[k] = _start(abs(p[k]), abs(q[k]), h[k], a0, b0, ga, gb, length)
    for _ in range(1 if flat < _MAX_ROUND_RATIO and end < _MAX_ROUND_RATIO else 3):
        for k in range(n):
            c[k], s[k], at[k] = _round(abs(p[k]), abs(q[k]), h[k], c[k], s[k], at[k], a0, b0, ga, gb, length)
    for k in range(n):
        u, v, z = abs(p[k]), abs(q[k]), h[k]
        dk, mp, mq, mz, inside = _side(u, v, z, c[k], s[k], at[k], a0, b0, ga, gb, length, room[k])
        d[k], n0[k], n1[k], n2[k] = _caps(u, v, z, dk, mp, mq, mz, inside, a0, b0, a1, b1, length)


@jit
def _place(x, normal, i, mp, mq, mz, ax, ay, az, bx, by, bz):
    """Rotate a cylinder's normal to the world and store it."""
    ux, uy, uz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    normal[0, i] = ax * mp + bx * mq + ux * mz
    normal[1, i] = ay * mp + by * mq + uy * mz
    normal[2, i] = az * mp + bz * mq + uz * mz


@jit
def nearest_on_cylinders(x, frames, table, only, best, normal, segment):
    """Update `best`, `normal`, `segment` where a cylinder is nearer than the present surface, to a fraction of a mm.

    Parameters: x (3, N) [m] in the world; frames (S, 12); table (C, 18) of `SurfaceTables`; only (N,) the segment that
    a point may belong to, -1 for any; best (N,) signed distance [m]; normal (3, N) outward at the closest point, which
    is x - best * normal; segment (N,).
    """
    place, buffer = np.empty(BLOCK, np.int64), np.empty(10 * BLOCK, np.float32)
    for first in range(0, x.shape[1], BLOCK):
        count = x.shape[1] - first
        count = count if count < BLOCK else BLOCK
        for line in range(table.shape[0]):
            t = table[line]
            owner = int(t[0])
            n, _, _, _, ax, ay, az, bx, by, bz = _gather(
                x, first, count, frames[owner], t, best, only, place, buffer
            )
            _guess(t, buffer, n)
            for k in range(n):
                i, d = first + place[k], buffer[6 * BLOCK + k]
                if abs(d) < abs(best[i]):
                    mp, mq, mz = buffer[7 * BLOCK + k], buffer[8 * BLOCK + k], buffer[9 * BLOCK + k]
                    mp, mq = mp if buffer[k] >= ZERO else -mp, mq if buffer[BLOCK + k] >= ZERO else -mq
                    best[i], segment[i] = d, owner
                    _place(x, normal, i, mp, mq, mz, ax, ay, az, bx, by, bz)


@jit
def nearest_on_cylinders_exact(x, frames, table, only, best, normal, segment):
    """As `nearest_on_cylinders`, to 1e-4 mm."""
    place, buffer = np.empty(BLOCK, np.int64), np.empty(10 * BLOCK, np.float32)
    for first in range(0, x.shape[1], BLOCK):
        count = x.shape[1] - first
        count = count if count < BLOCK else BLOCK
        for line in range(table.shape[0]):
            t = table[line]
            owner = int(t[0])
            n, ox, oy, oz, ax, ay, az, bx, by, bz = _gather(
                x, first, count, frames[owner], t, best, only, place, buffer
            )
            _guess(t, buffer, n)
            length, a0, b0, ga, gb = t[13], t[14], t[15], t[16], t[17]
            a1, b1 = a0 + ga * length, b0 + gb * length
            ux, uy, uz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            steep = abs(ga) > _MAX_SLOPE or abs(gb) > _MAX_SLOPE
            for k in range(n):
                i = first + place[k]
                if abs(buffer[6 * BLOCK + k]) > abs(best[i]) + _SKIP_MARGIN and not steep:
                    continue
                dx, dy, dz = x[0, i] - ox, x[1, i] - oy, x[2, i] - oz
                p, q, z = ax * dx + ay * dy + az * dz, bx * dx + by * dy + bz * dz, ux * dx + uy * dy + uz * dz
                u, v = abs(p), abs(q)
                c, s = np.float64(buffer[3 * BLOCK + k]), np.float64(buffer[4 * BLOCK + k])
                h = np.float64(buffer[5 * BLOCK + k])
                if steep:
                    c, s, h = _best_of_many(u, v, z, c, s, h, a0, b0, ga, gb, length)
                else:
                    c, s, h = _polish(u, v, z, c, s, h, a0, b0, ga, gb, length)
                height = z if z > 0.0 else 0.0
                height = height if height < length else length
                a, b = a0 + ga * height, b0 + gb * height
                out = u * u / (a * a) + v * v / (b * b)
                d, mp, mq, mz, room = _side(u, v, z, c, s, h, a0, b0, ga, gb, length, out)
                d, mp, mq, mz = _caps(u, v, z, d, mp, mq, mz, room, a0, b0, a1, b1, length)
                if abs(d) < abs(best[i]):
                    mp, mq = mp if p >= 0.0 else -mp, mq if q >= 0.0 else -mq
                    best[i], segment[i] = d, owner
                    _place(x, normal, i, mp, mq, mz, ax, ay, az, bx, by, bz)
