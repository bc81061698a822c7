"""Self-calibrating bundle adjustment with a known distance (H.-G. Maas, 1998; Triggs et al., 1999, with Schur).

Unknown are each camera's pose and interior (fx, fy, cx, cy, k1, k2, p1, p2, k3) and both ends of the bar in every
place. Observed are the pixels of the ends, in every place the distance of the two (P4, section 2.2), and, weakly, what
any camera is like: a centre near that of the image, square pixels, little distortion. The first camera's pose is
fixed, and the distance fixes the scale: no freedom is left over. The noise of the pixels and the scatter of the
distance are estimated as variance components (W. Förstner, 1979).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.calibration.board.bundle import CameraEquations, moved_camera, pixel_columns
from kinefit.geometry.camera import Rig
from kinefit.solvers.least_squares import descend

POSE = 6
INTERIOR = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_CENTRE = 0.05  # of the image's width: standard deviation of a centre about the image's
_SQUARE = 0.02  # of the image's width: standard deviation of fx - fy
_LENS = np.array([0.5, 0.5, 0.02, 0.02, 0.3])  # standard deviations of k1, k2, p1, p2, k3 about none
_HUBER = 3.0  # standard deviations; all but 1 % of normal errors keep full weight
_LEAST_NOISE = 0.005  # [px]
_LEAST_SCATTER = 1e-6  # of the length


@dataclass(frozen=True, eq=False)
class BarBundle:
    """Cameras and places of the bar that agree best.

    Parameters
    ----------
    rig : Rig, the first camera where it was.
    x_world : (F, 2, 3) [m] ends of the bar.
    residuals : (F, C, 2, 2) [px] measured minus seen; NaN where unseen.
    sigma : float [px] standard deviation of a pixel coordinate.
    scatter : float [m] standard deviation of the distance of the ends in one place.
    covariance : (C · P, C · P) of the cameras' parameters, P = 6 for the twist (v, ω) in the camera's frame, and 9
        for the interior where that was estimated; zero for what is fixed.
    ends : (F, 6, 6) [m²] covariance of each place's ends.
    prior_share : (C · P,) share of the information on each parameter that is the prior's, 0 to 1.
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


_Linearised = tuple[Rig, NDArray, _BarEquations]


class BarProblem:
    """What was observed, and what may change.

    Parameters
    ----------
    uv : (F, C, 2, 2) [px] of place, camera, end; NaN where unseen.
    length : float [m]
    interiors : bool, whether they change too.
    sigma, scatter : float [px], [m] standard deviations to begin with.
    """

    def __init__(self, uv: NDArray, length: float, *, interiors: bool, sigma: float, scatter: float) -> None:
        self.uv, self.length, self.interiors = uv, length, interiors
        self.sigma, self.scatter = sigma, scatter
        self.columns = POSE + len(INTERIOR) * interiors
        self.free = np.ones((uv.shape[1], self.columns), bool)
        self.free[0, :POSE] = False

    def adjust(self, rig: Rig, x_world: NDArray, *, rounds: int = 4, iterations: int = 15) -> tuple[Rig, NDArray]:
        """Damped Gauss-Newton to the least cost, the variance components anew in every round."""
        for _ in range(rounds):
            begin, stop = (rig, x_world, self.system(rig, x_world)), 1e-7
            found, _ = descend(begin, lambda at: at[2].cost, self._step, iterations=iterations, tolerance=stop)
            rig, x_world, system = found
            before = self.sigma, self.scatter
            self._components(rig, system)
            if abs(self.sigma / before[0] - 1) < 0.02 and abs(self.scatter / before[1] - 1) < 0.1:
                break
        return rig, x_world

    def _step(self, now: _Linearised, damping: float) -> _Linearised | None:
        cameras, ends = now[2].step(damping)
        try:
            parts = zip(now[0], cameras.reshape(self.free.shape))
            rig = Rig(tuple(moved_camera(c, d, self.interiors) for c, d in parts))
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            return None
        x_world = now[1] + ends.reshape(now[1].shape)
        return rig, x_world, self.system(rig, x_world)

    def _components(self, rig: Rig, system: _BarEquations) -> None:
        """Variances of pixels and distance, each from its squares and its share of the redundancy."""
        cov, ends = system.covariances()
        prior = self._prior(rig)[0]
        x = self._normals
        of_length = np.einsum("fi,fij,fj->f", x, ends, x) / self.scatter**2
        places = len(self.uv)
        unknown = self.free.sum() + 6 * places - np.sum(of_length) - np.sum(prior * np.diag(cov))
        self.sigma = max(np.sqrt(system.squares / max(system.count - unknown, 1.0)) * self.sigma, _LEAST_NOISE)
        square = 1.4826 * np.median(np.abs(system.misfit))  # robust: one wrong place must not loosen all others
        left = max(1.0 - float(np.mean(of_length)), 0.05)
        self.scatter = max(square / np.sqrt(left), _LEAST_SCATTER * self.length)

    def result(self, rig: Rig, x_world: NDArray) -> BarBundle:
        """With covariances, at what `adjust` gave."""
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
                deviation = np.concatenate([np.full(2, _CENTRE * width), _LENS])
                information[c, POSE + 2 :] = 1.0 / deviation**2
                pull[c, POSE + 2 :] = -now / deviation**2
        return information.ravel(), pull.ravel()

    def system(self, rig: Rig, x_world: NDArray) -> _BarEquations:
        """Linearise at a rig and ends."""
        F, C, P = len(self.uv), len(rig), self.columns
        H, b, cross = np.zeros((C * P, C * P)), np.zeros(C * P), np.zeros((F, 6, C * P))
        Hp, bp = np.zeros((F, 6, 6)), np.zeros((F, 6))
        residuals, cost, squares, total = np.full(self.uv.shape, np.nan), 0.0, 0.0, 0
        for c, camera in enumerate(rig):
            seen = np.isfinite(self.uv[:, c]).all(axis=(1, 2))
            x = (x_world[seen] @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]).reshape(-1, 3)
            front = (x[:, 2] > 1e-3).reshape(-1, 2).all(axis=1)
            uv, J, J_interior = pixel_columns(camera, np.where(x[:, 2:] > 1e-3, x, [0.0, 0.0, 1.0]), self.interiors)
            left = self.uv[seen, c].reshape(-1, 2) - uv
            fine = np.repeat(front & np.isfinite(left).reshape(-1, 4).all(axis=1), 2)
            left = np.where(fine[:, None], left, 0.0)
            size = np.linalg.norm(left, axis=1) / self.sigma
            w = np.where(fine, np.minimum(1.0, _HUBER / np.maximum(size, 1e-12)), 0.0) / self.sigma**2
            behind = 1e4 * (~fine).sum()  # a constant that no step gains by
            cost += float(np.sum(np.where(size < _HUBER, size**2, _HUBER * (2 * size - _HUBER))) + behind)
            squares, total = squares + float(np.sum(w[:, None] * left**2)), total + 2 * int(fine.sum())
            of_camera = np.concatenate([J, np.cross(x[:, None], J), J_interior], axis=2) * self.free[c]
            of_camera = np.where(fine[:, None, None], of_camera, 0.0)
            of_end = np.where(fine[:, None, None], J @ camera.T_camera_world[:3, :3], 0.0)
            weighted = w[:, None, None] * of_camera
            mine = slice(c * P, (c + 1) * P)
            H[mine, mine] = np.tensordot(weighted, of_camera, axes=([0, 1], [0, 1]))
            b[mine] = np.einsum("nkp,nk->p", weighted, left)
            Hx = np.einsum("nki,nkj->nij", w[:, None, None] * of_end, of_end).reshape(-1, 2, 3, 3)
            bx = np.einsum("nki,nk->ni", w[:, None, None] * of_end, left).reshape(-1, 6)
            places = np.flatnonzero(seen)
            for e in (0, 1):
                part = slice(3 * e, 3 * e + 3)
                Hp[places, part, part] += Hx[:, e]
            bp[places] += bx
            cross[places, :, mine] = np.einsum("nki,nkp->nip", of_end, weighted).reshape(-1, 6, P)
            residuals[places, c] = np.where(fine[:, None], left, np.nan).reshape(-1, 2, 2)
        information, pull = self._prior(rig)
        cost += float(np.sum(pull**2 / np.where(information > 0, information, 1.0)))
        H, b = H + np.diag(information), b + pull
        if self.interiors:
            cost += self._square_pixels(rig, H, b)
        misfit, more = self._distances(x_world, Hp, bp)
        return _BarEquations(H, b, Hp, bp, cross, self.free.ravel(), cost + more, residuals, misfit, squares, total)

    def _square_pixels(self, rig: Rig, H: NDArray, b: NDArray) -> float:
        """Add fx - fy = 0 of each camera; its cost."""
        cost = 0.0
        for c, camera in enumerate(rig):
            weight, at = 1.0 / (_SQUARE * max(camera.size)) ** 2, c * self.columns + POSE
            off = float(camera.matrix[1, 1] - camera.matrix[0, 0])
            H[at : at + 2, at : at + 2] += weight * np.array([[1.0, -1.0], [-1.0, 1.0]])
            b[at : at + 2] += weight * off * np.array([1.0, -1.0])
            cost += weight * off**2
        return cost

    def _distances(self, x_world: NDArray, Hp: NDArray, bp: NDArray) -> tuple[NDArray, float]:
        """Add |b - a| = length of each place; what is missing [m], and the cost."""
        way = x_world[:, 1] - x_world[:, 0]
        distance = np.linalg.norm(way, axis=1)
        n = way / np.maximum(distance, 1e-12)[:, None]
        self._normals = np.concatenate([-n, n], axis=1)
        misfit = self.length - distance
        size = np.abs(misfit) / self.scatter
        w = np.minimum(1.0, _HUBER / np.maximum(size, 1e-12)) / self.scatter**2
        Hp += w[:, None, None] * self._normals[:, :, None] * self._normals[:, None, :]
        bp += (w * misfit)[:, None] * self._normals
        return misfit, float(np.sum(np.where(size < _HUBER, size**2, _HUBER * (2 * size - _HUBER))))
