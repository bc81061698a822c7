"""Errors of a motion that last longer than one frame, and with them the covariance between its frames.

A range of motion is the difference of two frames. What both have in common is not in it: the bones' lengths, where the
detector places a joint, the cameras. So the standard deviation of a difference is not that of two independent values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._mapped import release, room

KEYS_AT_ONCE = 1000
"""Key frames of which factors, 11 kB each, are in memory at once."""
_KEY_FRAMES_PER_S = 20.0  # The sigma of differences on the balancing trial is within 2.6 % of that with every frame,
# 0.5 % for nine tenths; with 10 a second within 8 %.

_MAX_UNKNOWN = 1.0  # sum of two takes' variances along a direction, over the prior's, that tells people apart
_LEAST_VARIANCE = 0.01  # of such a difference, over the prior's: what errors of models add
_MAX_MISFIT = 0.7  # two takes of one person: up to 0.14 by real markers, 0.41 simulated; of two people: from 1.27


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
class ParameterErrors:
    """What a fit of lengths, landmarks and cameras knows of them, and what their errors do to the motion.

    Parameters
    ----------
    names : (p,) of the parameters; those of a camera name its calibration, too
    values : (p,) estimates [1, m, rad]
    covariance : (p, p) of their errors
    information : (p, p) of the prior
    directions : (k, p) covariance of the k unit errors of `LastingErrors.constant` with the parameters' errors
    """

    names: tuple[str, ...]
    values: NDArray
    covariance: NDArray
    information: NDArray
    directions: NDArray

    def of(self, names: Sequence[str]) -> ParameterErrors:
        """Of some parameters alone, whose prior does not depend on the others."""
        at = [self.names.index(name) for name in names]
        square = np.ix_(at, at)
        return ParameterErrors(
            tuple(names), self.values[at], self.covariance[square], self.information[square], self.directions[:, at]
        )  # fmt: skip

    @property
    def unresolved(self) -> NDArray:
        """(k, p) part of the errors that comes from the prior, in its standard deviations: at most one each."""
        u, size, v = np.linalg.svd(self.directions @ self._root, full_matrices=False)
        return np.asarray(u * np.minimum(size, 1.0) @ v)

    @property
    def _root(self) -> NDArray:
        """(p, p) lower triangle, of which the product with its own transpose is the prior's information."""
        weak = 1e-9 * np.mean(np.diag(self.information))  # of what has no prior
        return np.linalg.cholesky(self.information + weak * np.eye(len(self.names)))

    def misfit(self, other: ParameterErrors) -> float:
        """Mean square difference from other estimates of the same parameters, in its standard deviations.

        Along what both takes measured. About 1 where both are of one person; infinite where they measured nothing.
        """
        root = self._root
        a, b = (root.T @ one.covariance @ root for one in (self, other))
        unknown, axes = np.linalg.eigh(a + b)
        axes = axes[:, unknown < _MAX_UNKNOWN]
        away = axes.T @ root.T @ (self.values - other.values)
        variance = np.sum(axes * ((a + b - a @ b - b @ a) @ axes), axis=0) + _LEAST_VARIANCE
        return float(np.mean(away**2 / variance)) if len(away) else np.inf


def common(first: LastingErrors, second: LastingErrors) -> NDArray | None:
    """(k, k) covariance of the constant errors of two motions; None where they are not known to be of one person.

    Errors e of parameters come from the prior and from the take's own measurements. The prior's part is the same in
    both: with prior information Λ and posterior covariances Σ, Cov(e, e') = Σ Λ Σ'.
    """
    if first.parameters is None or second.parameters is None:
        return None
    names = [name for name in first.parameters.names if name in second.parameters.names]
    a, b = first.parameters.of(names), second.parameters.of(names)
    if not names or differ(first, second):
        return None
    return a.unresolved @ b.unresolved.T


def differ(first: LastingErrors, second: LastingErrors) -> bool:
    """Whether two motions measured parameters that differ by more than their errors, as those of two people do."""
    if first.parameters is None or second.parameters is None:
        return False
    names = [name for name in first.parameters.names if name in second.parameters.names]
    return bool(names) and first.parameters.of(names).misfit(second.parameters.of(names)) > _MAX_MISFIT


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
    parameters : what of `constant` other motions of the same person may share; None where that is not known
    """

    frames: NDArray
    constant: NDArray
    drift: NDArray
    drift_time: float
    parameters: ParameterErrors | None = None

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
        return replace(
            self, frames=self.frames[keys] - start, constant=self.constant[keys], drift=self.drift[keys]
        )  # fmt: skip

    def turned(self, R: NDArray) -> LastingErrors:
        """In a world that R (3, 3) turns the old one into."""
        return replace(self, constant=_turned(self.constant, R), drift=_turned(self.drift, R))


def _turned(factors: NDArray, R: NDArray) -> NDArray:
    """Factors (K, 6 + D, k), of the same type, in a world that R (3, 3) turns the old one into."""
    out = room(factors.shape, factors.dtype)
    for start in range(0, len(out), KEYS_AT_ONCE):
        some = slice(start, start + KEYS_AT_ONCE)
        out[some] = factors[some]
        out[some, :3], out[some, 3:6] = R @ factors[some, :3], R @ factors[some, 3:6]
        release(out, factors)
    return out
