"""Absolute orientation of many limbs in closed form (Horn, JOSA A 4, 1987; P2 4.2.7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape
from kinefit.errors import ObservationError
from kinefit.geometry import se3


def absolute_orientation(
    source: NDArray, target: NDArray, weight: NDArray, limb: NDArray, count: int, *, stay: float = 0.0
) -> tuple[NDArray, NDArray]:
    """The rigid motion x -> R x + t of each limb that minimises Σ w |R source + t − target|² over its pairs.

    Horn's unit quaternion: the eigenvector of the largest eigenvalue of the 4 x 4 matrix N made of Σ w a bᵀ, where a
    and b are source and target about their weighted means. Pairs that do not determine the rotation (one pair, or all
    on a line) have several largest eigenvalues. `stay`, added to N's first element, prefers the identity.

    Parameters
    ----------
    source, target : (N, 3) [m] pairs of points
    weight : (N,) not negative
    limb : (N,) int in 0 .. count - 1
    count : int, number of limbs
    stay : float [m² times the unit of the weights]
        Preference for small rotations, equal to that of unmoved pairs with a quarter of this as second moment.

    Returns
    -------
    R (count, 3, 3), t (count, 3) [m]; the identity for limbs without pairs

    Raises
    ------
    ObservationError
        Pairs that do not match, are not finite, or have a negative weight.
    """
    n = len(source)
    for array, shape in ((source, (n, 3)), (target, (n, 3)), (weight, (n,)), (limb, (n,))):
        check_shape(array, shape, "pairs")
    if not np.isfinite([source.sum(), target.sum(), weight.sum()]).all() or (n and weight.min() < 0.0):
        raise ObservationError("pairs are not finite, or have a negative weight", remedy="Remove unknown pairs.")
    total = np.bincount(limb, weight, count)
    share = 1.0 / np.where(total > 0.0, total, 1.0)
    mean_source, mean_target = (
        np.stack([np.bincount(limb, weight * x[:, k], count) for k in range(3)], axis=1) * share[:, None]
        for x in (source, target)
    )
    a, b = source - mean_source[limb], (target - mean_target[limb]) * weight[:, None]
    S = np.stack([np.bincount(limb, a[:, i] * b[:, j], count) for i in range(3) for j in range(3)], axis=1)
    R = se3.rotation_from_quaternion(_best_quaternions(S.reshape(-1, 3, 3), stay))
    t = mean_target - (R @ mean_source[:, :, None])[..., 0]
    return R, t


def _best_quaternions(S: NDArray, stay: float) -> NDArray:
    """(L, 4) unit quaternions (w, x, y, z) that maximise qᵀ N q."""
    N = np.empty((len(S), 4, 4))
    trace = np.trace(S, axis1=1, axis2=2)
    N[:, 0, 0] = trace + stay + 1e-12  # the identity for limbs without pairs
    N[:, 1:, 1:] = S + S.swapaxes(1, 2) - trace[:, None, None] * np.eye(3)
    N[:, 0, 1:] = N[:, 1:, 0] = np.stack(
        [S[:, 1, 2] - S[:, 2, 1], S[:, 2, 0] - S[:, 0, 2], S[:, 0, 1] - S[:, 1, 0]], axis=1
    )
    q: NDArray = np.linalg.eigh(N)[1][:, :, -1]
    return q


def move(frames: NDArray, R: NDArray, t: NDArray) -> NDArray:
    """Frames (S, 12) of segments after motions R (S, 3, 3), t (S, 3) [m] in the world."""
    turned = (R @ frames[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    return np.concatenate([turned, (R @ frames[:, 9:, None])[..., 0] + t], axis=1)
