"""Residuals of every sensor of a take by channel, from which the variances of its errors are estimated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched
from kinefit.sensors.channel_names import ChannelNames


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
