"""How a sensor's frame lies against the world of the videos, and whether that may be written."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry import se3
from kinefit.sensors.displaced import AXES, displacement

SURE = 3.0
"""Standard deviations, per degree of freedom, from which a sensor does not fit: chance alone exceeds it in fewer than
one of 10^8 takes, and those of the benchmark without misfit reach half of it."""

MATTERS = np.radians(0.5), 0.015
"""[rad], [m] of which one must be exceeded: less is what calibrations usually are off by. Two cameras, each wrong by
0.1 degree about and 3 mm along each axis, see a person 4 m away 8 mm off, and hardly ever 15 mm."""

PRIOR = 0.1, float(np.radians(5.0))
"""[m], [rad] standard deviations of what a sensor's stated pose is off by, about its own origin."""

_INSIDE, _DRAWS = 0.95, 4000  # share of errors within the bars that are stated; numbers drawn for that


@dataclass(frozen=True, eq=False)
class SensorAlignment:
    """How a sensor's frame lies against the world of the videos.

    Parameters
    ----------
    sensor : name
    kind : "depth" or "markers"
    twist : (7,) [m, rad, s] shift of the centre, rotation vector, and clock: what must be done to the sensor.
    covariance : (7, 7) of them
    centre : (3,) [m] about which it turns, the middle of where the person was
    falls : whether the person's distance from what it measured clearly falls if that is done.
    doubts : why it is not to be done, although the sensor does not fit; none where it may be done.
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
        """(4, 4) x_world = T x, of a point x as the sensor's frame is stated to place it."""
        return displacement(dict(zip(AXES, self.twist)), self.centre)

    @property
    def shift(self) -> float:
        """[m] in the middle of where the person was."""
        return float(np.linalg.norm(self.twist[:3]))

    @property
    def turn(self) -> float:
        """[rad]."""
        return float(np.linalg.norm(self.twist[3:6]))

    @cached_property
    def bars(self) -> tuple[float, float]:
        """[m], [rad] within which 95 % of the errors of shift and turn have their length."""
        z = np.random.default_rng(0).standard_normal((_DRAWS, 7)) @ np.linalg.cholesky(self.covariance).T
        shift, turn = (np.linalg.norm(z[:, part], axis=1) for part in (slice(3), slice(3, 6)))
        return float(np.quantile(shift, _INSIDE)), float(np.quantile(turn, _INSIDE))

    @property
    def deviations(self) -> float:
        """How many standard deviations the six of shift and turn are from none, per degree of freedom."""
        return per_freedom(self.twist, self.covariance)

    @property
    def misfit(self) -> bool:
        """Whether the sensor surely does not fit, by more than is usual, or was found so and that is in doubt."""
        return bool(self.doubts) or (self.deviations > SURE and (self.turn > MATTERS[0] or self.shift > MATTERS[1]))


def per_freedom(twist: NDArray, covariance: NDArray) -> float:
    """Standard deviations of shift and turn, per degree of freedom, of a twist (7,) with covariance (7, 7)."""
    moved, C = twist[:6], covariance[:6, :6]
    return float(np.sqrt(moved @ np.linalg.solve(C, moved) / 6.0))


def doubts_of(
    fit: SensorAlignment,
    origin: NDArray,
    halves: tuple[SensorAlignment, SensorAlignment],
    rivals: tuple[NDArray, ...] = (),
) -> tuple[str, ...]:
    """Why a sensor is not to be moved, in words that follow "because"; none where all is well.

    Parameters
    ----------
    fit : SensorAlignment, with what the halves disagree by in its covariance.
    origin : (3,) [m] of the sensor's frame: a camera's centre.
    halves : as two halves of the frames have it, without what the surface leaves wrong.
    rivals : twists (7,), from the lowest end to those of other starts that explain what was measured as well.
    """
    out = []
    shift, turn = fit.bars
    off = [(float(np.linalg.norm(r[:3])), float(np.linalg.norm(r[3:6]))) for r in rivals]
    far = [(s, t) for s, t in off if s > shift or t > turn]
    if far:
        s, t = max(far)
        amount = f"{np.degrees(t):.1f}° and {1e3 * s:.0f} mm"
        out.append(f"another place, {amount} from there, fits about as well")
    if not fit.falls:
        out.append("the person then lies no nearer to what it measured")
    moved = float(np.linalg.norm(se3.apply(fit.T, origin) - origin))
    if moved > SURE * PRIOR[0] or fit.turn > SURE * PRIOR[1]:
        usual = f"{1e2 * SURE * PRIOR[0]:.0f} cm or {np.degrees(SURE * PRIOR[1]):.0f}°"
        out.append(f"it would move by {1e2 * moved:.0f} cm and turn by {np.degrees(fit.turn):.0f}°: more than {usual}")
    a, b = halves
    between = per_freedom(a.twist - b.twist, a.covariance + b.covariance)
    if between > SURE:
        out.append(f"two halves of the frames disagree by {between:.1f} standard deviations")
    elif not fit.misfit:
        out.append("by what two halves of the frames disagree, it may fit")
    return tuple(out)


def marker_index(sensor: str) -> int:
    """Which of the take's [[markers]] a sensor is."""
    number = sensor.removeprefix("markers").strip()
    return int(number) - 1 if number else 0
