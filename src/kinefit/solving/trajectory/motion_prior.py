"""The motion prior: changes of motion, and posture (see `solvers.trajectory.smoothing`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Prior of a motion without measurements.

    Parameters
    ----------
    acceleration : (n,) [m/s², rad/s²] random acceleration of every degree of freedom, one standard deviation
    memory : (float, float) [s] time constants with which an acceleration and a velocity decay
    dt : float [s] between frames
    mean : (T, D) or (D,) [rad or m] mean of the posture prior, in the chart of the angles
    spread : (D,) [rad or m]
        Standard deviation of the posture prior.
    couplings : (C, D) [1/rad or 1/m], optional
        Correlated departures from the mean, see `KinematicTree`.
    activity : (T, n), optional
        Factor on `acceleration` for every r_s; the last one is not used.
    """

    acceleration: NDArray
    memory: tuple[float, float]
    dt: float
    mean: NDArray
    spread: NDArray
    activity: NDArray | None = None
    couplings: NDArray | None = None

    @property
    def coupled(self) -> bool:
        """Whether the posture prior couples coordinates beyond the tree's pattern."""
        return self.couplings is not None and len(self.couplings) > 0

    @property
    def precision(self) -> NDArray:
        """(D, D) inverse covariance of the posture prior."""
        out: NDArray = np.diag(np.square(1.0 / self.spread))
        return out if self.couplings is None else out + self.couplings.T @ self.couplings

    @property
    def keep(self) -> tuple[float, float]:
        """λ and κ, shares of an acceleration and of a velocity that remain after one frame."""
        fast, slow = np.exp(-self.dt / np.array(self.memory))
        return float(fast), float(slow)

    @property
    def weight(self) -> NDArray:
        """(n,) inverse variance of r, 1/(a² Δt⁴ (1 − λ²))."""
        return 1.0 / (np.square(self.acceleration * self.dt**2) * (1.0 - self.keep[0] ** 2))

    def rows(self, count: int) -> tuple[NDArray, NDArray]:
        """Coefficients (count, 2) of v_{s−1} and v_{s−2} in r_s, and weights (count, n), of `count` (int) steps.

        The first two steps have no past; they have the stationary distribution.
        """
        fast, slow = self.keep
        past = np.tile([fast + slow, -fast * slow], (count, 1))
        weight = np.tile(self.weight, (count, 1))
        if self.activity is not None:
            weight /= np.square(self.activity[:count])
        past[:1], past[1:2] = 0.0, [(fast + slow) / (1 + fast * slow), 0.0]
        weight[:1] *= (1 - fast * slow) * ((1 + fast * slow) ** 2 - (fast + slow) ** 2) / (1 + fast * slow)
        weight[1:2] *= 1 - (fast * slow) ** 2
        return past, weight

    @property
    def posture_share(self) -> NDArray:
        """(D, D) weight of the posture prior in each frame of a covariance.

        In the fit its weight is `precision` in every frame, relative to the pixels as in the fit of a single frame,
        since both have constant errors. But postures of neighbouring frames are not independent. So in covariances the
        weight is such that unobserved angles have the covariance precision⁻¹ in the middle of a long take. In
        coordinates scaled to a motion prior of weight one, this is one equation for each principal axis of the
        precision: with variance σ² along it, σ² = ∫₀^π dθ/π / (w + |(1 − z)(1 − κ z)(1 − λ z)|²) with z = e^{iθ}.
        """
        root = np.sqrt(self.weight[6:])
        values, axes = np.linalg.eigh(self.precision / root[:, None] / root)
        has_prior = values > 1e-12 * values.max(initial=0.0)
        share = np.zeros(len(values))
        share[has_prior] = self._shares(1.0 / values[has_prior])
        return np.asarray(root[:, None] * (axes * share) @ axes.T * root)

    def _shares(self, variance: NDArray) -> NDArray:
        """(K,) weights w for variances (K,) under a motion prior of weight one, see `posture_share`."""
        lowest = 1e-6
        theta = np.geomspace(lowest, np.pi, 2000)
        z = np.exp(1j * theta)
        prior = np.abs((1 - z) * (1 - self.keep[0] * z) * (1 - self.keep[1] * z)) ** 2
        width = np.zeros(len(theta))  # of the trapezoidal rule; constant below the lowest
        width[1:], width[0] = 0.5 * np.diff(theta), lowest
        width[:-1] += 0.5 * np.diff(theta)
        low, high = np.full(len(variance), -80.0), np.full(len(variance), 80.0)  # of log w
        log, wanted = -np.log(variance), np.log(variance)
        for _ in range(60):  # Newton's method on logarithms, bisection where it leaves the bracket
            density = 1.0 / (np.exp(log)[:, None] + prior)
            whole = density @ width / np.pi
            wide = whole > variance
            low, high = np.where(wide, log, low), np.where(wide, high, log)
            slope = -np.exp(log) * (np.square(density) @ width) / np.pi / whole
            step = (wanted - np.log(whole)) / np.where(slope < 0.0, slope, -1.0)
            if np.abs(step).max(initial=0.0) < 1e-9:  # the next step would be below rounding
                return np.exp(log + step)
            log = np.where((log + step > low) & (log + step < high), log + step, 0.5 * (low + high))
        return np.exp(log)
