"""Compiled robust losses: ρ and its derivative, for single residuals and for groups of rows."""

from __future__ import annotations

import math

from kinefit._jit import jit

NO_LOSS, HUBER, TUKEY, GEMAN_MCCLURE = 0, 1, 2, 3


@jit
def robust(kind, scale, s2):
    """ρ(s²) and its derivative, the weight, of a squared residual [variances]."""
    if kind == HUBER:
        if s2 <= scale * scale:
            return s2, 1.0
        s = math.sqrt(s2)
        return 2.0 * scale * s - scale * scale, scale / s
    if kind == TUKEY:
        c2 = scale * scale
        if s2 >= c2:
            return c2 / 3.0, 0.0
        u = 1.0 - s2 / c2
        return c2 / 3.0 * (1.0 - u * u * u), u * u
    if kind == GEMAN_MCCLURE:
        u = 1.0 / (1.0 + s2 / (scale * scale))
        return s2 * u, u * u
    return s2, 1.0


@jit
def robust_all(kind, scale, s2, rho, factor):
    """Write ρ and robust weights (N,) of squared residuals s2 (N,) [variances], each with its own scale (N,)."""
    for i in range(s2.size):
        rho[i], factor[i] = robust(kind, scale[i], s2[i])


@jit
def weigh(data, group, count, kind, scale, factor):
    """Write the robust weight of every row, shared by the rows of one measurement; returns the cost Σ ρ(w r²)."""
    cost = 0.0
    if kind == NO_LOSS:
        for i in range(count):
            factor[i] = 1.0
            cost += data[7, i] * data[6, i] * data[6, i]
        return cost
    i = 0
    while i < count:
        j, s2 = i, 0.0
        while j < count and (j == i or (group[j] == group[i] and group[i] >= 0)):
            s2 += data[7, j] * data[6, j] * data[6, j]
            j += 1
        rho, weight = robust(kind, scale, s2) if group[i] >= 0 else (s2, 1.0)
        cost += rho
        for k in range(i, j):
            factor[k] = weight
        i = j
    return cost
