"""Cameras as unknowns: their parameters, cameras changed by them, and derivatives of pixels.

Sixteen parameters for each camera: twist (v, ω) [m, rad] in its own frame (x_camera moves by v + ω × x_camera), log of
the focal length, log of fy / fx, principal point [px], k1, k2, p1, p2, k3 (of a fisheye lens k1 to k4), time offset
[s].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.solving.bundle import _kernels
from kinefit.solving.bundle._kernels import COLUMNS
from kinefit.solving.bundle.arrow import Arrow

POSE, FOCAL, ASPECT, CENTRE, RADIAL, DISTORTION = slice(0, 6), 6, 7, slice(8, 10), slice(10, 12), slice(10, 15)
TIME = 15


def moved_camera(camera: Camera, delta: NDArray) -> Camera:
    """The camera changed by δ (16,), apart from the time offset."""
    matrix, k, d = np.array(camera.matrix), np.array(camera.distortion), delta[DISTORTION]
    matrix[:2, :2] *= np.exp(delta[FOCAL])
    matrix[1, 1] *= np.exp(delta[ASPECT])
    matrix[:2, 2] += delta[CENTRE]
    if np.any(d):
        k = np.pad(k, (0, max((5 if d[4] else 4) - k.size, 0)))
        k[:5] += d[: k.size]
    T = se3.exp(delta[POSE]) @ camera.T_camera_world
    T[:3, :3] = se3.nearest_rotation(T[:3, :3])  # rounding of many small rotations must not add up
    return replace(camera, matrix=matrix, distortion=k, T_camera_world=T)


def moved_rig(rig: Rig, delta: NDArray) -> Rig:
    """All cameras changed by δ (C, 16)."""
    return Rig(tuple(moved_camera(c, d) for c, d in zip(rig, delta, strict=True)))


def departure(rig: Rig, start: Rig) -> NDArray:
    """δ (C, 16) from the cameras of `start` to those of `rig`; zero for the time offset."""
    out = np.zeros((len(rig), COLUMNS))
    old, new = (np.array([camera.matrix for camera in r]) for r in (start, rig))
    moved = [b.T_camera_world @ a.T_world_camera for a, b in zip(start, rig, strict=True)]
    k_old, k_new = ([np.concatenate([c.distortion, np.zeros(5)])[:5] for c in r] for r in (start, rig))
    out[:, POSE], out[:, FOCAL] = se3.log(np.array(moved)), np.log(new[:, 0, 0] / old[:, 0, 0])
    out[:, ASPECT] = np.log(new[:, 1, 1] / old[:, 1, 1]) - out[:, FOCAL]
    out[:, CENTRE], out[:, DISTORTION] = new[:, :2, 2] - old[:, :2, 2], np.array(k_new) - k_old
    return out


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """Which of the cameras' parameters are free, q in all, and their Gaussian prior.

    Parameters
    ----------
    rig : Rig, the mean
    sigma : (C, 16) standard deviation of each parameter; 0 for a fixed one, inf for no prior
    """

    rig: Rig
    sigma: NDArray

    @cached_property
    def free(self) -> NDArray:
        """(C, 16) bool: the parameters that are estimated."""
        return np.asarray(self.sigma > 0)

    @cached_property
    def place(self) -> NDArray:
        """(C, 16) int: place of each parameter among the free ones, -1 for a fixed one."""
        return np.where(self.free, np.cumsum(self.free).reshape(self.free.shape) - 1, -1)

    @cached_property
    def precision(self) -> NDArray:
        """(q,) 1/σ²."""
        return np.asarray(self.sigma[self.free] ** -2.0)

    def departure(self, rig: Rig, offsets: NDArray) -> NDArray:
        """(q,) differences of a rig and its time offsets (C,) [s] from the mean."""
        out = departure(rig, self.rig)
        out[:, TIME] = offsets
        return out[self.free]

    def added(self, arrow: Arrow, departure: NDArray) -> Arrow:
        """Equations with this prior, at a departure (q,); the cameras are their last parameters."""
        before, information = np.zeros(len(arrow.g) - len(departure)), self.precision
        both = information, -information * departure
        return arrow.with_prior(*(np.concatenate([before, values]) for values in both))

    def moved(self, rig: Rig, offsets: NDArray, delta: NDArray) -> tuple[Rig, NDArray]:
        """A rig and its time offsets (C,) [s] changed by δ (q,)."""
        step = np.zeros(self.sigma.shape)
        step[self.free] = delta
        return moved_rig(rig, step), offsets + step[:, TIME]

    def full(self, matrix: NDArray) -> NDArray:
        """(C · 16, C · 16) matrix of all parameters from one of the free ones (q, q); zero for fixed ones."""
        out, own = np.zeros((self.sigma.size,) * 2), self.free.ravel()
        out[np.ix_(own, own)] = matrix
        return out


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


def pixel_rows(
    rig: Rig, prior: CameraPrior, camera: NDArray, x_world: NDArray, uv: NDArray, *, by_block: NDArray | None = None,
    motion: NDArray | None = None,
) -> NDArray:  # fmt: skip
    """Derivatives and residuals of pixels, for `assembled`.

    Parameters
    ----------
    prior : CameraPrior; U parameters are free in one camera or more
    camera, x_world, uv : (M,) int, (M, 3) [m], (M, 2) [px] of each measurement
    by_block : (M, 3, n) derivatives of the points by the unknowns of their block; default: these are the points
    motion : (M, 2) [px/s] velocity of the pixels, for time offsets; default: 0

    Returns
    -------
    (M, 2, U + n + 1) derivatives by camera and block, residual; derivatives 0 and residual NaN where invisible
    """
    M, used = len(uv), np.flatnonzero(prior.free.any(axis=0))
    value, by_camera, by_point = np.empty((M, 2)), np.empty((M, 2, COLUMNS)), np.empty((M, 2, 3))
    motion = np.zeros(uv.shape) if motion is None else motion
    x = np.ascontiguousarray(x_world, float)
    _kernels.point_systems(rig.packed, camera, x, motion, value, by_point, by_camera)
    out = np.empty((M, 2, len(used) + (3 if by_block is None else by_block.shape[2]) + 1))
    out[..., : len(used)], out[..., -1] = by_camera[..., used], uv - value
    out[..., len(used) : -1] = by_point if by_block is None else by_point @ by_block
    return out


def camera_jacobian(camera: Camera, x_world: NDArray) -> NDArray:
    """(P, 2, 16) derivatives of the pixels of points (P, 3) [m] by the camera's parameters; 0 for invisible points."""
    count, free = len(x_world), CameraPrior(Rig((camera,)), np.ones((1, COLUMNS)))
    return pixel_rows(free.rig, free, np.zeros(count, np.int64), x_world, np.zeros((count, 2)))[..., :COLUMNS]
