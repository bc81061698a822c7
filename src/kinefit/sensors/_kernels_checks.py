"""Check of rows in one pass."""

from __future__ import annotations

import math

from kinefit._jit import jit


@jit
def sound(data, segment, count):
    """Whether data (8, N) are finite, weights at least 0 and segments (N,) below `count`."""
    total, good = 0.0, True
    for q in range(8):
        line = data[q]
        for i in range(line.size):
            total += line[i]
    for i in range(segment.size):
        good = good and data[7, i] >= 0.0 and 0 <= segment[i] < count
    return good and abs(total) < math.inf
