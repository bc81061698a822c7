"""Block band Cholesky factor of a whole take: frames along the diagonal, each coupled to the next three.

The system of T frames with n unknowns each is given as packed blocks C (T, n, m) on its diagonal (pattern of chain and
depth, see `_kernels_linear`) and sparse blocks band (4, T, n, 3): line i of band[l, t] couples unknown i of frame t + l
to unknowns first[i] .. first[i] + width[i] - 1 of frame t.

The factor L has dense blocks. It is stored as W_t = L_tt⁻ᵀ (p, p), an upper triangle, and as below_t (3 p, p), the
blocks L_{t+1,t}, L_{t+2,t}, L_{t+3,t}; p is n rounded up to a multiple of four, so that loops go four lines at a time.
"""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit


@jit
def _add_product(out, i, sign, a, row, start, stop, B, high):
    """out[i:i+4, :high] += sign a[row:row+4, start:stop] B[start:stop, :high]; start and stop divide by four."""
    o0, o1, o2, o3 = out[i, :high], out[i + 1, :high], out[i + 2, :high], out[i + 3, :high]
    p, q, r, s = a[row], a[row + 1], a[row + 2], a[row + 3]
    for k in range(start, stop, 4):
        b0, b1, b2, b3 = B[k, :high], B[k + 1, :high], B[k + 2, :high], B[k + 3, :high]
        p0, p1, p2, p3 = sign * p[k], sign * p[k + 1], sign * p[k + 2], sign * p[k + 3]
        q0, q1, q2, q3 = sign * q[k], sign * q[k + 1], sign * q[k + 2], sign * q[k + 3]
        r0, r1, r2, r3 = sign * r[k], sign * r[k + 1], sign * r[k + 2], sign * r[k + 3]
        s0, s1, s2, s3 = sign * s[k], sign * s[k + 1], sign * s[k + 2], sign * s[k + 3]
        for j in range(high):
            w, x, y, z = b0[j], b1[j], b2[j], b3[j]
            o0[j] += p0 * w + p1 * x + p2 * y + p3 * z
            o1[j] += q0 * w + q1 * x + q2 * y + q3 * z
            o2[j] += r0 * w + r1 * x + r2 * y + r3 * z
            o3[j] += s0 * w + s1 * x + s2 * y + s3 * z


@jit
def product(A, B, out):
    """out = A B of small matrices, without threads; the rows and the inner dimension are multiples of four."""
    out[:] = 0.0
    for i in range(0, A.shape[0], 4):
        _add_product(out, i, 1.0, A, i, 0, B.shape[0], B, B.shape[1])


@jit
def _invert_root(A, W):
    """W = L⁻ᵀ (upper triangle, zeros below) of A = L Lᵀ (lower triangle, destroyed). False if not positive."""
    n = W.shape[0]
    for k in range(0, n, 4):  # Lᵀ into W, four columns of L as four lines
        for r in range(4):
            for i in range(k + r, n):
                W[k + r, i] = A[i, k + r]
        for r in range(k, k + 4):
            if not W[r, r] > 0.0:
                return False
            inverse, line = 1.0 / math.sqrt(W[r, r]), W[r, k:]
            for j in range(n - k):
                line[j] *= inverse
            for s in range(r + 1, k + 4):
                h, other = line[s - k], W[s, k:]
                for j in range(n - k):
                    other[j] -= h * line[j]
        l0, l1, l2, l3 = W[k, k + 4 :], W[k + 1, k + 4 :], W[k + 2, k + 4 :], W[k + 3, k + 4 :]
        for i in range(n - k - 4):
            line = A[k + 4 + i, k + 4 :]
            h0, h1, h2, h3 = l0[i], l1[i], l2[i], l3[i]
            for j in range(i + 1):
                line[j] -= h0 * l0[j] + h1 * l1[j] + h2 * l2[j] + h3 * l3[j]
    for i in range(n):  # L⁻¹ line by line into A
        line, inverse = A[i, : i + 1], 1.0 / W[i, i]
        line[:] = 0.0
        line[i] = inverse
        for k in range(0, i - i % 4, 4):
            h0, h1, h2, h3 = W[k, i] * inverse, W[k + 1, i] * inverse, W[k + 2, i] * inverse, W[k + 3, i] * inverse
            a0, a1, a2, a3 = A[k, : k + 4], A[k + 1, : k + 4], A[k + 2, : k + 4], A[k + 3, : k + 4]
            for j in range(k + 4):
                line[j] -= h0 * a0[j] + h1 * a1[j] + h2 * a2[j] + h3 * a3[j]
        for k in range(i - i % 4, i):
            h, source = W[k, i] * inverse, A[k]
            for j in range(k + 1):
                line[j] -= h * source[j]
        for j in range(i + 1, i - i % 4 + 4):
            A[i, j] = 0.0  # read above as a line of four
    for i in range(n):
        W[i, :i] = 0.0
        for j in range(i + 1):
            W[j, i] = A[i, j]
    return True


@jit
def _forward(W, S, t, x):
    """Solve frame t of L z = x in place, and take it out of the next three; S (3 p, p) are the blocks below."""
    T, p = x.shape
    z = np.zeros(p)
    for i in range(p):
        h = x[t, i]
        for j in range(p):
            z[j] += h * W[i, j]
    x[t] = z
    for ahead in range(1, min(4, T - t)):
        for i in range(p):
            v, line = 0.0, S[(ahead - 1) * p + i]
            for j in range(p):
                v += line[j] * z[j]
            x[t + ahead, i] -= v


@jit
def factor_band(C, chain, depth, band, first, width, damping, start, W, below, x):
    """Factor the system, `damping` added to its diagonal, into W (T, p, p) and below (T, 3 p, p), and solve L z = x.

    start (3 p, 3 p), of which the lower triangle is read, is added to the first three frames; zeros where T < 3.
    x (T, p) is solved in place on the way, while the factor is at hand. False if the system is not positive.
    """
    T, n, p = C.shape[0], C.shape[1], W.shape[1]
    Z, ST = start.copy(), np.empty((p, 3 * p))
    for t in range(T):
        S = below[t]
        for k in range(n):
            for i in range(depth[k] + 1):
                Z[k, chain[k, i]] += C[t, k, i]
            for b in range(width[k]):
                Z[k, first[k] + b] += band[0, t, k, b]
                Z[p + k, first[k] + b] += band[1, t, k, b]
                Z[2 * p + k, first[k] + b] += band[2, t, k, b]
            Z[k, k] += damping
        for k in range(n, p):
            Z[k, k] = 1.0
        if not _invert_root(Z, W[t]):
            return False
        S[:] = 0.0
        for i in range(0, 2 * p, 4):
            _add_product(S, i, 1.0, Z, i + p, 0, p, W[t], p)
        for i in range(n):
            line = S[2 * p + i]
            for b in range(width[i]):
                h, source = band[3, t, i, b], W[t, first[i] + b]
                for j in range(p):
                    line[j] += h * source[j]
        _forward(W[t], S, t, x)
        for i in range(3 * p):
            for j in range(p):
                ST[j, i] = S[i, j]
        for i in range(2 * p):
            for j in range(2 * p):
                Z[i, j] = Z[p + i, p + j]
        Z[2 * p :] = 0.0
        for i in range(0, 3 * p, 4):
            start = 0 if i < 2 * p else 4 * ((i - 2 * p) // 4 - 1)  # the last block has nothing left of its diagonal
            _add_product(Z, i, -1.0, S, i, max(start, 0), p, ST, i + 4)
    return True


@jit
def back_substitute(W, below, x):
    """Solve Lᵀ y = x in place, x (T, p) as `factor_band` leaves it."""
    T, p = x.shape
    z = np.empty(p)
    for t in range(T - 1, -1, -1):
        for ahead in range(1, min(4, T - t)):
            for i in range(p):
                h, line = x[t + ahead, i], below[t, (ahead - 1) * p + i]
                for j in range(p):
                    x[t, j] -= h * line[j]
        for i in range(p):
            v = 0.0
            for j in range(p):
                v += W[t, i, j] * x[t, j]
            z[i] = v
        x[t] = z


@jit
def covariance_blocks(W, below, past, since, frames, following, variance):
    """Blocks of the inverse of a factored system, from its last frame back to frame `since`.

    frames (T, n, n) are the covariances of single frames, following (T - 1, n, n) those of each frame's successor
    (rows) with it (columns), variance (T - 1, n) those of the changes r_s that past (T - 1, 2) defines.
    """
    T, p, n = W.shape[0], W.shape[1], frames.shape[1]
    ahead, next_ahead = np.zeros((3 * p, 3 * p)), np.zeros((3 * p, 3 * p))  # covariance of frames t + 1 .. t + 3
    WT, fall, cross, own = np.empty((p, p)), np.empty((3 * p, p)), np.empty((3 * p, p)), np.empty((p, p))
    both, line, part = np.empty((4 * p, p)), np.empty((p, 4 * p)), np.empty(4)
    for t in range(T - 1, since - 1, -1):
        for i in range(p):
            for j in range(p):
                both[i, j] = WT[i, j] = W[t, j, i]
                line[i, j] = W[t, i, j]
        product(below[t], WT, fall)
        product(ahead, fall, cross)
        for i in range(3 * p):
            for j in range(p):
                both[p + i, j] = -cross[i, j]
                line[j, p + i] = -fall[i, j]
        product(line, both, own)
        for i in range(2 * p):
            for j in range(2 * p):
                next_ahead[p + i, p + j] = ahead[i, j]
            for j in range(p):
                next_ahead[p + i, j] = next_ahead[j, p + i] = -cross[i, j]
        for i in range(p):
            for j in range(p):
                next_ahead[i, j] = 0.5 * (own[i, j] + own[j, i])
        for i in range(n):
            for j in range(n):
                frames[t, i, j] = next_ahead[i, j]
                if t + 1 < T:
                    following[t, i, j] = -cross[i, j]
        for change in range(t + 2 if t > 0 else 0, min(t + 3, T - 1)):
            back = min(change, 2)
            part[:] = 0.0
            part[1 + back], part[back] = 1.0, -1.0
            for i in range(back):
                part[back - i] -= past[change, i]
                part[back - 1 - i] += past[change, i]
            for k in range(n):
                total = part[0] * part[0] * next_ahead[k, k]
                for a in range(1, 4):
                    total -= 2.0 * part[0] * part[a] * cross[(a - 1) * p + k, k]
                    for b in range(1, 4):
                        total += part[a] * part[b] * ahead[(a - 1) * p + k, (b - 1) * p + k]
                variance[change, k] = max(total, 0.0)
        ahead, next_ahead = next_ahead, ahead
