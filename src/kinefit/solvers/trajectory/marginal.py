"""What a window of frames keeps of the frames that left it: a quadratic cost of its first three.

The motion prior couples a frame to the next three. So all that is behind a frame tells of what is ahead only through
three frames; taking one more frame out of the equations (a Schur complement) leaves a cost of the next three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.solvers.equations import inverse
from kinefit.solvers.trajectory import _kernels_band, _kernels_smoothing


@dataclass(frozen=True, eq=False)
class Entering:
    """A cost c − 2 gᵀδ + δᵀHδ of three consecutive frames, without its constant.

    Parameters
    ----------
    roots, angles : (3, 4, 4), (3, D) about which
    H, g : (3 n, 3 n), (3 n,)
    H_covariance : (3 n, 3 n) the same with the posture prior's share in a covariance, see `MotionPrior.posture_share`
    """

    roots: NDArray
    angles: NDArray
    H: NDArray
    g: NDArray
    H_covariance: NDArray

    def moved(self, roots: NDArray, angles: NDArray) -> NDArray:
        """(3 n,) from where it stands to three other states."""
        out = np.empty((3, len(self.g) // 3))
        _kernels_smoothing.differences(self.roots, roots, self.angles, angles, out)
        return out.ravel()

    def add(self, roots: NDArray, angles: NDArray, g: NDArray) -> float:
        """Add its gradient at the first three of some states to g (T, n); returns its cost."""
        delta = self.moved(np.ascontiguousarray(roots[:3]), np.ascontiguousarray(angles[:3]))
        pull = self.H @ delta
        g[:3] += (self.g - pull).reshape(3, -1)
        return float(delta @ pull - 2.0 * self.g @ delta)


def start_of(
    entering: Entering | None, n: int, p: int, held: NDArray | None = None, *, covariance: bool = False
) -> NDArray:
    """(3 p, 3 p) as `factor_band` takes it, for n of p unknowns a frame; `held` (3, n) bool are taken out."""
    out = np.zeros((3, p, 3, p))
    if entering is not None:
        H = np.array(entering.H_covariance if covariance else entering.H)
        if held is not None and held.any():
            H[held.ravel()] = 0.0
            H[:, held.ravel()] = 0.0
        out[:, :n, :, :n] = H.reshape(3, n, 3, n)
    return out.reshape(3 * p, 3 * p)


def blocks(body: Body) -> tuple[NDArray, NDArray]:
    """First column (n,) and width (n,) of each line of a block of the prior: the root's turn is one of three."""
    first, width = np.arange(body.tree.n_dofs), np.ones(body.tree.n_dofs, np.int64)
    first[3:6], width[3:6] = 3, 3
    return first, width


def leave(
    body: Body, states: tuple[NDArray, NDArray], H: NDArray, g: NDArray, posture: NDArray, held: NDArray,
    motion: tuple[NDArray, NDArray], entering: Entering | None,
) -> Entering:  # fmt: skip
    """Take the first of four frames out of the equations.

    Parameters
    ----------
    states : roots (4, 4, 4) and angles (4, D)
    H, g : (n, n), (n,) of all that the first frame measured, posture prior included
    posture : (n, n) what the posture prior's weight in a covariance is more than in the fit
    held : (n,) bool, degrees of freedom of the first frame that stand at a limit
    motion : past (3, 2) and weight (3, n) of the three steps between them, see `MotionPrior.rows`
    entering : what the first three frames bring along; the first two steps are in it.
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
    left, rest = _schur(A.reshape(4 * n, 4 * n), b.ravel(), n)
    H_covariance, _ = _schur(A_covariance.reshape(4 * n, 4 * n), b.ravel(), n)
    return Entering(np.array(roots[1:]), np.array(angles[1:]), left, rest, H_covariance)


def _unpacked(band: NDArray, first: NDArray, width: NDArray) -> NDArray:
    """(T, n, T, n) of blocks (4, T, n, 3) between frames, see `_kernels_band`."""
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
    """What is left of A (4 n, 4 n), b (4 n,) without the first n unknowns."""
    p = 4 * -(-n // 4)
    alone = np.zeros((p, p))
    alone[:n, :n] = inverse(A[:n, :n] + 1e-12 * np.trace(A) / len(A) * np.eye(n))
    below, fall, taken = np.zeros((3 * p, p)), np.empty((3 * p, p)), np.empty((3 * p, 3 * n))
    below[: 3 * n, :n] = A[n:, :n]
    _kernels_band.product(below, alone, fall)
    _kernels_band.product(fall, np.ascontiguousarray(below[: 3 * n].T), taken)
    left = A[n:, n:] - taken[: 3 * n]
    return 0.5 * (left + left.T), b[n:] - fall[: 3 * n, :n] @ b[:n]
