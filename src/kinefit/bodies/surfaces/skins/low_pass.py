"""Low-pass filter of a triangle mesh: the counterpart of a truncated Fourier series (P1 2.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LAMBDA, _MU = 0.5, -0.525  # of Taubin: frequencies below 1/λ + 1/μ = 0.095 of the mesh's highest pass


def low_pass(vertices: NDArray, faces: NDArray, passes: int) -> NDArray:
    """Remove the high frequencies of a mesh: vertices (V, 3) [m]; more passes make a steeper filter.

    Source: Taubin, A signal processing approach to fair surface design (SIGGRAPH 1995). Eigenvectors of the mesh's
    Laplacian are its frequencies; alternating steps of positive and negative weight keep the low ones without
    shrinking.

    Parameters
    ----------
    vertices : (V, 3) [m]
    faces : (T, 3) int
    passes : int; 0 returns the mesh unchanged.
    """
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    a, b = edges.T
    count = np.maximum(np.bincount(a, minlength=len(vertices)) + np.bincount(b, minlength=len(vertices)), 1)[:, None]
    x = np.array(vertices, float)
    for k in range(2 * passes):
        total = np.zeros_like(x)
        for axis in range(3):
            total[:, axis] = np.bincount(a, x[b, axis], len(x)) + np.bincount(b, x[a, axis], len(x))
        x += (_MU if k % 2 else _LAMBDA) * np.where(count > 0, total / count - x, 0.0)
    return x
