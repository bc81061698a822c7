"""How far each camera is off, from points that several cameras see: a shift, a turn, a scale of its picture.

Bias is where the calibration places the points minus where the camera saw them. Two kinds are told: with the camera's
own view among those that make the points (what is left of its error in a fit), and from all other cameras alone (its
error against them, about twice as large with four cameras).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import KeypointViews, from_others, meet

SHIFT, TURN, SCALE = slice(0, 2), slice(2, 3), slice(3, 4)
PER_CAMERA = 4  # parameters of a camera's picture: shift along u and v [px], turn [rad], scale [1]
_MAD = 1.4826  # median absolute deviation -> standard deviation
_NULL = 1e-6  # of the largest eigenvalue: what cameras do together as one body, which nobody can see


@dataclass(frozen=True, eq=False)
class CameraBias:
    """What one camera's keypoints say about its calibration.

    Parameters
    ----------
    camera : str
    bias, std : (2,) [px]
        Median of predicted minus seen, with its standard error, which counts each keypoint once: a detector misses a
        point of the body alike in every frame.
    alone : (2,) [px]
        The bias, predicted from the other cameras only; NaN where these are fewer than two.
    spread : float [px]
        Median distance of the points from the bias.
    outliers : float
        Share of the points seen that agree with no other camera.
    count : int
        Points that were compared.
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
        """[px] length of the bias."""
        return float(np.hypot(*self.bias))


def camera_biases(views: KeypointViews) -> tuple[CameraBias, ...]:
    """Bias and spread of every camera of the rig."""
    x, agree = meet(views)
    out = []
    for c, camera in enumerate(views.rig):
        seen = np.isfinite(views.uv[:, :, c]).all(-1)
        used = agree[:, :, c] & np.isfinite(x[..., 0])
        d = np.where(used[..., None], camera.project(x) - views.uv[:, :, c], np.nan)
        bias, std = _middle(d)
        alone = np.full(2, np.nan)
        if len(views.rig) > 2:
            alone, _ = _middle(from_others(views, c) - views.uv[:, :, c], limit=views.limit)
        apart = np.linalg.norm(d - bias, axis=-1)[used]
        told = seen & np.isfinite(x[..., 0])
        out.append(
            CameraBias(
                camera.name, bias, std, alone, float(np.median(apart)) if len(apart) else np.nan,
                1.0 - float(used.sum() / told.sum()) if told.any() else np.nan, int(used.sum()),
            )
        )  # fmt: skip
    return tuple(out)


def _middle(d: NDArray, *, limit: float = np.inf) -> tuple[NDArray, NDArray]:
    """Median of differences (F, K, 2) and its standard error over keypoints; NaN where nothing is known."""
    d = np.where((np.linalg.norm(d, axis=-1) <= limit)[..., None], d, np.nan)
    columns = [d[:, k][np.isfinite(d[:, k, 0])] for k in range(d.shape[1])]
    columns = [column for column in columns if len(column)]
    if not columns:
        return np.full(2, np.nan), np.full(2, np.nan)
    middle = np.median(np.concatenate(columns), axis=0)
    medians = np.stack([np.median(column, axis=0) for column in columns])
    spread = _MAD * np.median(np.abs(medians - np.median(medians, axis=0)), axis=0)
    return middle, 1.2533 * spread / np.sqrt(max(len(columns) / 2, 1))  # of a median; left and right err alike


@dataclass(frozen=True, eq=False)
class Disagreement:
    """Normal equations of all cameras' picture errors, the points in space taken out.

    Parameters
    ----------
    cameras : (C,) names
    matrix : (P, P), right : (P,), P = 4 C
        Of the unknown errors θ (see `PER_CAMERA`) in predicted − seen ≈ D θ.
    count : int
        Pixels (u or v) of it that the points leave over.
    """

    cameras: tuple[str, ...]
    matrix: NDArray
    right: NDArray
    count: int

    def explained(self, columns: Sequence[int] | NDArray) -> float:
        """[px] root mean square of the disagreement that errors of some parameters alone explain."""
        at = np.asarray(columns, int)
        if not len(at) or not self.count:
            return 0.0
        solved = _solve(self.matrix[np.ix_(at, at)], self.right[at])
        return float(np.sqrt(max(self.right[at] @ solved, 0.0) / self.count))

    def of(self, *cameras: int, parts: Sequence[slice] = (SHIFT, TURN, SCALE)) -> NDArray:
        """Columns of some cameras' parameters."""
        own = np.concatenate([np.arange(PER_CAMERA)[part] for part in parts])
        return np.concatenate([PER_CAMERA * c + own for c in cameras]) if cameras else np.zeros(0, int)

    def solve(self, *cameras: int) -> NDArray:
        """(len(cameras), 4) errors of some cameras if all others are right."""
        at = self.of(*cameras)
        return _solve(self.matrix[np.ix_(at, at)], self.right[at]).reshape(-1, PER_CAMERA)


def _solve(matrix: NDArray, right: NDArray) -> NDArray:
    """Solution of least norm, in scaled parameters, as some of them all cameras share unseen."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    sure = values > _NULL * max(values[-1], 1e-300)
    return scale * (vectors[:, sure] @ ((vectors[:, sure].T @ (scale * right)) / values[sure]))


def disagreement(views: KeypointViews) -> Disagreement:
    """How the cameras disagree, in terms of each one's picture being shifted, turned and scaled.

    Each point's normal equations with its own three unknowns taken out (Schur complement); only points that three or
    more cameras agree on, as two always find one along a line.
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
        seen, rows = agree[:, c, None], slice(2 * c, 2 * c + 2)
        q = predicted - camera.matrix[:2, 2]
        own = np.zeros((count, 2, PER_CAMERA))
        own[:, 0, 0] = own[:, 1, 1] = 1.0
        own[:, 0, 2], own[:, 1, 2] = -q[:, 1], q[:, 0]
        own[:, :, 3] = q
        design[:, rows, PER_CAMERA * c : PER_CAMERA * (c + 1)] = np.where(seen[..., None], own, 0.0)
        jacobian[:, rows] = np.where(seen[..., None], by_point, 0.0)
        residual[:, rows] = np.where(seen, predicted - uv[:, c], 0.0)
    matrix, right = without_points(jacobian, design, residual)
    return Disagreement(views.rig.names, matrix.sum(0), right.sum(0), int(2 * agree.sum() - 3 * count))


def without_points(jacobian: NDArray, design: NDArray, residual: NDArray) -> tuple[NDArray, NDArray]:
    """Normal equations (N, P, P), (N, P) of the parameters of `design` (N, R, P), each point's own three taken out.

    jacobian (N, R, 3) is the derivative of the residuals (N, R) by the points.
    """
    own = np.swapaxes(jacobian, 1, 2)
    inverse = np.linalg.inv(own @ jacobian + 1e-9 * np.eye(3))
    cross = own @ design
    matrix = np.swapaxes(design, 1, 2) @ design - np.swapaxes(cross, 1, 2) @ inverse @ cross
    right = np.einsum("nrp,nr->np", design, residual) - np.einsum(
        "nip,nij,nj->np", cross, inverse, np.einsum("nir,nr->ni", own, residual), optimize=True
    )
    return matrix, right
