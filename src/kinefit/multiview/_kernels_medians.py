"""Medians of many short rows: of a few numbers each, a library takes a thousand times longer than sorting them."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian

_NOWHERE = 1e6  # [px] of a point that the camera cannot see
_FEWEST = 3  # points in common, below which nothing is said


@jit
def median(values, room):
    """Median of what is finite of values (k,), NaN where nothing is; room (k,) to sort in."""
    count = 0
    for i in range(values.size):
        v = values[i]
        if abs(v) < math.inf:
            k = count
            while k > 0 and room[k - 1] > v:
                room[k] = room[k - 1]
                k -= 1
            room[k] = v
            count += 1
    half = count // 2
    if count == 0:
        return math.nan
    return room[half] if count % 2 else 0.5 * (room[half - 1] + room[half])


@jit
def medians(values, room, out):
    """out (N,): medians of rows (N, k), see `median`."""
    for n in range(values.shape[0]):
        out[n] = median(values[n], room)


@jit
def distances(camera, x, uv, out):
    """out (T, P): how far people x (T, k, 3) are from detections uv (P, k, 2) in a camera, see `people.distances`."""
    away, room = np.empty(x.shape[1]), np.empty(x.shape[1])
    for t in range(x.shape[0]):
        for p in range(uv.shape[0]):
            count, low, high = 0, math.inf, -math.inf
            for k in range(x.shape[1]):
                away[k] = math.nan
                a, b = uv[p, k, 0], uv[p, k, 1]
                if abs(a + b) < math.inf and abs(x[t, k, 0] + x[t, k, 1] + x[t, k, 2]) < math.inf:
                    seen = project_jacobian(camera, x[t, k, 0], x[t, k, 1], x[t, k, 2])
                    away[k] = math.sqrt((seen[1] - a) ** 2 + (seen[2] - b) ** 2) if seen[0] else _NOWHERE
                    low, high = b if b < low else low, b if b > high else high
                    count += 1
            size = high - low if high - low > 1.0 else 1.0
            out[t, p] = math.inf if count < _FEWEST else median(away, room) / size
