"""Rigid clusters of markers: their mean shape, and its pose in every frame."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.se3 import nearest_rotation


def middle(values: NDArray, axis: int | tuple[int, ...]) -> NDArray:
    """Median along an axis, without NaN; NaN, with no warning, if all are NaN."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
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
        typical = middle(local(*rigid_frames(shape, y), y), axis=0)
        shape = np.where(np.isfinite(typical), typical, shape)
    return shape
