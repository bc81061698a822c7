"""Rigid clusters: the mean shape of markers and its pose in every frame, and motions of limbs from pairs of points."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape
from kinefit.errors import ObservationError
from kinefit.geometry.se3 import nearest_rotation


def nan_median(values: NDArray, axis: int | tuple[int, ...]) -> NDArray:
    """Median along an axis, without NaN; NaN, with no warning, if all are NaN."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        median = np.nanmedian if np.isnan(values).any() else np.median  # the same, several times as fast
        return np.asarray(median(values, axis=axis))


def rigid_frames(
    x: NDArray, y: NDArray, prior: NDArray | None = None, weight: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """Rotations (F, 3, 3) and translations (F, 3) that map x onto y by least squares; NaN in frames without points.

    Parameters
    ----------
    x : (k, 3) or (F, k, 3) [m] points of the cluster
    y : (F, k, 3) [m] measured points, NaN for missing ones
    prior : (F, 3, 3) rotations that decide what one or two points leave undetermined; default: the identity
    weight : (k,) or (F, k) of the points; default: 1
    """
    prior = np.broadcast_to(np.eye(3), (len(y), 3, 3)) if prior is None else prior
    measured = np.isfinite(y[..., 0])
    share = np.where(measured, 1.0 if weight is None else weight / weight.max(), 0.0)[..., None]
    count = np.maximum(share.sum(1), 1e-300)
    x_all = np.where(measured[..., None], x, 0.0)
    y_all = np.where(measured[..., None], y, 0.0)
    x_mid, y_mid = (share * x_all).sum(1) / count, (share * y_all).sum(1) / count
    a = np.where(measured[..., None], x - x_mid[:, None], 0.0)
    b = np.where(measured[..., None], y_all - y_mid[:, None], 0.0)
    size = (share * a * a).sum((1, 2))[:, None, None]
    cross = np.einsum("fki,fkj->fij", share * b, a)
    cross += (1e-4 * size + 1e-12) * np.where(np.isfinite(prior), prior, np.eye(3))
    R = nearest_rotation(cross)
    t = y_mid - np.einsum("fij,fj->fi", R, x_mid)
    missing = ~measured.any(1)
    R[missing], t[missing] = np.nan, np.nan
    return R, t


def local(R: NDArray, t: NDArray, y: NDArray) -> NDArray:
    """(F, k, 3) [m] world points y in the frames of a segment with rotations (F, 3, 3) and origins (F, 3)."""
    return np.einsum("fji,fkj->fki", R, y - t[:, None])


def shape_of(y: NDArray) -> NDArray:
    """(k, 3) [m] mean shape of a rigid cluster y (F, k, 3), in the pose of the frame with the most markers."""
    shape = y[int(np.argmax(np.isfinite(y[..., 0]).sum(1)))]
    shape = np.where(np.isfinite(shape), shape, np.nanmean(shape, axis=0))
    for _ in range(3):
        typical = nan_median(local(*rigid_frames(shape, y), y), axis=0)
        shape = np.where(np.isfinite(typical), typical, shape)
    return shape


def absolute_orientation(
    source: NDArray, target: NDArray, weight: NDArray, limb: NDArray, count: int, *, stay: float = 0.0
) -> tuple[NDArray, NDArray]:
    """The rigid motion x -> R x + t of each limb that minimises Σ w |R source + t − target|² over its pairs.

    The rotation is the one nearest to Σ w b aᵀ, a and b being source and target about their weighted means (Horn,
    JOSA A 4, 1987; Kabsch 1978; P2 4.2.7). Pairs that do not determine it (one pair, or all on a line) have several:
    a quarter of `stay`, added to the diagonal, prefers the identity.

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
    cross = np.stack([np.bincount(limb, b[:, i] * a[:, j], count) for i in range(3) for j in range(3)], axis=1)
    R = nearest_rotation(cross.reshape(-1, 3, 3) + 0.25 * (stay + 1e-12) * np.eye(3))
    return R, mean_target - (R @ mean_source[:, :, None])[..., 0]


def move(frames: NDArray, R: NDArray, t: NDArray) -> NDArray:
    """Frames (S, 12) of segments after motions R (S, 3, 3), t (S, 3) [m] in the world."""
    turned = (R @ frames[:, :9].reshape(-1, 3, 3)).reshape(-1, 9)
    return np.concatenate([turned, (R @ frames[:, 9:, None])[..., 0] + t], axis=1)
