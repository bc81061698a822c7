"""Cameras as unknowns: their parameters, how a camera moves by them, and free points that see them.

Ten parameters a camera: twist (v, ω) [m, rad] in its own frame (x_camera moves by v + ω × x_camera, so v is where it
stands and ω where it looks), log of the focal length, the radial coefficients k1 and k2, time offset [s].
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

_UNSEEN = 1e6  # squared standard deviations of a point that its camera cannot see
POSE, FOCAL, RADIAL, TIME = slice(0, 6), 6, slice(7, 9), 9


def moved_camera(camera: Camera, delta: NDArray) -> Camera:
    """The camera changed by δ (10,); the time offset is not part of it."""
    matrix, k = np.array(camera.matrix), np.array(camera.distortion)
    matrix[:2, :2] *= np.exp(delta[FOCAL])
    if np.any(delta[RADIAL]):
        k = np.zeros(4) if k.size == 0 else k
        k[:2] += delta[RADIAL]
    T = se3.exp(delta[POSE]) @ camera.T_camera_world
    T[:3, :3] = se3.nearest_rotation(T[:3, :3])  # many small turns must not add up to a shear
    return replace(camera, matrix=matrix, distortion=k, T_camera_world=T)


def moved_rig(rig: Rig, delta: NDArray) -> Rig:
    """All cameras changed by δ (C, 10)."""
    return Rig(tuple(moved_camera(c, d) for c, d in zip(rig, delta, strict=True)))


def departure(rig: Rig, start: Rig) -> NDArray:
    """δ (C, 10) that leads from the cameras of one rig to those of another; the time offset's column is zero."""
    out = np.zeros((len(rig), COLUMNS))
    for row, a, b in zip(out, start, rig, strict=True):
        row[POSE] = se3.log(b.T_camera_world @ a.T_world_camera)
        row[FOCAL] = np.log(b.matrix[0, 0] / a.matrix[0, 0])
        padded = [np.concatenate([c.distortion, np.zeros(2)])[:2] for c in (a, b)]
        row[RADIAL] = padded[1] - padded[0]
    return out


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """What is known of the cameras before.

    Parameters
    ----------
    rig : Rig, the mean.
    sigma : (C, 10) standard deviation of each parameter about it; 0 for one that is fixed, inf for no prior.
    """

    rig: Rig
    sigma: NDArray

    @property
    def freedom(self) -> NDArray:
        """(C, 10) 1 for what may change, else 0."""
        return (self.sigma > 0).astype(float)

    @property
    def precision(self) -> NDArray:
        """(C · 10,) 1/σ²; what is fixed has 1, so that a system of it stays regular."""
        sigma = self.sigma.ravel()
        return np.where(sigma > 0, 1.0 / np.square(np.where(sigma > 0, sigma, 1.0)), 1.0)

    def departure(self, rig: Rig, offsets: NDArray) -> NDArray:
        """(C · 10,) how far a rig and its time offsets (C,) [s] are from the mean."""
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
    velocity : (M, 2) [px/s] of the points' images, for time offsets; default 0.
    """

    camera: NDArray
    point: NDArray
    uv: NDArray
    weight: NDArray
    velocity: NDArray | None = None

    @property
    def motion(self) -> NDArray:
        """(M, 2) [px/s] of the points' images, 0 by default."""
        return np.zeros(self.uv.shape) if self.velocity is None else self.velocity


@dataclass(frozen=True, eq=False)
class Reduced:
    """Normal equations of the cameras with the points taken out: S (C·10, C·10), b; and the way back to the points."""

    S: NDArray
    b: NDArray
    inverse: NDArray  # (P, 3, 3)
    cross: NDArray  # (P, 3, C·10)
    right: NDArray  # (P, 3)

    def points_step(self, delta: NDArray) -> NDArray:
        """(P, 3) [m] how the points move with the cameras' δ."""
        return (self.inverse @ (self.right - self.cross @ delta)[..., None])[..., 0]


def residuals(rig: Rig, offsets: NDArray, pixels: PointPixels, x: NDArray) -> NDArray:
    """(M, 2) [px] measured minus seen; NaN for a point that its camera cannot see."""
    seen = np.full(pixels.uv.shape, np.nan)
    for c, camera in enumerate(rig):
        mine = pixels.camera == c
        seen[mine] = camera.project(x[pixels.point[mine]])
    return pixels.uv - seen - offsets[pixels.camera, None] * pixels.motion


def robust_cost(left: NDArray, weight: NDArray, loss: Loss) -> tuple[float, NDArray]:
    """Σ ρ(w r²) of residuals (M, 2), and each one's factor (M,); what cannot be seen counts as an outlier."""
    s2 = weight * np.sum(left * left, axis=1)
    seen, factor = np.isfinite(s2), np.empty(len(s2))
    cost = _kernels_cameras.robust_values(loss.kind, loss.scale, np.where(seen, s2, _UNSEEN), factor)
    return float(cost), np.where(seen, factor, 0.0)


def reduce_points(
    rig: Rig, offsets: NDArray, freedom: NDArray, pixels: PointPixels, x: NDArray, loss: Loss, damping: float = 0.0
) -> Reduced:
    """Take free points x (P, 3) [m] out of the normal equations of the cameras (Schur complement)."""
    M, P, C = len(pixels.uv), len(x), len(rig)
    value, J_point, J_camera = np.empty((M, 2)), np.empty((M, 2, 3)), np.empty((M, 2, COLUMNS))
    motion = pixels.motion
    _kernels_cameras.point_systems(
        rig.packed, freedom, pixels.camera, pixels.point, x, motion, value, J_point, J_camera
    )
    left = pixels.uv - value - offsets[pixels.camera, None] * motion
    w = pixels.weight * robust_cost(left, pixels.weight, loss)[1]
    left = np.where(w[:, None] > 0, left, 0.0)
    JwT, JcT = w[:, None, None] * J_point.transpose(0, 2, 1), w[:, None, None] * J_camera.transpose(0, 2, 1)
    V, right = np.zeros((P, 3, 3)), np.zeros((P, 3))
    np.add.at(V, pixels.point, JwT @ J_point)
    np.add.at(right, pixels.point, (JwT @ left[..., None])[..., 0])
    cross = np.zeros((P, C, 3, COLUMNS))
    np.add.at(cross, (pixels.point, pixels.camera), JwT @ J_camera)
    U, b = np.zeros((C, COLUMNS, COLUMNS)), np.zeros((C, COLUMNS))
    np.add.at(U, pixels.camera, JcT @ J_camera)
    np.add.at(b, pixels.camera, (JcT @ left[..., None])[..., 0])
    trace = np.trace(V, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(V + (damping * trace + 1e-9 * trace + 1e-12) * np.eye(3))
    flat = cross.transpose(0, 2, 1, 3).reshape(P, 3, C * COLUMNS)
    S = np.zeros((C, COLUMNS, C, COLUMNS))
    S[np.arange(C), :, np.arange(C)] = U
    back = (inverse @ flat).reshape(P * 3, C * COLUMNS)
    S = S.reshape(C * COLUMNS, C * COLUMNS) - flat.reshape(P * 3, C * COLUMNS).T @ back
    return Reduced(S, b.ravel() - back.T @ right.ravel(), inverse, flat, right)


def camera_jacobian(camera: Camera, x_world: NDArray) -> NDArray:
    """(P, 2, 10) derivative of the pixels of points (P, 3) [m] by the parameters of their camera; 0 where unseen."""
    count = len(x_world)
    value, J_point, J = np.empty((count, 2)), np.empty((count, 2, 3)), np.empty((count, 2, COLUMNS))
    first, each = np.zeros(count, np.int64), np.arange(count)
    _kernels_cameras.point_systems(
        camera.packed[None], np.ones((1, COLUMNS)), first, each, np.ascontiguousarray(x_world, float),
        np.zeros((count, 2)), value, J_point, J,
    )  # fmt: skip
    return J
