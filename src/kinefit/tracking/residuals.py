"""What every sensor leaves over, frame by frame, as arrays of all frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit.motion import Residuals
from kinefit.sensors.base import Leftover


@dataclass(eq=False)
class _OfSensor:
    """Columns of names, and arrays (F, K, ...) of which the last axis but one grows with them."""

    unit: str
    surface: bool
    swapped: NDArray
    arrays: dict[str, NDArray]
    place: dict[str, int] = field(default_factory=dict)
    segments: list[int] = field(default_factory=list)


class Remains:
    """Collects what is left over of F frames, in any order.

    Parameters
    ----------
    frames : F
    """

    def __init__(self, frames: int) -> None:
        self._frames = frames
        self._of: dict[str, _OfSensor] = {}

    def add(self, f: int, leftovers: Iterable[Leftover]) -> None:
        """Of frame `f`; of several of one sensor the last counts."""
        for rest in {rest.label: rest for rest in leftovers}.values():
            of = self._of.get(rest.label)
            if of is None:
                of = self._of[rest.label] = self._empty(rest)
            columns = self._columns(of, rest)
            for name, values in (("values", rest.values), ("weights", rest.weights), ("measured", rest.measured)):
                of.arrays[name][f, columns] = values
            of.swapped[f] = rest.swapped
            if of.surface and rest.rms is not None and rest.count is not None:
                of.arrays["rms"][f, columns], of.arrays["count"][f, columns] = rest.rms, rest.count

    def release(self) -> None:
        """Give back the memory of what was added so far: it lies in files where it is much."""
        for of in self._of.values():
            release(*of.arrays.values())

    def residuals(self, frames: Sequence[int] | None = None) -> dict[str, Residuals]:
        """Of all frames, or of some of them, by sensor."""
        which = slice(None) if frames is None or len(frames) == self._frames else np.asarray(frames, np.int64)
        return {
            label: Residuals(
                names=tuple(of.place), segments=np.array(of.segments, np.int64), unit=of.unit,
                swapped=of.swapped[which], **{name: array[which] for name, array in of.arrays.items()},
            )
            for label, of in self._of.items()
        }  # fmt: skip

    def _empty(self, rest: Leftover) -> _OfSensor:
        F, N = self._frames, rest.values.shape[1]
        arrays = {"values": np.empty((F, 0, N)), "weights": np.empty((F, 0)), "measured": np.empty((F, 0, N))}
        surface = rest.count is not None
        if surface:
            arrays |= {"rms": np.empty((F, 0)), "count": np.empty((F, 0))}
        return _OfSensor(rest.unit, surface, np.zeros(F, bool), arrays)

    def _columns(self, of: _OfSensor, rest: Leftover) -> list[int]:
        """Places of its names; new ones are unseen in all frames so far."""
        before = len(of.place)
        for name, segment in zip(rest.names, rest.segments):
            if name not in of.place:
                of.place[name] = len(of.place)
                of.segments.append(int(segment))
        more = len(of.place) - before
        if more:
            for name, array in of.arrays.items():
                of.arrays[name] = larger = room((len(array), before + more, *array.shape[2:]))
                larger[:, :before] = array
                larger[:, before:] = 0.0 if name in ("weights", "count") else np.nan
        return [of.place[name] for name in rest.names]
