"""What movements are found by: heights of hips, soles and centre of mass over the floor, with y up."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.exporters.report.feet import BALL, HEEL, peaks, smoothed

_FLOOR_PERCENTILE = 5.0  # of the lower sole's height
_MIN_DEPTH, _END_SHARE = 0.1, 0.05  # shares: of the stature that hips sink at least; of a drop that is bottom or top
_HEIGHT_NOISE_M = 0.002  # of smooth hips from frame to frame; what lasts moves no time
_MIN_APART_S = 0.5  # between two lowest places


@dataclass(frozen=True)
class Repetition:
    """One jump, squat or rise from a seat.

    Parameters
    ----------
    kind : "jump", "squat" or "sit to stand"
    start, stop : [s]
    values : {quantity [unit]: (value, standard deviation)}
    """

    kind: str
    start: float
    stop: float
    values: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Drop:
    """Hips that sink and rise again.

    Parameters
    ----------
    begin : last frame of standing; -1 if the person did not stand before
    down, low, up : first frame at the bottom, the lowest, and the last one at the bottom
    end : first frame of standing again
    """

    begin: int
    down: int
    low: int
    up: int
    end: int


@dataclass(frozen=True, eq=False)
class Course:
    """Heights of a motion over the floor; the body has hips, heels and balls of the feet."""

    motion: Motion
    landmarks: tuple[str, ...] = field(default=tuple(f"{s}_{n}" for n in ("hip", HEEL, *BALL) for s in "lr"))

    @cached_property
    def _places(self) -> NDArray:
        """(F, 4, 2, 3) [m] hips, heels and both balls of the left and the right side, floor at zero, y up."""
        points = self.motion.positions(self.motion.body.landmarks.select(self.landmarks))
        places = (points @ rotation_between_up(self.motion.up, "y").T).reshape(len(self.motion), 4, 2, 3)
        places[..., 1] -= np.percentile(places[:, 1:, :, 1].min(axis=(1, 2)), _FLOOR_PERCENTILE)
        return places

    @property
    def sole(self) -> NDArray:
        """(F,) [m] height of the lowest point of both feet."""
        return np.asarray(self._places[:, 1:, :, 1].min(axis=(1, 2)))

    @property
    def hips(self) -> NDArray:
        """(F,) [m] height of the middle of the hips."""
        return np.asarray(self._places[:, 0, :, 1].mean(axis=1))

    @cached_property
    def centre(self) -> NDArray:
        """(F, 3) [m] centre of mass, y up."""
        return self.motion.centre_of_mass @ rotation_between_up(self.motion.up, "y").T

    @property
    def behind(self) -> NDArray:
        """(F,) [m] how far the centre of mass is behind the heels: who does not fall then sits."""
        heels, balls = self._places[:, 1].mean(axis=1), self._places[:, 2:].mean(axis=(1, 2))
        foot = (balls - heels)[:, ::2]
        away = (self.centre - heels)[:, ::2]
        return -np.asarray(np.sum(away * foot, axis=1) / np.linalg.norm(foot, axis=1))

    @property
    def height_std(self) -> NDArray:
        """(F,) [m] upper bound of the standard deviation of heights."""
        return self.motion.turned("y").centre_of_mass_std[:, 1]

    @cached_property
    def smooth_hips(self) -> NDArray:
        """(F,) [m] the hips' height without what is faster than walking."""
        return smoothed(self.hips, self.motion.rate)

    def time_std(self, frame: int) -> float:
        """[s] standard deviation of the time of a height of the hips, t of noise n = |v| t + |a| t² / 2."""
        step = 1.0 / self.motion.rate
        speed = np.gradient(self.smooth_hips, step)
        v, a = abs(float(speed[frame])), abs(float(np.gradient(speed, step)[frame])) + 1e-6
        return float(np.hypot(step / np.sqrt(12.0), (np.sqrt(v**2 + 2.0 * a * _HEIGHT_NOISE_M) - v) / a))

    def drops(self) -> list[Drop]:
        """Every time that the hips sink by a tenth of the stature and rise again."""
        motion, hips, out = self.motion, self.smooth_hips, []
        least = _MIN_DEPTH * (motion.body.stature or 1.7)
        lows = peaks(-hips, least, round(_MIN_APART_S * motion.rate))
        ends = [0, *lows.tolist(), len(hips) - 1]
        for before, low, after in zip(ends, ends[1:], ends[2:]):
            left, right = hips[before : low + 1][::-1] - hips[low], hips[low : after + 1] - hips[low]
            if right.max() < least:
                continue
            stood = left.max() > 0.5 * right.max()
            (down, high), (up, top) = (_ends_of(side) for side in (left if stood else right, right))
            out.append(Drop(low - high if stood else -1, max(low - down, before), low, low + up, low + top))
        return out


def _ends_of(rise: NDArray) -> tuple[int, int]:
    """Last frame at the bottom and first frame at the top of a course that rises from zero."""
    return int(np.argmax(rise > _END_SHARE * rise.max())) - 1, int(np.argmax(rise > (1.0 - _END_SHARE) * rise.max()))
