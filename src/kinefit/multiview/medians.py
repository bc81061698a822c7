"""Medians of finite values, and image heights and median distances of people and detections."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera
from kinefit.multiview import _kernels_medians


def medians(values: NDArray) -> NDArray:
    """(...) medians of the finite values (..., k) along the last axis; NaN where none is finite."""
    rows = np.ascontiguousarray(values, float).reshape(-1, values.shape[-1])
    out = np.empty(len(rows))
    _kernels_medians.medians(rows, np.empty(rows.shape[1]), out)
    return out.reshape(values.shape[:-1])


def heights(uv: NDArray) -> NDArray:
    """(...) heights [px] in the image of people with points (..., K, 2) [px]; NaN without any finite point."""
    return np.fmax.reduce(uv[..., 1], axis=-1) - np.fmin.reduce(uv[..., 1], axis=-1)


def distances(camera: Camera, x_world: NDArray, uv: NDArray) -> NDArray:
    """(T, P) median image distance of people (T, k, 3) [m] from detections (P, k, 2) [px], relative to their heights.

    Infinite with fewer than three common points.
    """
    x, detections = np.ascontiguousarray(x_world, float), np.ascontiguousarray(uv, float)
    out = np.empty((len(x), len(detections)))
    _kernels_medians.distances(camera.packed, x, detections, out)
    return out
