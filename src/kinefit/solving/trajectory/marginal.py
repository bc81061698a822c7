"""Marginalise the oldest frames of a sliding window: they become a quadratic cost of its first three frames.

The motion prior couples a frame to the next three. So earlier frames affect later ones only through three frames, and
eliminating one more frame (a Schur complement) leaves a cost of the next three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.solving.equations import inverse
from kinefit.solving.trajectory import _kernels_band, _kernels_smoothing


@dataclass(frozen=True, eq=False)
class Entering:
    """Quadratic cost − 2 gᵀδ + δᵀHδ of three consecutive frames, from marginalised earlier ones.

    Parameters
    ----------
    roots, angles : (3, 4, 4), (3, D) states from which δ counts
    H, g : (3 n, 3 n), (3 n,)
    H_covariance : (3 n, 3 n) H for covariances, with `MotionPrior.posture_share` of the posture prior
    """

    roots: NDArray
    angles: NDArray
    H: NDArray
    g: NDArray
    H_covariance: NDArray

    def moved(self, roots: NDArray, angles: NDArray) -> NDArray:
        """δ (3 n,) to three other states (3, 4, 4), (3, D)."""
        out = np.empty((3, len(self.g) // 3))
        _kernels_smoothing.differences(self.roots, roots, self.angles, angles, out)
        return out.ravel()

    def add(self, roots: NDArray, angles: NDArray, g: NDArray) -> float:
        """Add the gradient at the first three of T states to g (T, n); returns the cost (a number)."""
        delta = self.moved(np.ascontiguousarray(roots[:3]), np.ascontiguousarray(angles[:3]))
        pull = self.H @ delta
        g[:3] += (self.g - pull).reshape(3, -1)
        return float(delta @ pull - 2.0 * self.g @ delta)


def padded(n: int) -> int:
    """Size of the blocks in which `factor_band` has n unknowns (int): a multiple of four."""
    return 4 * -(-n // 4)


def start_of(
    entering: Entering | None, n: int, held: NDArray | None = None, *, covariance: bool = False
) -> NDArray:
    """H (3 p, 3 p) for `factor_band`, with n of p unknowns in each frame, without `held` (3, n) bool."""
    p = padded(n)
    out = np.zeros((3, p, 3, p))
    if entering is not None:
        H = np.array(entering.H_covariance if covariance else entering.H)
        if held is not None and held.any():
            H[held.ravel()] = 0.0
            H[:, held.ravel()] = 0.0
        out[:, :n, :, :n] = H.reshape(3, n, 3, n)
    return out.reshape(3 * p, 3 * p)


def blocks(body: Body) -> tuple[NDArray, NDArray]:
    """First column (n,) and width (n,) of each row of a block of the prior: 3 for the root's rotation, else 1."""
    first, width = np.arange(body.tree.n_dofs), np.ones(body.tree.n_dofs, np.int64)
    first[3:6], width[3:6] = 3, 3
    return first, width


def leave(
    body: Body, states: tuple[NDArray, NDArray], H: NDArray, g: NDArray, posture: NDArray, held: NDArray,
    motion: tuple[NDArray, NDArray], entering: Entering | None,
) -> Entering:  # fmt: skip
    """Marginalise the first of four frames; returns the cost of the other three.

    Parameters
    ----------
    states : roots (4, 4, 4) and angles (4, D)
    H, g : (n, n), (n,) of the first frame's measurements and posture prior
    posture : (n, n) weight of the posture prior in a covariance minus that in the fit
    held : (n,) bool, degrees of freedom of the first frame at a limit
    motion : past (3, 2) and weight (3, n) of the three steps, see `MotionPrior.rows`
    entering : cost of the first three frames from earlier ones; it contains the prior of the first two steps
    """
    n, (roots, angles), (past, weight) = len(g), states, motion
    weight = np.array(weight)
    A, b = np.zeros((4, n, 4, n)), np.zeros((4, n))
    if entering is not None:
        weight[:2] = 0.0
        delta = entering.moved(roots[:3], angles[:3])
        A[:3, :, :3] = entering.H.reshape(3, n, 3, n)
        b[:3] = (entering.g - entering.H @ delta).reshape(3, n)
    A[0, :, 0] += H
    b[0] += g
    steps, band = np.empty((3, n)), np.zeros((4, 4, n, 3))
    _kernels_smoothing.velocities(roots, angles, steps)
    _kernels_smoothing.add_motion(steps, np.ascontiguousarray(past), weight, *blocks(body), band, b)
    A += _unpacked(band, *blocks(body))
    A_covariance = np.array(A)
    if entering is not None:
        A_covariance[:3, :, :3] += (entering.H_covariance - entering.H).reshape(3, n, 3, n)
    A_covariance[0, :, 0] += posture
    A[0, held], b[0, held] = 0.0, 0.0
    A[:, :, 0, held] = 0.0
    A[0, held, 0, held] = 1.0
    H_marginal, g_marginal = _schur(A.reshape(4 * n, 4 * n), b.ravel(), n)
    H_covariance, _ = _schur(A_covariance.reshape(4 * n, 4 * n), b.ravel(), n)
    return Entering(np.array(roots[1:]), np.array(angles[1:]), H_marginal, g_marginal, H_covariance)


def _unpacked(band: NDArray, first: NDArray, width: NDArray) -> NDArray:
    """Dense (T, n, T, n) from blocks (4, T, n, 3) between frames, see `_kernels_band`."""
    T, n = band.shape[1:3]
    out = np.zeros((T, n, T, n))
    for i in range(n):
        for k in range(width[i]):
            j = first[i] + k
            for ahead in range(4):
                for t in range(T - ahead):
                    out[t + ahead, i, t, j] = band[ahead, t, i, k]
                    out[t, j, t + ahead, i] = band[ahead, t, i, k]
    return out


def _schur(A: NDArray, b: NDArray, n: int) -> tuple[NDArray, NDArray]:
    """Schur complement of A (4 n, 4 n), b (4 n,) without the first n unknowns: (3 n, 3 n), (3 n,)."""
    p = padded(n)
    alone = np.zeros((p, p))
    alone[:n, :n] = inverse(A[:n, :n] + 1e-12 * np.trace(A) / len(A) * np.eye(n))
    below, fall, removed = np.zeros((3 * p, p)), np.empty((3 * p, p)), np.empty((3 * p, 3 * n))
    below[: 3 * n, :n] = A[n:, :n]
    _kernels_band.product(below, alone, fall)
    _kernels_band.product(fall, np.ascontiguousarray(below[: 3 * n].T), removed)
    schur = A[n:, n:] - removed[: 3 * n]
    return 0.5 * (schur + schur.T), b[n:] - fall[: 3 * n, :n] @ b[:n]
