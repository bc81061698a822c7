"""Calibration errors of each camera, from points that several cameras see: shift, rotation and scale of its image.

The bias is the projection of the triangulated points minus their detections. It is computed in two ways: from points
that include the camera's own view (the part of its error that remains in a fit), and from points of all other cameras
(its error against them, about twice as large with four cameras).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import KeypointViews, from_others, meet

SHIFT, TURN, SCALE = slice(0, 2), slice(2, 3), slice(3, 4)
PER_CAMERA = 4  # parameters of a camera's image error: shift along u and v [px], rotation [rad], scale [1]
_MAD_TO_SIGMA = 1.4826  # median absolute deviation to standard deviation, of a normal distribution
_MIN_EIGENVALUE = 1e-6  # as a share of the largest: smaller ones are unobserved motions of all cameras together


@dataclass(frozen=True, eq=False)
class CameraBias:
    """Bias of one camera's keypoints.

    Parameters
    ----------
    camera : str
    bias, std : (2,) [px]
        Median of projected minus detected points, and its standard error. Each keypoint counts once, because a
        detector's error of one landmark is the same in every frame.
    alone : (2,) [px]
        Bias against points of the other cameras only; NaN if these are fewer than two.
    spread : float [px]
        Median distance of the points from the bias.
    outliers : float in 0..1
        Share of the detected points that agree with no other camera.
    count : int
        Number of compared points.
    """

    camera: str
    bias: NDArray
    std: NDArray
    alone: NDArray
    spread: float
    outliers: float
    count: int

    @property
    def size(self) -> float:
        """Length [px] of the bias."""
        return float(np.hypot(*self.bias))


def camera_biases(views: KeypointViews) -> tuple[CameraBias, ...]:
    """Bias and spread of every camera of the rig."""
    x, agree = meet(views)
    out = []
    for c, camera in enumerate(views.rig):
        detected = np.isfinite(views.uv[:, :, c]).all(-1)
        used = agree[:, :, c] & np.isfinite(x[..., 0])
        d = np.where(used[..., None], camera.project(x) - views.uv[:, :, c], np.nan)
        bias, std = _median_bias(d)
        alone = np.full(2, np.nan)
        if len(views.rig) > 2:
            alone, _ = _median_bias(from_others(views, c) - views.uv[:, :, c], limit=views.limit)
        apart = np.linalg.norm(d - bias, axis=-1)[used]
        compared = detected & np.isfinite(x[..., 0])
        out.append(
            CameraBias(
                camera.name, bias, std, alone, float(np.median(apart)) if len(apart) else np.nan,
                1.0 - float(used.sum() / compared.sum()) if compared.any() else np.nan, int(used.sum()),
            )
        )  # fmt: skip
    return tuple(out)


def _median_bias(d: NDArray, *, limit: float = np.inf) -> tuple[NDArray, NDArray]:
    """Median (2,) of differences (F, K, 2) and its standard error over keypoints; NaN where there are none."""
    d = np.where((np.linalg.norm(d, axis=-1) <= limit)[..., None], d, np.nan)
    columns = [d[:, k][np.isfinite(d[:, k, 0])] for k in range(d.shape[1])]
    columns = [column for column in columns if len(column)]
    if not columns:
        return np.full(2, np.nan), np.full(2, np.nan)
    middle = np.median(np.concatenate(columns), axis=0)
    medians = np.stack([np.median(column, axis=0) for column in columns])
    spread = _MAD_TO_SIGMA * np.median(np.abs(medians - np.median(medians, axis=0)), axis=0)
    return middle, 1.2533 * spread / np.sqrt(max(len(columns) / 2, 1))  # of a median; left and right are correlated


@dataclass(frozen=True, eq=False)
class Disagreement:
    """Normal equations of the image errors of all cameras, with the points in space eliminated.

    Parameters
    ----------
    cameras : (C,) names
    matrix : (P, P), right : (P,), P = 4 C
        Of the unknown errors θ (see `PER_CAMERA`) in projected − detected ≈ D θ.
    count : int
        Degrees of freedom: pixel coordinates minus the unknowns of the points.
    """

    cameras: tuple[str, ...]
    matrix: NDArray
    right: NDArray
    count: int

    def explained(self, columns: Sequence[int] | NDArray) -> float:
        """Root mean square [px] of the disagreement that the parameters in columns (N,) alone explain."""
        at = np.asarray(columns, int)
        if not len(at) or not self.count:
            return 0.0
        solved = _solve(self.matrix[np.ix_(at, at)], self.right[at])
        return float(np.sqrt(max(self.right[at] @ solved, 0.0) / self.count))

    def of(self, *cameras: int, parts: Sequence[slice] = (SHIFT, TURN, SCALE)) -> NDArray:
        """Columns (N,) int of some cameras' parameters."""
        own = np.concatenate([np.arange(PER_CAMERA)[part] for part in parts])
        return np.concatenate([PER_CAMERA * c + own for c in cameras]) if cameras else np.zeros(0, int)

    def solve(self, *cameras: int) -> NDArray:
        """Errors (N, 4) [px, px, rad, 1] of N cameras if all other cameras are correct."""
        at = self.of(*cameras)
        return _solve(self.matrix[np.ix_(at, at)], self.right[at]).reshape(-1, PER_CAMERA)


def _solve(matrix: NDArray, right: NDArray) -> NDArray:
    """Minimum-norm solution in scaled parameters: motions of all cameras together are unobserved."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    observed = values > _MIN_EIGENVALUE * max(values[-1], 1e-300)
    return scale * (vectors[:, observed] @ ((vectors[:, observed].T @ (scale * right)) / values[observed]))


def disagreement(views: KeypointViews) -> Disagreement:
    """Normal equations of each camera's image shift, rotation and scale, from the disagreement of the cameras.

    The three unknowns of each point are eliminated (Schur complement). Only points that three or more cameras agree on
    are used, because two cameras always agree along the epipolar line.
    """
    x, agree = meet(views)
    cameras = len(views.rig)
    use = (agree.sum(axis=2) >= 3) & np.isfinite(x[..., 0])
    x, agree, uv = x[use], agree[use], views.uv[use]
    count = len(x)
    jacobian, design = np.zeros((count, 2 * cameras, 3)), np.zeros((count, 2 * cameras, PER_CAMERA * cameras))
    residual = np.zeros((count, 2 * cameras))
    for c, camera in enumerate(views.rig):
        predicted, by_point = camera.project_with_jacobian(x)
        detected, rows = agree[:, c, None], slice(2 * c, 2 * c + 2)
        q = predicted - camera.matrix[:2, 2]
        own = np.zeros((count, 2, PER_CAMERA))
        own[:, 0, 0] = own[:, 1, 1] = 1.0
        own[:, 0, 2], own[:, 1, 2] = -q[:, 1], q[:, 0]
        own[:, :, 3] = q
        design[:, rows, PER_CAMERA * c : PER_CAMERA * (c + 1)] = np.where(detected[..., None], own, 0.0)
        jacobian[:, rows] = np.where(detected[..., None], by_point, 0.0)
        residual[:, rows] = np.where(detected, predicted - uv[:, c], 0.0)
    matrix, right = without_points(jacobian, design, residual)
    return Disagreement(views.rig.names, matrix.sum(0), right.sum(0), int(2 * agree.sum() - 3 * count))


def without_points(jacobian: NDArray, design: NDArray, residual: NDArray) -> tuple[NDArray, NDArray]:
    """Normal equations (N, P, P), (N, P) of the parameters of `design` (N, R, P), with the points eliminated.

    jacobian (N, R, 3): derivative of the residuals (N, R) by each point.
    """
    own = np.swapaxes(jacobian, 1, 2)
    inverse = np.linalg.inv(own @ jacobian + 1e-9 * np.eye(3))
    cross = own @ design
    matrix = np.swapaxes(design, 1, 2) @ design - np.swapaxes(cross, 1, 2) @ inverse @ cross
    right = np.einsum("nrp,nr->np", design, residual) - np.einsum(
        "nip,nij,nj->np", cross, inverse, np.einsum("nir,nr->ni", own, residual), optimize=True
    )
    return matrix, right
