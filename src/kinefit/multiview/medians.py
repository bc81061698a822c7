"""Medians of what was seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.multiview import _kernels_medians


def medians(values: NDArray) -> NDArray:
    """(...) medians along the last axis of values (..., k) that are finite; NaN where none is."""
    rows = np.ascontiguousarray(values, float).reshape(-1, values.shape[-1])
    out = np.empty(len(rows))
    _kernels_medians.medians(rows, np.empty(rows.shape[1]), out)
    return out.reshape(values.shape[:-1])


def distances(camera: Camera, x_world: NDArray, uv: NDArray) -> NDArray:
    """(T, P) median distance of people (T, k, 3) [m] from detections (P, k, 2) [px] in a camera, over their heights.

    Infinite where fewer than three points are finite in both.
    """
    x, seen = np.ascontiguousarray(x_world, float), np.ascontiguousarray(uv, float)
    out = np.empty((len(x), len(seen)))
    _kernels_medians.distances(camera.packed, x, seen, out)
    return out
