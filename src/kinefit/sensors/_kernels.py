"""Checks of rows, and levers of observed points, each in one pass."""

from __future__ import annotations

import math

from kinefit._jit import jit
from kinefit.geometry._kernels_frames import moved


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


@jit
def longest_levers(frames, screws, segments, rest, seen, root, last_dof, dof_parent, out):
    """Write to out (D,) [m/rad] the longest lever of each coordinate on an observed point; seen (K,) bool."""
    out[:] = 0.0
    for k in range(segments.size):
        if seen[k]:
            x, y, z = moved(frames[segments[k]], rest[k, 0], rest[k, 1], rest[k, 2])
            x, y, z = x - root[0, 3], y - root[1, 3], z - root[2, 3]
            d = last_dof[segments[k]]
            while d >= 6:
                t = screws[d - 6]
                a = t[0] + t[4] * z - t[5] * y
                b = t[1] + t[5] * x - t[3] * z
                c = t[2] + t[3] * y - t[4] * x
                far = a * a + b * b + c * c
                if far > out[d - 6]:
                    out[d - 6] = far
                d = dof_parent[d]
    for d in range(out.size):
        out[d] = math.sqrt(out[d])
