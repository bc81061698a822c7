"""The channel of each row: the identity by which a sensor's errors are tracked from frame to frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.rows import AnyRows, DofRows, Rows
from kinefit.sensors.base import Matched

_MIN_FRAMES = 10  # named measurements of a sensor; in fewer, no channel may have been seen twice

Channel = tuple[str | int, ...]
"""Part of the match (of numbered channels only), name or measurement id, number of rows; of a surface: the segment."""


class ChannelNames:
    """The channels of every sensor of a take; checks that their names stay the same from frame to frame."""

    def __init__(self) -> None:
        self._named: dict[str, bool] = {}
        self._numbered: dict[tuple[str, int], bytes] = {}
        self._names: dict[str, tuple[set[str], int, int]] = {}

    def channels(self, matched: Matched, parts: Sequence[AnyRows]) -> list[tuple[list[Channel], NDArray]]:
        """Channels of every part of a match, and (2, N) the channel and axis of each row.

        Parameters
        ----------
        matched : Matched; unless its rows are single points, their segments are the channels
        parts : its rows

        Raises
        ------
        ObservationError
            Names that are no text, or not each a different one; a measurement id without a name; a sensor that names
            its channels at some times only, or anew at every time; numbered channels that change.
        """
        sensor = matched.sensor
        out, used = list[tuple[list[Channel], NDArray]](), set[str]()
        if not matched.of_points:
            for rows in parts:
                segment = getattr(rows, "segment", None)
                ids, index = np.unique(np.zeros(len(rows)) if segment is None else segment, return_inverse=True)
                out.append(([(int(k),) for k in ids], np.stack([index, np.zeros_like(index)])))
            return out
        names = self.check_names(matched)
        for k, rows in enumerate(parts):
            ids, index, count = np.unique(_ids(rows), return_inverse=True, return_counts=True)
            if names is None:
                if len(ids) and self._numbered.setdefault((sensor, k), ids.tobytes()) != ids.tobytes():
                    raise ObservationError(
                        f"the channels of sensor '{sensor}' have no names, but their number changes",
                        remedy="Name the channel of each measurement id: RowsOf(rows, channels=names).",
                    )
            elif len(ids) and ids[-1] >= len(names):
                problem = f"sensor '{sensor}' names {len(names)} channels, but has rows of measurement id {ids[-1]}"
                raise ObservationError(problem, remedy="Give one name for each measurement id, `Rows.group`.")
            keys: list[Channel] = [(k, i) if names is None else (names[i],) for i in ids.tolist()]
            used.update(() if names is None else (names[i] for i in ids))
            axis = np.empty(len(index), np.int64)
            axis[np.argsort(index, kind="stable")] = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
            out.append(([(*key, rows) for key, rows in zip(keys, count.tolist())], np.stack([index, axis])))
        if used:
            self._check_return(sensor, used)
        return out

    def check_names(self, matched: Matched) -> Sequence[str] | None:
        """The names of a match's channels; raises ObservationError if no text, not unique or not always given."""
        names, sensor = matched.channels, matched.sensor
        if self._named.setdefault(sensor, names is not None) != (names is not None):
            raise ObservationError(
                f"sensor '{sensor}' names its channels in some measurements, but not in all",
                remedy="Name them in all. If two sensors have this name, give each its own.",
            )
        if names is not None and (isinstance(names, str) or not all(isinstance(n, str) for n in names)):
            raise ObservationError(f"channels of sensor '{sensor}' are not text", remedy="Give a list of names.")
        if names is not None and len(set(names)) < len(names):
            twice = next(n for n in names if list(names).count(n) > 1)
            raise ObservationError(f"sensor '{sensor}' has two channels '{twice}'", remedy="Give each another name.")
        return names

    def check_step(self, matched: Sequence[Matched]) -> None:
        """Raise ObservationError if two measurements of one time share a channel: two sensors use one name."""
        seen = set[tuple[str, float, str]]()
        for m in matched:
            if m.of_points:
                names = self.check_names(m)
                keys = {(m.sensor, m.time, name) for name in (("",) if names is None else names)}
                if both := seen & keys:
                    problem = f"two measurements of sensor '{m.sensor}' at {m.time:g} s"
                    problem += f" have a channel '{min(both)[2]}'" if names is not None else ""
                    raise ObservationError(problem, remedy="If two sensors have this name, give each its own.")
                seen |= keys

    def _check_return(self, sensor: str, used: set[str]) -> None:
        known, frames, total = self._names.get(sensor, (set(), 0, 0))
        known, frames, total = known | used if used - known else known, frames + 1, total + len(used)
        if frames >= _MIN_FRAMES and len(known) == total:
            raise ObservationError(
                f"sensor '{sensor}' has new channel names at every time: {', '.join(sorted(used)[:3])}",
                remedy="Name a channel after its source, such as a marker, not after its time.",
            )
        self._names[sensor] = known, frames, total


def _ids(rows: AnyRows) -> NDArray:
    """(N,) measurement id of each row; where rows have none, each is its own measurement."""
    if not isinstance(rows, Rows | DofRows):
        return np.arange(len(rows))
    return np.where(rows.group < 0, np.arange(len(rows)), rows.group) if rows.group.min(initial=0) < 0 else rows.group


class ChannelResiduals:
    """Residuals of the sensors of a take, frame by frame.

    A point's rows are the axes of its channel. All rows of a segment's surface are one axis of that segment's channel:
    their errors are alike over a patch.
    """

    def __init__(self) -> None:
        self._names = ChannelNames()
        self._columns: dict[str, dict[tuple[str | int, ...], int]] = {}
        self._entries: dict[str, list[NDArray]] = {}

    def add(
        self, frame: int, matched: Matched, parts: Sequence[AnyRows], values: Sequence[NDArray],
        weights: Sequence[NDArray],
    ) -> list[NDArray]:  # fmt: skip
        """Add the rows of one match; (2, N) the channel's number within its sensor and the axis of each row, by part.

        Parameters
        ----------
        frame : number of the frame
        matched : Matched
        parts : its rows
        values : of each part (N,) residuals
        weights : of each part (N,) for the mean of several rows of one axis; 0 excludes a row

        Raises
        ------
        ObservationError
            Channels whose identity is not certain, see `ChannelNames.channels`.
        """
        columns, out = self._columns.setdefault(matched.sensor, {}), []
        for (own, at), value, weight in zip(self._names.channels(matched, parts), values, weights):
            number = np.array([columns.setdefault(channel, len(columns)) for channel in own], np.int64)
            out.append(np.stack([number[at[0]], at[1]]))
            entries = np.vstack([np.full(len(value), frame), out[-1], value, weight])
            self._entries.setdefault(matched.sensor, []).append(entries[:, weight > 0.0])
        return out

    def arrays(self, frames: int) -> dict[str, tuple[NDArray, NDArray]]:
        """{sensor: residuals (F, C, A), NaN if unobserved, and (F, C, A) the number of rows of each mean}."""
        out = {}
        for sensor, parts in self._entries.items():
            found = np.concatenate(parts, axis=1)
            axes = int(found[2].max(initial=0)) + 1
            shape = frames, len(self._columns[sensor]), axes
            index = np.ravel_multi_index(tuple(found[:3].astype(np.int64)), shape)
            size = int(np.prod(shape))
            total, count = np.bincount(index, found[4], size), np.bincount(index, minlength=size)
            mean = np.bincount(index, found[4] * found[3], size) / np.where(count > 0, total, np.nan)
            out[sensor] = mean.reshape(shape), count.reshape(shape)
        return out
