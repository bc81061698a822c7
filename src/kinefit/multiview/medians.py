"""Medians of what was seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.multiview import _kernels_medians


def medians(values: NDArray) -> NDArray:
    """(...) medians along the last axis of values (..., k) that are finite; NaN where none is."""
    rows = np.ascontiguousarray(values, float).reshape(-1, values.shape[-1])
    out = np.empty(len(rows))
    _kernels_medians.medians(rows, np.empty(rows.shape[1]), out)
    return out.reshape(values.shape[:-1])
