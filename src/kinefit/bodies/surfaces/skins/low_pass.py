"""Low-pass approximations of a triangle mesh: what a Fourier series without high ones is to a surface (P1 2.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_DOWN, _UP = 0.5, -0.525  # Taubin's λ and μ: frequencies below 1/λ + 1/μ = 0.095 of the mesh's highest stay


def low_pass(vertices: NDArray, faces: NDArray, passes: int) -> NDArray:
    """(V, 3) [m] vertices without the high frequencies of the mesh; the more passes, the steeper the filter.

    Taubin, A signal processing approach to fair surface design (SIGGRAPH 1995): eigenvectors of the mesh's Laplacian
    are its frequencies, and alternating steps of positive and negative weight keep the low ones, so that nothing
    shrinks.

    Parameters
    ----------
    vertices : (V, 3) [m]
    faces : (T, 3) int
    passes : int; 0 leaves the mesh as it is.
    """
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    a, b = edges.T
    count = np.maximum(np.bincount(a, minlength=len(vertices)) + np.bincount(b, minlength=len(vertices)), 1)[:, None]
    x = np.array(vertices, float)
    for k in range(2 * passes):
        total = np.zeros_like(x)
        for axis in range(3):
            total[:, axis] = np.bincount(a, x[b, axis], len(x)) + np.bincount(b, x[a, axis], len(x))
        x += (_UP if k % 2 else _DOWN) * np.where(count > 0, total / count - x, 0.0)
    return x
