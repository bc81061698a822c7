"""Alignment of a sensor's frame with the world of the videos, and whether its correction is reliable."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.sensors.displaced import AXES, displacement

MISFIT_SIGMAS = 3.0
"""Standard deviations, per degree of freedom, from which a sensor does not fit: chance alone exceeds it in fewer than
one of 10^8 takes, and those of the benchmark without misfit reach half of it."""

MIN_MISFIT = np.radians(0.5), 0.015
"""[rad], [m] rotation and shift, of which one must be exceeded: smaller ones are common calibration errors. Two
cameras, each with errors of 0.1 degree about and 3 mm along each axis, measure a person at 4 m with an error of 8 mm,
and rarely 15 mm."""

POSE_SIGMAS = 0.1, float(np.radians(5.0))
"""[m], [rad] prior standard deviations of a sensor's stated pose, about its own origin."""

_COVERAGE = 0.95  # share of errors within the error bars
_MONTE_CARLO_DRAWS = 4000  # for the error bars


@dataclass(frozen=True, eq=False)
class SensorAlignment:
    """Correction that aligns a sensor's frame with the world of the videos.

    Parameters
    ----------
    sensor : name
    kind : "depth" or "markers"
    twist : (7,) [m, rad, s] correction: shift of the centre, rotation vector, and clock offset.
    covariance : (7, 7) of the correction
    centre : (3,) [m] of the rotation, the middle of the person's positions
    falls : bool, whether the correction clearly reduces the person's distance from the measurements.
    doubts : reasons not to apply the correction, although the sensor does not fit; empty if it may be applied.
    """

    sensor: str
    kind: str
    twist: NDArray
    covariance: NDArray
    centre: NDArray
    falls: bool = True
    doubts: tuple[str, ...] = ()

    @property
    def T(self) -> NDArray:
        """Correction T (4, 4): x_world = T x, for a point x placed by the sensor's stated frame."""
        return displacement(dict(zip(AXES, self.twist)), self.centre)

    @property
    def shift(self) -> float:
        """Shift [m] at the centre of the person's positions."""
        return float(np.linalg.norm(self.twist[:3]))

    @property
    def turn(self) -> float:
        """Rotation angle [rad]."""
        return float(np.linalg.norm(self.twist[3:6]))

    @cached_property
    def bars(self) -> tuple[float, float]:
        """Error bars [m], [rad]: 95 % of the errors of shift and rotation are shorter."""
        z = np.random.default_rng(0).standard_normal((_MONTE_CARLO_DRAWS, 7)) @ np.linalg.cholesky(self.covariance).T
        shift, turn = (np.linalg.norm(z[:, part], axis=1) for part in (slice(3), slice(3, 6)))
        return float(np.quantile(shift, _COVERAGE)), float(np.quantile(turn, _COVERAGE))

    @property
    def deviations(self) -> float:
        """Distance of shift and rotation from zero, in standard deviations per degree of freedom; a number >= 0."""
        return per_freedom(self.twist, self.covariance)

    @property
    def misfit(self) -> bool:
        """Whether the sensor does not fit: significantly and by more than common errors, or with doubts."""
        is_large = self.turn > MIN_MISFIT[0] or self.shift > MIN_MISFIT[1]
        return bool(self.doubts) or (self.deviations > MISFIT_SIGMAS and is_large)


def per_freedom(twist: NDArray, covariance: NDArray) -> float:
    """Mahalanobis length, per degree of freedom, of shift and rotation of a twist (7,) with covariance (7, 7)."""
    moved, C = twist[:6], covariance[:6, :6]
    return float(np.sqrt(moved @ np.linalg.solve(C, moved) / 6.0))


def doubts_of(
    fit: SensorAlignment,
    origin: NDArray,
    halves: tuple[SensorAlignment, SensorAlignment],
    rivals: tuple[NDArray, ...] = (),
) -> tuple[str, ...]:
    """Reasons not to apply a sensor's correction, in words that follow "because"; empty if there are none.

    Parameters
    ----------
    fit : SensorAlignment, whose covariance includes the disagreement of the halves.
    origin : (3,) [m] of the sensor's frame: a camera's centre.
    halves : fits of two halves of the frames, without the systematic error of the surface.
    rivals : twists (7,) from the best solution to those of other starts that fit as well.
    """
    out = []
    shift, turn = fit.bars
    off = [(float(np.linalg.norm(r[:3])), float(np.linalg.norm(r[3:6]))) for r in rivals]
    far = [(s, t) for s, t in off if s > shift or t > turn]
    if far:
        s, t = max(far)
        amount = f"{np.degrees(t):.1f}° and {1e3 * s:.0f} mm"
        out.append(f"another pose, {amount} away, fits about as well")
    if not fit.falls:
        out.append("its measurements then lie no nearer to the person")
    moved = float(np.linalg.norm(se3.apply(fit.T, origin) - origin))
    if moved > MISFIT_SIGMAS * POSE_SIGMAS[0] or fit.turn > MISFIT_SIGMAS * POSE_SIGMAS[1]:
        limit = f"{1e2 * MISFIT_SIGMAS * POSE_SIGMAS[0]:.0f} cm or {np.degrees(MISFIT_SIGMAS * POSE_SIGMAS[1]):.0f}°"
        out.append(f"it would move by {1e2 * moved:.0f} cm and turn by {np.degrees(fit.turn):.0f}°: more than {limit}")
    a, b = halves
    between = per_freedom(a.twist - b.twist, a.covariance + b.covariance)
    if between > MISFIT_SIGMAS:
        out.append(f"two halves of the frames disagree by {between:.1f} standard deviations")
    elif not fit.misfit:
        out.append("the misfit is within the disagreement of two halves of the frames")
    return tuple(out)


def marker_index(sensor: str) -> int:
    """Index of a sensor among the take's [[markers]]."""
    number = sensor.removeprefix("markers").strip()
    return int(number) - 1 if number else 0
