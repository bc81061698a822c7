"""Errors of a motion that last longer than one frame, and with them the covariance between its frames.

A range of motion is the difference of two frames. What both have in common is not in it: the bones' lengths, where the
detector places a joint, the cameras. So the standard deviation of a difference is not that of two independent values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

_KEY_FRAMES_PER_S = 20.0  # The sigma of differences on the balancing trial is within 2.6 % of that with every frame,
# 0.5 % for nine tenths; with 10 a second within 8 %.


def key_frames(frames: int, rate: float) -> NDArray:
    """(K,) int, increasing: of so many frames at a rate [Hz] those in which lasting errors are computed."""
    count = min(frames, round(frames / rate * _KEY_FRAMES_PER_S) + 2)
    return np.unique(np.linspace(0, frames - 1, count).round().astype(int))


def between(keys: NDArray, frames: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Indices of the key frames (K,) before and after frames (...,) int, and the share 0..1 of the way between them."""
    after = np.minimum(np.maximum(np.searchsorted(keys, frames), 1), len(keys) - 1)
    before = np.maximum(after - 1, 0)
    share = (frames - keys[before]) / np.maximum(keys[after] - keys[before], 1)
    return before, after, np.clip(share, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class LastingErrors:
    """Factors of the covariance between frames of a motion.

    That of coordinate i in frame f at time t_f with coordinate j in frame g is

        Cov(f i, g j) = s_fi · s_gj + exp(−|t_f − t_g| / τ) d_fi · d_gj

    with s the errors that last for the whole take (shape, cameras, biases) and d those that drift. They are given in
    key frames, and linear between these.

    Parameters
    ----------
    frames : (K,) int, key frames, increasing
    constant, drift : (K, 6 + D, k) [m, rad], k directions of the factors s and d
    drift_time : float [s], τ
    """

    frames: NDArray
    constant: NDArray
    drift: NDArray
    drift_time: float

    def at(self, frames: ArrayLike, coordinates: ArrayLike) -> tuple[NDArray, NDArray]:
        """Factors (R, k) of R coordinates (int, 6 + D of them) in R frames (int): s and d."""
        (before, after, share), rows = between(self.frames, np.asarray(frames)), np.asarray(coordinates)
        share = share[:, None]
        s, d = (v[before, rows] * (1.0 - share) + v[after, rows] * share for v in (self.constant, self.drift))
        return s, d

    def part(self, frames: slice) -> LastingErrors:
        """Of a stretch of frames, numbered from its first one."""
        start, stop, _ = frames.indices(int(self.frames[-1]) + 1 if len(self.frames) else 0)
        first = max(int(np.searchsorted(self.frames, start, "right")) - 1, 0)
        keys = slice(first, int(np.searchsorted(self.frames, stop)) + 1)
        return LastingErrors(self.frames[keys] - start, self.constant[keys], self.drift[keys], self.drift_time)

    def turned(self, R: NDArray) -> LastingErrors:
        """In a world that R (3, 3) turns the old one into."""
        constant, drift = (
            np.concatenate([R @ v[:, :3], R @ v[:, 3:6], v[:, 6:]], axis=1) for v in (self.constant, self.drift)
        )
        return LastingErrors(self.frames, constant, drift, self.drift_time)
