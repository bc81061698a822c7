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
from kinefit.solvers.bundle.arrow import Arrow, assembled

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

    def cost(self, rig: Rig, offsets: NDArray) -> float:
        """Cost of a rig and its time offsets (C,) [s]."""
        return float(self.precision @ self.departure(rig, offsets) ** 2)

    def equations(self, rig: Rig, offsets: NDArray) -> tuple[NDArray, NDArray]:
        """Information (C · 10,) and gradient (C · 10,) at a rig and its time offsets (C,) [s]."""
        return self.precision, -self.precision * self.departure(rig, offsets)


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

    @classmethod
    def none(cls) -> PointPixels:
        """No pixels."""
        return cls(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))

    @property
    def motion(self) -> NDArray:
        """(M, 2) [px/s] velocity of the pixels, 0 by default."""
        return np.zeros(self.uv.shape) if self.velocity is None else self.velocity


def point_arrow(
    rig: Rig, offsets: NDArray, freedom: NDArray, pixels: PointPixels, x: NDArray, loss: Loss
) -> tuple[Arrow, float]:
    """Equations of the cameras (C · 10,) and of free points x (P, 3) [m], and their cost."""
    M = len(pixels.uv)
    value, A = np.empty((M, 2)), np.empty((M, 2, COLUMNS + 4))
    _kernels_cameras.point_systems(
        rig.packed, freedom, pixels.camera, pixels.point, x, pixels.motion, value, A[..., COLUMNS:-1], A[..., :COLUMNS]
    )
    A[..., -1] = pixels.uv - value - offsets[pixels.camera, None] * pixels.motion
    s2 = pixels.weight * np.sum(A[..., -1] ** 2, axis=1)
    visible = np.isfinite(s2)
    A[~visible] = 0.0
    rho, factor = loss.weigh(np.where(visible, s2, _INVISIBLE_SQUARE))
    grams = A.swapaxes(1, 2) @ ((pixels.weight * factor)[:, None, None] * A)
    return assembled(grams, pixels.camera, pixels.point, len(rig), len(x), 3), float(rho.sum())


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
