"""Self-calibrating bundle adjustment with a known distance (H.-G. Maas, 1998; Triggs et al., 1999, with Schur).

Unknowns are each camera's pose and intrinsics (fx, fy, cx, cy, k1, k2, p1, p2, k3) and both ends of the bar in every
place. Observations are the pixels of the ends and, in every place, the distance of the two (P4, section 2.2). A weak
prior is a common camera: a principal point near the image's centre, square pixels, little distortion. The first
camera's pose is fixed, and the distance fixes the scale: no gauge freedom remains. The noise of the pixels and the
scatter of the distance are estimated as variance components (W. Förstner, 1979).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.calibration.board.bundle import CameraEquations, moved_rig, pixel_columns
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.losses import huber
from kinefit.solvers.bundle.arrow import Blocks, assembled
from kinefit.solvers.least_squares import descend

POSE = 6
INTERIOR = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_CENTRE_SIGMA = 0.05  # of the image's width, of the principal point about the image's centre
_ASPECT_SIGMA = 0.02  # of the image's width, of fx - fy
_DISTORTION_SIGMA = np.array([0.5, 0.5, 0.02, 0.02, 0.3])  # of k1, k2, p1, p2, k3 about zero
_HUBER = 3.0  # [standard deviations] all but 1 % of normal errors keep full weight
_MIN_SIGMA_PX = 0.005
_MIN_SCATTER = 1e-6  # of the length


@dataclass(frozen=True, eq=False)
class BarBundle:
    """Adjusted cameras and places of the bar.

    Parameters
    ----------
    rig : Rig, the first camera unchanged.
    x_world : (F, 2, 3) [m] ends of the bar.
    residuals : (F, C, 2, 2) [px] measured minus projected; NaN if unobserved.
    sigma : float [px] standard deviation of a pixel coordinate.
    scatter : float [m] standard deviation of the distance of the ends in one place.
    covariance : (C · P, C · P) of the cameras' parameters, P = 6 for the twist (v, ω) in the camera's frame, and 9
        for the intrinsics if these were estimated; zero for fixed parameters.
    ends : (F, 6, 6) [m²] covariance of each place's ends.
    prior_share : (C · P,) share 0..1 of the prior in the information on each parameter.
    """

    rig: Rig
    x_world: NDArray
    residuals: NDArray
    sigma: float
    scatter: float
    covariance: NDArray
    ends: NDArray
    prior_share: NDArray


@dataclass(frozen=True, eq=False)
class _BarEquations(CameraEquations):
    residuals: NDArray
    misfit: NDArray  # (F,) [m] of the distance
    squares: float  # weighted squares of pixels alone
    count: int  # pixel coordinates


class BarProblem:
    """Observations and free parameters of the adjustment.

    Parameters
    ----------
    uv : (F, C, 2, 2) [px] of place, camera, end; NaN if unobserved.
    length : float [m]
    interiors : bool, whether intrinsics are free.
    sigma, scatter : float [px], [m] initial standard deviations.
    """

    def __init__(self, uv: NDArray, length: float, *, interiors: bool, sigma: float, scatter: float) -> None:
        self.uv, self.length, self.interiors = uv, length, interiors
        self.sigma, self.scatter = sigma, scatter
        self.columns = POSE + len(INTERIOR) * interiors
        self.free = np.ones((uv.shape[1], self.columns), bool)
        self.free[0, :POSE] = False

    def adjust(self, rig: Rig, x_world: NDArray, *, rounds: int = 4, iterations: int = 15) -> tuple[Rig, NDArray]:
        """Minimise the cost over the rig and ends (F, 2, 3) [m], with new variance components in every round."""
        for _ in range(rounds):
            system = descend(
                self.system(rig, x_world), lambda at, damping: at.arrow.relative_step(damping), self._moved,
                iterations=iterations, damping=1e-4, tolerance=1e-7,
            ).at  # fmt: skip
            rig, x_world = system.rig, system.unknowns
            before = self.sigma, self.scatter
            self._components(rig, system)
            if abs(self.sigma / before[0] - 1) < 0.02 and abs(self.scatter / before[1] - 1) < 0.1:
                break
        return rig, x_world

    def _moved(self, at: _BarEquations, move: tuple[NDArray, list[NDArray]]) -> _BarEquations | None:
        try:
            rig = moved_rig(at.rig, move[0], self.interiors)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            return None
        return self.system(rig, at.unknowns + move[1][0].reshape(at.unknowns.shape))

    def _components(self, rig: Rig, system: _BarEquations) -> None:
        """Estimate the variances of pixels and distance from their squares and shares of the redundancy."""
        cov, ends = system.covariances()
        prior = self._prior(rig)[0]
        x = self._normals
        of_length = np.einsum("fi,fij,fj->f", x, ends, x) / self.scatter**2
        places = len(self.uv)
        unknown = self.free.sum() + 6 * places - np.sum(of_length) - np.sum(prior * np.diag(cov))
        self.sigma = max(np.sqrt(system.squares / max(system.count - unknown, 1.0)) * self.sigma, _MIN_SIGMA_PX)
        square = 1.4826 * np.median(np.abs(system.misfit))  # robust: one wrong place must not weaken all others
        left = max(1.0 - float(np.mean(of_length)), 0.05)
        self.scatter = max(square / np.sqrt(left), _MIN_SCATTER * self.length)

    def result(self, rig: Rig, x_world: NDArray) -> BarBundle:
        """The bundle with covariances, at the rig and ends (F, 2, 3) [m] of `adjust`."""
        system = self.system(rig, x_world)
        cov, ends = system.covariances()
        prior = self._prior(rig)[0]
        share = np.clip(prior * np.diag(cov), 0.0, 1.0)
        return BarBundle(rig, x_world, system.residuals, self.sigma, self.scatter, cov, ends, share)

    def _prior(self, rig: Rig) -> tuple[NDArray, NDArray]:
        """Information (n,) and pull (n,) of the priors on single parameters (fx - fy is not one)."""
        information, pull = np.zeros(self.free.shape), np.zeros(self.free.shape)
        if self.interiors:
            for c, camera in enumerate(rig):
                width = max(camera.size)
                now = np.concatenate([camera.matrix[:2, 2] - (np.array(camera.size) - 1) / 2, camera.distortion])
                deviation = np.concatenate([np.full(2, _CENTRE_SIGMA * width), _DISTORTION_SIGMA])
                information[c, POSE + 2 :] = 1.0 / deviation**2
                pull[c, POSE + 2 :] = -now / deviation**2
        return information.ravel(), pull.ravel()

    def system(self, rig: Rig, x_world: NDArray) -> _BarEquations:
        """Linearise at a rig and ends (F, 2, 3) [m]."""
        place, view, end = np.nonzero(np.isfinite(self.uv).all(axis=(2, 3))[..., None] & np.ones(2, bool))
        P, M, C = self.columns, len(place), len(rig)
        A = np.zeros((M, 2, P + 7))  # derivatives by the camera, by the ends; residual
        for c, camera in enumerate(rig):
            own = view == c
            x = se3.apply(camera.T_camera_world, x_world[place[own], end[own]])
            uv, J, J_interior = pixel_columns(camera, np.where(x[:, 2:] > 1e-3, x, [0.0, 0.0, 1.0]), self.interiors)
            A[own, :, :P] = np.concatenate([J, np.cross(x[:, None], J), J_interior], axis=2) * self.free[c]
            of_end = (J @ camera.T_camera_world[:3, :3])[:, :, None] * (end[own, None] == (0, 1))[:, None, :, None]
            A[own, :, P:-1] = of_end.reshape(-1, 2, 6)
            A[own, :, -1] = np.where(x[:, 2:] > 1e-3, self.uv[place[own], c, end[own]] - uv, np.nan)
        fine = np.isfinite(A[..., -1]).all(axis=1).reshape(-1, 2).all(axis=1).repeat(2)  # both ends of a view
        A[~fine] = 0.0
        squares = np.sum(A[..., -1] ** 2, axis=1)
        rho, factor = huber(_HUBER).weigh(squares / self.sigma**2)
        w = np.where(fine, factor, 0.0) / self.sigma**2
        cost = float(rho.sum()) + 1e4 * float((~fine).sum())  # a constant that no step gains by
        residuals = np.full(self.uv.shape, np.nan)
        residuals[place, view, end] = np.where(fine[:, None], A[..., -1], np.nan)
        arrow = assembled(A.swapaxes(1, 2) @ (w[:, None, None] * A), view, place, C, len(self.uv), 6)
        information, pull = self._prior(rig)
        cost += float(np.sum(pull**2 / np.where(information > 0, information, 1.0)))
        arrow = arrow.with_prior(information + ~self.free.ravel(), pull)
        if self.interiors:
            cost += self._square_pixels(rig, arrow.H, arrow.g)
        misfit, more = self._distances(x_world, arrow.blocks[0])
        return _BarEquations(
            rig, x_world, arrow, self.free.ravel(), cost + more, residuals, misfit, float(w @ squares),
            2 * int(fine.sum()),
        )

    def _square_pixels(self, rig: Rig, H: NDArray, b: NDArray) -> float:
        """Add the prior fx - fy = 0 of each camera; returns its cost."""
        cost = 0.0
        for c, camera in enumerate(rig):
            weight, at = 1.0 / (_ASPECT_SIGMA * max(camera.size)) ** 2, c * self.columns + POSE
            off = float(camera.matrix[1, 1] - camera.matrix[0, 0])
            H[at : at + 2, at : at + 2] += weight * np.array([[1.0, -1.0], [-1.0, 1.0]])
            b[at : at + 2] += weight * off * np.array([1.0, -1.0])
            cost += weight * off**2
        return cost

    def _distances(self, x_world: NDArray, ends: Blocks) -> tuple[NDArray, float]:
        """Add |b - a| = length of each place; returns the misfits (F,) [m] and the cost."""
        way = x_world[:, 1] - x_world[:, 0]
        distance = np.linalg.norm(way, axis=1)
        n = way / np.maximum(distance, 1e-12)[:, None]
        self._normals = np.concatenate([-n, n], axis=1)
        misfit = self.length - distance
        rho, factor = huber(_HUBER).weigh((misfit / self.scatter) ** 2)
        w = factor / self.scatter**2
        ends.H[:] += w[:, None, None] * self._normals[:, :, None] * self._normals[:, None, :]
        ends.g[:] += (w * misfit)[:, None] * self._normals
        return misfit, float(rho.sum())
