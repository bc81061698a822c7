"""How much of a sensor's error lasts from frame to frame: frames of one take are not independent looks.

A detector errs in the same place for every posture alike, skin and soft parts slide with it, a model is not the person.
What lasts does not average out over the frames: the mean residual of a channel over F frames then varies by more than
one F-th of the variance of a single one. That ratio is by how much the data of all frames say less than they seem to.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.rows import AnyRows, DofRows, Rows
from kinefit.solvers.whitened import residuals

_FEWEST = 10  # residuals of a sensor, below which nothing is said of their errors
_MOST_HIDDEN = 0.75  # share of all lasting errors that a fit may be thought to follow
_OUTLIER = 3.0  # standard deviations
_LEAST = 1e-3  # that is told, of a sensor whose residuals are all but zero


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


@dataclass(frozen=True, eq=False)
class Seen:
    """Rows of one measurement of a frame, at the fit.

    Parameters
    ----------
    sensor : str
    rows : Sequence of rows of any kind
    of_points : whether each point has errors of its own; else those of one segment err alike
    names : of the points, where ids of measurements (`Rows.group`) count those seen only; else the ids name them
    """

    sensor: str
    rows: Sequence[AnyRows]
    of_points: bool = True
    names: tuple[str, ...] | None = None


def excess(frames: Sequence[Sequence[Seen]], followed: float) -> dict[str, float]:
    """{sensor: factor} by which the variance of what all frames measure together is larger than rows say.

    Below 1 where rows state more than is left over. A channel is a row's measurement id and its place in it; of
    surfaces also a whole segment, because their errors last over a patch.

    Parameters
    ----------
    frames : what every frame's sensors saw
    followed : number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data give.
    """
    by_channel, by_segment = _collect(frames, _channels), _collect(frames, _segments)
    surfaces = {one.sensor for several in frames for one in several if not one.of_points}
    sums = {name: one.sums() for name, one in by_channel.items() if len(one.value) >= _FEWEST}
    channels = sum(len(count) for count, _, _ in sums.values())
    hidden = min(followed / max(channels, 1), _MOST_HIDDEN)
    out = {}
    for name, (count, total, size) in sums.items():
        lasting = _lasting(count, total) / (1.0 - hidden)
        if name in surfaces:
            lasting = max(lasting, _lasting(*by_segment[name].sums()[:2]))
        out[name] = max(lasting, size**2, _LEAST)
    return out


def _lasting(count: NDArray, total: NDArray) -> float:
    """Variance of channels' means, times the number of frames: one where nothing lasts."""
    return float(np.sum(total**2)) / max(float(count.sum()), 1.0)


def _collect(
    frames: Sequence[Sequence[Seen]], channels: Callable[[AnyRows, tuple[str, ...] | None, int], list[Hashable]]
) -> dict[str, _Residuals]:
    """Residuals of each sensor with their channels."""
    values: dict[str, list[NDArray]] = {}
    found: dict[str, list[int]] = {}
    known: dict[Hashable, int] = {}
    for several in frames:
        for one in several:
            for place, rows in enumerate(one.rows):
                felt = rows.weight > 0.0 if rows.weight.ndim == 1 else np.ones(len(rows), bool)
                values.setdefault(one.sensor, []).append(residuals(rows)[felt])
                own = channels(rows, one.names, place)
                ids = [known.setdefault(own[k], len(known)) for k in np.flatnonzero(felt)]
                found.setdefault(one.sensor, []).extend(ids)
    return {s: _Residuals(np.concatenate(v), np.array(found[s], np.int64)) for s, v in values.items()}


def _segments(rows: AnyRows, names: tuple[str, ...] | None, place: int) -> list[Hashable]:
    """(N,) segment of each row; one for all where they are on several."""
    return rows.segment.tolist() if isinstance(rows, Rows) else [0] * len(rows)


def _channels(rows: AnyRows, names: tuple[str, ...] | None, place: int) -> list[Hashable]:
    """(N,) what each row measures: which rows of a measurement, its id or name, and its place in it."""
    if not isinstance(rows, Rows | DofRows):
        return [(place, k) for k in range(len(rows))]
    count: dict[int, int] = {}
    out: list[Hashable] = []
    for g in rows.group.tolist():
        count[g] = count.get(g, -1) + 1
        out.append((place, names[g] if names is not None and 0 <= g < len(names) else g, count[g]))
    return out
