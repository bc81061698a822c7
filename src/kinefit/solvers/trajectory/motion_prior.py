"""How a body moves when nobody looks: the prior on how motion changes, and on the posture (see `solvers.smoothing`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """How a body moves when nobody looks.

    Parameters
    ----------
    acceleration : (n,) [m/s², rad/s²] one standard deviation, of every degree of freedom.
    memory : (float, float) [s] in which an acceleration and a velocity forget themselves by 1/e.
    dt : float [s] between frames.
    usual : (T, D) or (D,) [rad or m] posture, in the chart of the angles.
    spread : (D,) [rad or m]
        Standard deviation of an angle that nothing observes, about the usual one.
    couplings : (C, D) [1/rad or 1/m], optional
        Departures from it that go together, see `KinematicTree`.
    liveliness : (T, n), optional
        How much more than `acceleration` it is at times: a factor for every r_s, the last one for none.
    """

    acceleration: NDArray
    memory: tuple[float, float]
    dt: float
    usual: NDArray
    spread: NDArray
    liveliness: NDArray | None = None
    couplings: NDArray | None = None

    @property
    def coupled(self) -> bool:
        """Whether the posture couples coordinates, beyond the tree's pattern."""
        return self.couplings is not None and len(self.couplings) > 0

    @property
    def precision(self) -> NDArray:
        """(D, D) inverse covariance of the posture."""
        out: NDArray = np.diag(np.square(1.0 / self.spread))
        return out if self.couplings is None else out + self.couplings.T @ self.couplings

    @property
    def keep(self) -> tuple[float, float]:
        """λ and κ, shares of an acceleration and of a velocity that are left one frame later."""
        fast, slow = np.exp(-self.dt / np.array(self.memory))
        return float(fast), float(slow)

    @property
    def weight(self) -> NDArray:
        """(n,) inverse variance of r, 1/(a² Δt⁴ (1 − λ²))."""
        return 1.0 / (np.square(self.acceleration * self.dt**2) * (1.0 - self.keep[0] ** 2))

    def rows(self, count: int) -> tuple[NDArray, NDArray]:
        """What r_s takes from v_{s−1} and v_{s−2}, (count, 2), and weights (count, n).

        The first two steps have no past; they are as likely as any two of a motion that goes on for ever.
        """
        fast, slow = self.keep
        past = np.tile([fast + slow, -fast * slow], (count, 1))
        weight = np.tile(self.weight, (count, 1))
        if self.liveliness is not None:
            weight /= np.square(self.liveliness[:count])
        past[:1], past[1:2] = 0.0, [(fast + slow) / (1 + fast * slow), 0.0]
        weight[:1] *= (1 - fast * slow) * ((1 + fast * slow) ** 2 - (fast + slow) ** 2) / (1 + fast * slow)
        weight[1:2] *= 1 - (fast * slow) ** 2
        return past, weight

    @property
    def posture_share(self) -> NDArray:
        """(D, D) weight that the usual posture has in each frame of a covariance.

        In the fit it weighs its `precision` in every frame, as much against the pixels as in the fit of a single frame:
        both err the same way in frame after frame. But a posture is not drawn anew in every frame. Here its weight is
        such that angles that nothing observes have the covariance precision⁻¹ in the middle of a long take. In
        coordinates scaled to a motion prior of weight one, that is an equation for each principal axis of the precision
        by itself: with variance σ² along it, σ² = ∫₀^π dθ/π / (w + |(1 − z)(1 − κ z)(1 − λ z)|²) with z = e^{iθ}.
        """
        root = np.sqrt(self.weight[6:])
        values, axes = np.linalg.eigh(self.precision / root[:, None] / root)
        told = values > 1e-12 * values.max(initial=0.0)
        share = np.zeros(len(values))
        share[told] = self._shares(1.0 / values[told])
        return np.asarray(root[:, None] * (axes * share) @ axes.T * root)

    def _shares(self, variance: NDArray) -> NDArray:
        """(K,) weights w for variances (K,) under a motion prior of weight one, see `posture_share`."""
        lowest = 1e-6
        theta = np.geomspace(lowest, np.pi, 2000)
        z = np.exp(1j * theta)
        prior = np.abs((1 - z) * (1 - self.keep[0] * z) * (1 - self.keep[1] * z)) ** 2
        width = np.zeros(len(theta))  # of the trapezoidal rule; below the lowest all is as there
        width[1:], width[0] = 0.5 * np.diff(theta), lowest
        width[:-1] += 0.5 * np.diff(theta)
        low, high = np.full(len(variance), -80.0), np.full(len(variance), 80.0)  # of log w
        log, wanted = -np.log(variance), np.log(variance)
        for _ in range(60):  # Newton's method on logarithms, halves where it leaves what is known
            density = 1.0 / (np.exp(log)[:, None] + prior)
            whole = density @ width / np.pi
            wide = whole > variance
            low, high = np.where(wide, log, low), np.where(wide, high, log)
            slope = -np.exp(log) * (np.square(density) @ width) / np.pi / whole
            step = (wanted - np.log(whole)) / np.where(slope < 0.0, slope, -1.0)
            if np.abs(step).max(initial=0.0) < 1e-9:  # the next would be less than rounding
                return np.exp(log + step)
            log = np.where((log + step > low) & (log + step < high), log + step, 0.5 * (low + high))
        return np.exp(log)
