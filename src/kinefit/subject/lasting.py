"""How much of a sensor's error lasts from frame to frame: frames of one take are not independent looks.

A detector errs in the same place for every posture alike, skin and soft parts slide with it, a model is not the person.
What lasts does not average out over the frames: the mean residual of a channel over F frames then varies by more than
one F-th of the variance of a single one. That ratio is by how much the data of all frames say less than they seem to.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched
from kinefit.sensors.channel_names import ChannelNames
from kinefit.solvers.bundle.whitened import residuals

_FEWEST = 10  # residuals of a sensor, below which nothing is said of their errors
_MOST_HIDDEN = 0.75  # share of all lasting errors that a fit may be thought to follow
_OUTLIER = 3.0  # standard deviations
_LEAST = 1e-3  # that is told, of a sensor whose residuals are all but zero


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Whitened residuals (N,) of one sensor over so many frames, and the channel (N,) of each."""

    value: NDArray
    channel: NDArray
    of_points: bool
    frames: int

    @property
    def looks(self) -> float:
        """Number of mean residuals: of channels, or of a frame's rows where segments are the channels."""
        return len(np.unique(self.channel)) if self.of_points else len(self.value) / self.frames

    def sums(self) -> tuple[NDArray, NDArray, float]:
        """Count and sum (C,) of every channel without outliers, and a residual's standard deviation."""
        size = float(np.median(np.abs(self.value))) / 0.6745
        good = np.abs(self.value) <= _OUTLIER * max(size, 1e-12)
        _, index = np.unique(self.channel[good], return_inverse=True)
        return np.bincount(index), np.bincount(index, self.value[good]), size


@dataclass(frozen=True, eq=False)
class Seen:
    """Rows of one measurement of a frame, at the fit.

    Parameters
    ----------
    matched : with its sensor and channels
    rows : its rows, of any kind
    """

    matched: Matched
    rows: Sequence[AnyRows]


def excess(frames: Sequence[Sequence[Seen]], followed: float) -> dict[str, float]:
    """{sensor: factor} by which the variance of what all frames measure together is larger than rows say.

    Below 1 where rows state more than is left over. A channel is a row's measurement id and its place in it; of
    surfaces also a whole segment, because their errors last over a patch.

    Parameters
    ----------
    frames : what every frame's sensors saw
    followed : number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data give.
    """
    found = {name: one for name, one in _collect(frames).items() if len(one.value) >= _FEWEST}
    hidden = min(followed / max(sum(one.looks for one in found.values()), 1), _MOST_HIDDEN)
    out = {}
    for name, one in found.items():
        count, total, size = one.sums()
        lasting = _lasting(count, total) / (1.0 - (hidden if one.of_points else 0.0))
        out[name] = max(lasting, size**2, _LEAST)
    return out


def _lasting(count: NDArray, total: NDArray) -> float:
    """Variance of channels' means, times the number of frames: one where nothing lasts."""
    return float(np.sum(total**2)) / max(float(count.sum()), 1.0)


def _collect(frames: Sequence[Sequence[Seen]]) -> dict[str, _Residuals]:
    """Residuals of each sensor with their channels."""
    values: dict[str, list[NDArray]] = {}
    found: dict[str, list[int]] = {}
    known: dict[Hashable, int] = {}
    of_points: dict[str, bool] = {}
    names = ChannelNames()
    for one in (one for several in frames for one in several):
        sensor = one.matched.sensor
        of_points[sensor] = one.matched.of_points
        for rows, own in zip(one.rows, names.channels(one.matched, one.rows)):
            felt = rows.weight > 0.0 if rows.weight.ndim == 1 else np.ones(len(rows), bool)
            values.setdefault(sensor, []).append(residuals(rows)[felt])
            ids = [known.setdefault((sensor, own[k]), len(known)) for k in np.flatnonzero(felt)]
            found.setdefault(sensor, []).extend(ids)
    return {
        s: _Residuals(np.concatenate(v), np.array(found[s], np.int64), of_points[s], len(frames))
        for s, v in values.items()
    }
