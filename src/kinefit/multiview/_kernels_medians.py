"""Medians of many short rows: of a few numbers each, a library takes a thousand times longer than sorting them."""

from __future__ import annotations

import math

from kinefit._jit import jit


@jit
def medians(values, room, out):
    """out (N,): medians of rows (N, k) without what is not finite, NaN where nothing is; room (k,) to sort in."""
    for n in range(values.shape[0]):
        count = 0
        for i in range(values.shape[1]):
            v = values[n, i]
            if abs(v) < math.inf:
                k = count
                while k > 0 and room[k - 1] > v:
                    room[k] = room[k - 1]
                    k -= 1
                room[k] = v
                count += 1
        half = count // 2
        if count == 0:
            out[n] = math.nan
        elif count % 2:
            out[n] = room[half]
        else:
            out[n] = 0.5 * (room[half - 1] + room[half])
