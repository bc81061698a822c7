"""Medians of many short rows by sorting, a thousand times faster than a library call per row."""

from __future__ import annotations

import math

import numpy as np

from kinefit._jit import jit
from kinefit.geometry._kernels_camera import project_jacobian

_INVISIBLE_PX = 1e6  # of a point outside of the camera's view
_MIN_COMMON_POINTS = 3  # of a person and a detection, else their distance is infinite


@jit
def median(values, room):
    """Median of the finite values (k,); NaN without any. room: scratch (k,)."""
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
    """Write to out (N,) the medians of rows (N, k), see `median`."""
    for n in range(values.shape[0]):
        out[n] = median(values[n], room)


@jit
def distances(camera, x, uv, out):
    """Write to out (T, P) the distances of people x (T, k, 3) from detections uv (P, k, 2), see `medians.distances`."""
    error, room = np.empty(x.shape[1]), np.empty(x.shape[1])
    for t in range(x.shape[0]):
        for p in range(uv.shape[0]):
            count, low, high = 0, math.inf, -math.inf
            for k in range(x.shape[1]):
                error[k] = math.nan
                a, b = uv[p, k, 0], uv[p, k, 1]
                if abs(a + b) < math.inf and abs(x[t, k, 0] + x[t, k, 1] + x[t, k, 2]) < math.inf:
                    pixel = project_jacobian(camera, x[t, k, 0], x[t, k, 1], x[t, k, 2])
                    error[k] = math.sqrt((pixel[1] - a) ** 2 + (pixel[2] - b) ** 2) if pixel[0] else _INVISIBLE_PX
                    low, high = b if b < low else low, b if b > high else high
                    count += 1
            size = high - low if high - low > 1.0 else 1.0
            out[t, p] = math.inf if count < _MIN_COMMON_POINTS else median(error, room) / size
