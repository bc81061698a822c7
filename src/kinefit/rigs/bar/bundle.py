"""Self-calibrating bundle adjustment with a known distance (H.-G. Maas, 1998; Triggs et al., 1999, with Schur).

Unknowns are each camera's pose and intrinsics (fx, fy, cx, cy, k1, k2, p1, p2, k3) and both ends of the bar in every
place. Observations are the pixels of the ends and, in every place, the distance of the two (P4, section 2.2). A weak
prior is a common camera: a principal point near the image's centre, square pixels, little distortion. The first
camera's pose is fixed, and the distance fixes the scale: no gauge freedom remains. The noise of the pixels and the
scatter of the distance are estimated as variance components (W. Förstner, 1979).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import huber
from kinefit.rigs.bar.start import with_focal
from kinefit.solving.bundle.adjust import Bundle, BundleProblem, BundleState, adjust
from kinefit.solving.bundle.arrow import Arrow, assembled
from kinefit.solving.bundle.cameras import ASPECT, CENTRE, COLUMNS, DISTORTION, FOCAL, POSE, CameraPrior, pixel_rows

INTERIOR = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_CENTRE_SIGMA = 0.05  # of the image's width, of the principal point about the image's centre
_ASPECT_SIGMA = 0.02  # of the image's width, of fx - fy
_DISTORTION_SIGMA = np.array([0.5, 0.5, 0.02, 0.02, 0.3])  # of k1, k2, p1, p2, k3 about zero
_LOSS = huber(3.0)  # [standard deviations] all but 1 % of normal errors keep full weight
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
    covariance : (C, 15, C, 15) of the cameras' parameters: twist (v, ω) in the camera's frame, then `INTERIOR`; zero
        for fixed parameters.
    prior_share : (C, 15) share 0..1 of the prior in the information on each parameter.
    """

    rig: Rig
    x_world: NDArray
    residuals: NDArray
    sigma: float
    scatter: float
    covariance: NDArray
    prior_share: NDArray


def adjust_bar(
    rig: Rig, x_world: NDArray, problem: BarProblem, *, interiors: bool, rounds: int, iterations: int
) -> tuple[BundleState, CameraPrior, BarProblem]:  # fmt: skip
    """Minimise the cost over cameras and ends, with new variance components in every round; see `bar_bundle`.

    Parameters
    ----------
    x_world : (F, 2, 3) [m] ends to start from
    problem : with initial standard deviations
    interiors : whether intrinsics are free
    rounds, iterations : at most, and steps in each round
    """
    prior = _common_cameras(rig, interiors)
    state = BundleState(rig, np.zeros(len(rig)), x_world)
    for _ in range(rounds):
        found = adjust(state, prior, problem, iterations=iterations, damping=1e-4, tolerance=1e-7)
        state, before, problem = found.state, problem, problem.with_components(found)
        if abs(problem.sigma / before.sigma - 1) < 0.02 and abs(problem.scatter / before.scatter - 1) < 0.1:
            break
    return state, prior, problem


def bar_bundle(state: BundleState, prior: CameraPrior, problem: BarProblem) -> BarBundle:
    """An adjusted bundle with its covariance."""
    found, C = adjust(state, prior, problem, iterations=0), len(state.rig)
    cov, to_pixels = prior.full(found.posterior.covariances()[0]), np.zeros((C, 15, C, COLUMNS))
    for c, camera in enumerate(state.rig):
        (fx, fy), to_pixels[c, :, c, :-1] = np.diag(camera.matrix)[:2], np.eye(15)
        to_pixels[c, FOCAL : ASPECT + 1, c, FOCAL : ASPECT + 1] = [[fx, 0.0], [fy, fy]]
    share, J = np.zeros(prior.sigma.shape), to_pixels.reshape(-1, prior.sigma.size)
    share[prior.free] = np.clip(prior.precision * np.diag(cov)[prior.free.ravel()], 0.0, 1.0)
    covariance = (J @ cov @ J.T).reshape(C, 15, C, 15)
    return BarBundle(state.rig, state.blocks, found.detail, problem.sigma, problem.scatter, covariance, share[:, :-1])


def _common_cameras(rig: Rig, interiors: bool) -> CameraPrior:
    """A principal point near the image's centre, square pixels, little distortion; the first pose fixed."""
    sigma = np.zeros((len(rig), COLUMNS))
    sigma[1:, POSE] = np.inf
    if not interiors:
        return CameraPrior(rig, sigma)
    width, focal = (np.array([value(c) for c in rig]) for value in (lambda c: max(c.size), lambda c: c.matrix[0, 0]))
    sigma[:, FOCAL], sigma[:, ASPECT] = np.inf, _ASPECT_SIGMA * width / focal
    sigma[:, CENTRE], sigma[:, DISTORTION] = _CENTRE_SIGMA * width[:, None], _DISTORTION_SIGMA
    return CameraPrior(Rig(tuple(with_focal(c, f, False) for c, f in zip(rig, focal / width))), sigma)


@dataclass(frozen=True, eq=False)
class BarProblem(BundleProblem):
    """Pixels of the ends (F, 2, 3) [m] of a bar, the blocks, and its length.

    Parameters
    ----------
    uv : (F, C, 2, 2) [px] of place, camera, end; NaN if unobserved.
    length : float [m]
    sigma, scatter : float [px], [m] standard deviations of a pixel coordinate and of the distance
    """

    uv: NDArray
    length: float
    sigma: float
    scatter: float

    @cached_property
    def seen(self) -> tuple[NDArray, ...]:
        """Place, camera and end (M,) of every observed end, both of a view consecutive; (M, 3, 6) it by both ends."""
        place, view, end = np.nonzero(np.isfinite(self.uv).all(axis=(2, 3))[..., None] & np.ones(2, bool))
        return place, view, end, np.kron(np.eye(2)[end][:, None], np.eye(3))

    def moved(self, state: BundleState, delta: NDArray, moves: Sequence[NDArray]) -> BundleState:
        """The state with moved ends."""
        return replace(state, blocks=state.blocks + moves[0].reshape(state.blocks.shape))

    def with_components(self, found: Bundle) -> BarProblem:
        """The problem with variances of pixels and distance, from their squares and shares of the redundancy."""
        (cov, (ends,)), (misfit, normals) = found.posterior.covariances(), self._misfit(found.state.blocks)
        of_length = np.einsum("fi,fij,fj->f", normals, ends, normals) / self.scatter**2
        unknown = len(cov) + ends.shape[1] * len(ends) - np.sum(of_length) - found.prior.precision @ np.diag(cov)
        squares = np.sum(found.detail[np.isfinite(found.detail).all(axis=(2, 3))] ** 2, axis=2).ravel()
        weighted = squares @ _LOSS.factor(squares / self.sigma**2)
        sigma = np.sqrt(weighted / max(2 * len(squares) - unknown, 1.0))
        square = 1.4826 * np.median(np.abs(misfit))  # robust: a wrong place must not weaken all others
        left = max(1.0 - float(np.mean(of_length)), 0.05)
        scatter = max(square / np.sqrt(left), _MIN_SCATTER * self.length)
        return replace(self, sigma=max(sigma, _MIN_SIGMA_PX), scatter=scatter)

    def _misfit(self, x: NDArray) -> tuple[NDArray, NDArray]:
        """(F,) [m] by which ends (F, 2, 3) are too near to each other, and derivatives (F, 6) of their distance."""
        way = x[:, 1] - x[:, 0]
        distance = np.linalg.norm(way, axis=1)
        n = way / np.maximum(distance, 1e-12)[:, None]
        return self.length - distance, np.concatenate([-n, n], axis=1)

    def linearised(self, state: BundleState, prior: CameraPrior) -> tuple[Arrow, float, NDArray]:
        """Equations of cameras and ends; cost; residuals (F, C, 2, 2) [px], NaN if unobserved."""
        (place, view, end, by_ends), x = self.seen, state.blocks
        A = pixel_rows(state.rig, prior, view, x[place, end], self.uv[place, view, end], by_block=by_ends)
        fine = np.isfinite(A[..., -1]).all(axis=1).reshape(-1, 2).all(axis=1).repeat(2)  # both ends of a view
        residuals = np.full(self.uv.shape, np.nan)
        residuals[place, view, end] = np.where(fine[:, None], A[..., -1], np.nan)
        A[~fine] = 0.0
        rho, factor = _LOSS.weigh(np.sum(A[..., -1] ** 2, axis=1) / self.sigma**2)
        grams = A.swapaxes(1, 2) @ ((factor / self.sigma**2)[:, None, None] * A)
        arrow, (misfit, normals) = assembled(grams, view, place, prior.free, len(x)), self._misfit(x)
        of_length, factor = _LOSS.weigh((misfit / self.scatter) ** 2)
        weighted = (factor / self.scatter**2)[:, None] * normals
        arrow.blocks[0].H[:] += weighted[:, :, None] * normals[:, None, :]
        arrow.blocks[0].g[:] += misfit[:, None] * weighted
        hidden = 1e4 * float((~fine).sum())  # a constant that no step gains by
        return arrow, float(rho.sum() + of_length.sum()) + hidden, residuals
