"""How much of a sensor's error lasts from frame to frame: frames of one take are not independent looks.

A detector errs in the same place for every posture alike, skin and soft parts slide with it, a model is not the person.
What lasts does not average out over the frames: the mean residual of a channel over F frames then varies by more than
one F-th of the variance of a single one. That ratio is by how much the data of all frames tell less than they seem to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.rows import AnyRows, DofRows, Rows
from kinefit.solvers.whitened import residuals

_FEWEST = 10  # residuals of a sensor, below which nothing is told of their errors
_MOST_HIDDEN = 0.75  # share of all lasting errors that a fit may be thought to follow
_OUTLIER = 3.0  # standard deviations


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Whitened residuals (N,) of one sensor over all frames, and the channel (N,) of each."""

    value: NDArray
    channel: NDArray

    def sums(self) -> tuple[NDArray, NDArray, float]:
        """Count and sum (C,) of every channel without outliers, and a residual's standard deviation."""
        size = float(np.median(np.abs(self.value))) / 0.6745
        good = np.abs(self.value) <= _OUTLIER * max(size, 1e-12)
        _, index = np.unique(self.channel[good], return_inverse=True)
        return np.bincount(index), np.bincount(index, self.value[good]), size


def excess(
    frames: Sequence[Sequence[tuple[str, AnyRows]]], settled: Mapping[str, bool], followed: float
) -> dict[str, float]:
    """{sensor: factor ≥ 1} by which the variance of what all frames tell together is larger than rows say.

    A channel is a row's measurement id (`Rows.group`) and its place in it; of correspondences that are sought anew
    (`settled` False), also whole segments, because the error of a surface lasts over a patch of it.

    Parameters
    ----------
    frames : rows of every frame, by sensor, at the fit.
    settled : {sensor: bool}
    followed : number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data tell.
    """
    by_channel, by_segment = _collect(frames, segments=False), _collect(frames, segments=True)
    sums = {name: one.sums() for name, one in by_channel.items() if len(one.value) >= _FEWEST}
    channels = sum(len(count) for count, _, _ in sums.values())
    hidden = min(followed / max(channels, 1), _MOST_HIDDEN)
    out = {}
    for name, (count, total, size) in sums.items():
        lasting = float(np.sum(total**2)) / max(float(count.sum()), 1.0) / (1.0 - hidden)
        if not settled.get(name, True):
            count, total, _ = by_segment[name].sums()
            lasting = max(lasting, float(np.sum(total**2)) / max(float(count.sum()), 1.0))
        out[name] = max(lasting, size**2, 1.0)
    return out


def _collect(frames: Sequence[Sequence[tuple[str, AnyRows]]], *, segments: bool) -> dict[str, _Residuals]:
    """Residuals of each sensor with their channels."""
    values: dict[str, list[NDArray]] = {}
    channels: dict[str, list[NDArray]] = {}
    for parts in frames:
        count: dict[str, int] = {}
        for sensor, rows in parts:
            place = count[sensor] = count.get(sensor, -1) + 1
            felt = rows.weight > 0.0 if rows.weight.ndim == 1 else np.ones(len(rows), bool)
            own = _segments(rows) if segments else _channels(rows) + 1_000_000 * place
            values.setdefault(sensor, []).append(residuals(rows)[felt])
            channels.setdefault(sensor, []).append(own[felt])
    return {s: _Residuals(np.concatenate(values[s]), np.concatenate(channels[s])) for s in values}


def _segments(rows: AnyRows) -> NDArray:
    """(N,) segment of each row; one for all where they are on several."""
    return rows.segment if isinstance(rows, Rows) else np.zeros(len(rows), np.int64)


def _channels(rows: AnyRows) -> NDArray:
    """(N,) measurement id and place within it, of up to ten rows; else the place among all."""
    if not isinstance(rows, Rows | DofRows) or np.any(rows.group < 0):
        return np.arange(len(rows))
    order = np.argsort(rows.group, kind="stable")
    ids = rows.group[order]
    first = np.searchsorted(ids, ids)
    place = np.empty(len(rows), np.int64)
    place[order] = np.minimum(np.arange(len(rows)) - first, 9)
    return 10 * rows.group + place
