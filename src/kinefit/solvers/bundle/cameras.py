"""Cameras as unknowns: their parameters, cameras changed by them, and normal equations with free points.

Ten parameters for each camera: twist (v, ω) [m, rad] in its own frame (x_camera moves by v + ω × x_camera), log of the
focal length, radial coefficients k1 and k2, time offset [s].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.losses import Loss
from kinefit.solvers.bundle import _kernels_cameras
from kinefit.solvers.bundle._kernels_cameras import COLUMNS

_INVISIBLE_SQUARE = 1e6  # squared residual, in variances, of a point that its camera cannot see
POSE, FOCAL, RADIAL, TIME = slice(0, 6), 6, slice(7, 9), 9


def moved_camera(camera: Camera, delta: NDArray) -> Camera:
    """The camera changed by δ (10,), apart from the time offset."""
    matrix, k = np.array(camera.matrix), np.array(camera.distortion)
    matrix[:2, :2] *= np.exp(delta[FOCAL])
    if np.any(delta[RADIAL]):
        k = np.zeros(4) if k.size == 0 else k
        k[:2] += delta[RADIAL]
    T = se3.exp(delta[POSE]) @ camera.T_camera_world
    T[:3, :3] = se3.nearest_rotation(T[:3, :3])  # rounding of many small rotations must not add up
    return replace(camera, matrix=matrix, distortion=k, T_camera_world=T)


def moved_rig(rig: Rig, delta: NDArray) -> Rig:
    """All cameras changed by δ (C, 10)."""
    return Rig(tuple(moved_camera(c, d) for c, d in zip(rig, delta, strict=True)))


def departure(rig: Rig, start: Rig) -> NDArray:
    """δ (C, 10) from the cameras of `start` to those of `rig`; zero for the time offset."""
    out = np.zeros((len(rig), COLUMNS))
    for row, a, b in zip(out, start, rig, strict=True):
        row[POSE] = se3.log(b.T_camera_world @ a.T_world_camera)
        row[FOCAL] = np.log(b.matrix[0, 0] / a.matrix[0, 0])
        padded = [np.concatenate([c.distortion, np.zeros(2)])[:2] for c in (a, b)]
        row[RADIAL] = padded[1] - padded[0]
    return out


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """Gaussian prior of the cameras.

    Parameters
    ----------
    rig : Rig, the mean
    sigma : (C, 10) standard deviation of each parameter; 0 for a fixed one, inf for no prior
    """

    rig: Rig
    sigma: NDArray

    @property
    def freedom(self) -> NDArray:
        """(C, 10) 1 for free parameters, 0 for fixed ones."""
        return (self.sigma > 0).astype(float)

    @property
    def precision(self) -> NDArray:
        """(C · 10,) 1/σ²; 1 for fixed parameters, so that the system is regular."""
        sigma = self.sigma.ravel()
        return np.where(sigma > 0, 1.0 / np.square(np.where(sigma > 0, sigma, 1.0)), 1.0)

    def departure(self, rig: Rig, offsets: NDArray) -> NDArray:
        """(C · 10,) differences of a rig and its time offsets (C,) [s] from the mean; zero for fixed parameters."""
        out = departure(rig, self.rig)
        out[:, TIME] = offsets
        return (out * self.freedom).ravel()


@dataclass(frozen=True, eq=False)
class PointPixels:
    """M pixels of P free points.

    Parameters
    ----------
    camera, point : (M,) int
    uv : (M, 2) [px]
    weight : (M,) [1/px²]
    velocity : (M, 2) [px/s] of the pixels, for time offsets; default: 0
    """

    camera: NDArray
    point: NDArray
    uv: NDArray
    weight: NDArray
    velocity: NDArray | None = None

    @property
    def motion(self) -> NDArray:
        """(M, 2) [px/s] velocity of the pixels, 0 by default."""
        return np.zeros(self.uv.shape) if self.velocity is None else self.velocity


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations of the cameras with the points eliminated, S (C·10, C·10) and b, and their back substitution."""

    S: NDArray
    b: NDArray
    inverse: NDArray  # (P, 3, 3)
    cross: NDArray  # (P, 3, C·10)
    right: NDArray  # (P, 3)

    def points_step(self, delta: NDArray) -> NDArray:
        """(P, 3) [m] steps of the points for the cameras' δ (C·10,)."""
        return (self.inverse @ (self.right - self.cross @ delta)[..., None])[..., 0]


def residuals(rig: Rig, offsets: NDArray, pixels: PointPixels, x: NDArray) -> NDArray:
    """(M, 2) [px] measured minus projected points x (P, 3) [m], time offsets (C,) [s] included; NaN if invisible."""
    projected = np.full(pixels.uv.shape, np.nan)
    for c, camera in enumerate(rig):
        in_camera = pixels.camera == c
        projected[in_camera] = camera.project(x[pixels.point[in_camera]])
    return pixels.uv - projected - offsets[pixels.camera, None] * pixels.motion


def robust_cost(residual: NDArray, weight: NDArray, loss: Loss) -> tuple[float, NDArray]:
    """Σ ρ(w r²) of residuals (M, 2) with weights (M,), and robust factors (M,); NaN counts as an outlier."""
    s2 = weight * np.sum(residual * residual, axis=1)
    visible, factor = np.isfinite(s2), np.empty(len(s2))
    cost = _kernels_cameras.robust_values(loss.kind, loss.scale, np.where(visible, s2, _INVISIBLE_SQUARE), factor)
    return float(cost), np.where(visible, factor, 0.0)


def reduce_points(
    rig: Rig, offsets: NDArray, freedom: NDArray, pixels: PointPixels, x: NDArray, loss: Loss, damping: float = 0.0
) -> Reduced:
    """Eliminate free points x (P, 3) [m] from the normal equations of the cameras (Schur complement)."""
    M, P, C = len(pixels.uv), len(x), len(rig)
    value, J_point, J_camera = np.empty((M, 2)), np.empty((M, 2, 3)), np.empty((M, 2, COLUMNS))
    motion = pixels.motion
    _kernels_cameras.point_systems(
        rig.packed, freedom, pixels.camera, pixels.point, x, motion, value, J_point, J_camera
    )
    residual = pixels.uv - value - offsets[pixels.camera, None] * motion
    w = pixels.weight * robust_cost(residual, pixels.weight, loss)[1]
    residual = np.where(w[:, None] > 0, residual, 0.0)
    JwT, JcT = w[:, None, None] * J_point.transpose(0, 2, 1), w[:, None, None] * J_camera.transpose(0, 2, 1)
    V, right = np.zeros((P, 3, 3)), np.zeros((P, 3))
    np.add.at(V, pixels.point, JwT @ J_point)
    np.add.at(right, pixels.point, (JwT @ residual[..., None])[..., 0])
    cross = np.zeros((P, C, 3, COLUMNS))
    np.add.at(cross, (pixels.point, pixels.camera), JwT @ J_camera)
    U, b = np.zeros((C, COLUMNS, COLUMNS)), np.zeros((C, COLUMNS))
    np.add.at(U, pixels.camera, JcT @ J_camera)
    np.add.at(b, pixels.camera, (JcT @ residual[..., None])[..., 0])
    trace = np.trace(V, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(V + (damping * trace + 1e-9 * trace + 1e-12) * np.eye(3))
    flat = cross.transpose(0, 2, 1, 3).reshape(P, 3, C * COLUMNS)
    S = np.zeros((C, COLUMNS, C, COLUMNS))
    S[np.arange(C), :, np.arange(C)] = U
    back = (inverse @ flat).reshape(P * 3, C * COLUMNS)
    S = S.reshape(C * COLUMNS, C * COLUMNS) - flat.reshape(P * 3, C * COLUMNS).T @ back
    return Reduced(S, b.ravel() - back.T @ right.ravel(), inverse, flat, right)


def camera_jacobian(camera: Camera, x_world: NDArray) -> NDArray:
    """(P, 2, 10) derivatives of the pixels of points (P, 3) [m] by the camera's parameters; 0 for invisible points."""
    count = len(x_world)
    value, J_point, J = np.empty((count, 2)), np.empty((count, 2, 3)), np.empty((count, 2, COLUMNS))
    first, each = np.zeros(count, np.int64), np.arange(count)
    _kernels_cameras.point_systems(
        camera.packed[None], np.ones((1, COLUMNS)), first, each, np.ascontiguousarray(x_world, float),
        np.zeros((count, 2)), value, J_point, J,
    )  # fmt: skip
    return J
