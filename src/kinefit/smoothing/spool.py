"""What is kept of every frame of a long take: in memory while it is little, beyond that in a temporary file."""

from __future__ import annotations

import io
import os
import pickle
import tempfile
import weakref
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Generic, TypeVar, overload

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.sensors.base import Sensor
from kinefit.sensors.channels import Channels
from kinefit.sensors.keypoints import Layout
from kinefit.sensors.settings import TrackSettings

T = TypeVar("T")

IN_MEMORY = 16 * 2**20
"""Bytes of each kind that stay in memory: depth and silhouettes of some seconds, keypoints of a minute."""

STRETCH = 2000
"""Frames of which arrays over all channels are made at once."""

_OF_ALL_FRAMES = Body, Sensor, Camera, Rig, Channels, Layout, TrackSettings
_PLAIN = {
    tuple, list, dict, set, frozenset, str, bytes, bytearray, int, float, bool, complex, type(None), np.ndarray,
    np.dtype, pickle.PickleBuffer,
}  # fmt: skip


def stretches(frames: int) -> list[slice]:
    """Of a take, so long that what is computed of all channels in one stays small."""
    return [slice(start, min(start + STRETCH, frames)) for start in range(0, max(frames, 1), STRETCH)]


def _goes_along(kind: type) -> bool:
    """Whether things of a type are written; others stay as they are."""
    if kind in _PLAIN or issubclass(kind, np.generic | np.dtype):
        return True
    return kind.__module__.startswith("kinefit.") and not issubclass(kind, _OF_ALL_FRAMES)


class Spool(Sequence[T], Generic[T]):
    """Records of many frames, read back one by one; what is read is a copy.

    Arrays and kinefit's own records are written. What belongs to all frames (bodies, sensors, cameras), and objects of
    classes that are not kinefit's, such as measurements of a sensor of one's own, stay in memory as they are. The file
    lies in the system's temporary folder (`TMPDIR`), without a name where the system allows it, and is gone with the
    spool or the process.

    Parameters
    ----------
    things : to begin with
    in_memory : bytes up to which no file is made; default `IN_MEMORY`
    file : that records go to from the first on, and that stays; default: a temporary one
    """

    def __init__(self, things: Iterable[T] = (), *, in_memory: int | None = None, file: Path | None = None) -> None:
        self._store = _Store(IN_MEMORY if in_memory is None else in_memory, file)
        self._places = array("q")  # first byte and number of bytes, one after the other
        self._last: tuple[tuple[int, int], T] | None = None
        for thing in things:
            self.append(thing)

    def __len__(self) -> int:
        return len(self._places) // 2

    @overload
    def __getitem__(self, which: int) -> T: ...

    @overload
    def __getitem__(self, which: slice) -> Spool[T]: ...

    def __getitem__(self, which: int | slice) -> T | Spool[T]:
        if isinstance(which, slice):
            return self.chosen(range(len(self))[which])
        place = self._place(which)
        if self._last is None or self._last[0] != place:
            self._last = place, self._store.read(place)
        return self._last[1]

    def __setitem__(self, which: int, thing: T) -> None:
        self._place(which)
        self._places[2 * which : (2 * which + 2) or None] = array("q", self._store.write(thing))

    def append(self, thing: T) -> None:
        """Add one at the end.

        Raises
        ------
        ObservationError
            No room in the temporary folder.
        """
        self._places.extend(self._store.write(thing))

    def chosen(self, which: Iterable[int]) -> Spool[T]:
        """Some of them, in this order, in the same file."""
        out: Spool[T] = object.__new__(Spool)
        out._store, out._last = self._store, None
        out._places = array("q", [number for i in which for number in self._place(i)])
        return out

    def _place(self, which: int) -> tuple[int, int]:
        if not -len(self) <= which < len(self):
            raise IndexError(f"record {which} of {len(self)}")
        which %= len(self)
        return self._places[2 * which], self._places[2 * which + 1]

    def state(self) -> SpoolState:
        """What there is beside the file, for `restore`; what was appended is in the file then, whatever happens."""
        self._store.flush()
        return SpoolState(bytes(self._places), tuple(self._store.shared))

    def restore(self, state: SpoolState) -> bool:
        """Have the records of this spool's file that were there at a state, and no others; False if it is damaged."""
        places = array("q")
        places.frombytes(state.places)
        if not self._store.cut(places[-2] + places[-1] if places else 0, state.shared):
            return False
        self._places, self._last = places, None
        return True


@dataclass(frozen=True, eq=False)
class SpoolState:
    """Where records lie in a file, and the objects that they refer to."""

    places: bytes
    shared: tuple[Any, ...]


def _kept(number: int) -> Any:
    """Stands in a record for a thing that was not written; `_Unpickler` knows which."""
    raise LookupError(f"thing {number} of a record")


class _Pickler(pickle.Pickler):
    """Writes a record, with a number in place of each thing that is not written."""

    def __init__(self, file: io.BytesIO, number: Callable[[Any], int | None]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._number = number

    def reducer_override(self, thing: Any) -> Any:
        number = None if thing is _kept else self._number(thing)
        return NotImplemented if number is None else (_kept, (number,))


class _Unpickler(pickle.Unpickler):
    """Reads a record, with the things that were not written by their numbers."""

    def __init__(self, file: io.BytesIO, shared: Sequence[Any]) -> None:
        super().__init__(file)
        self._shared = shared

    def find_class(self, module: str, name: str) -> Any:
        return self._shared.__getitem__ if name == _kept.__name__ else super().find_class(module, name)


class _Store:
    """A file of records, and what they refer to."""

    def __init__(self, in_memory: int, file: Path | None = None) -> None:
        self._file: IO[bytes]
        if file is None:
            self._file = tempfile.SpooledTemporaryFile(max(in_memory, 1))
        else:
            self._file = open(file, "r+b" if file.exists() else "w+b")
        self._end = 0
        self.shared: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._written: dict[type, bool] = {}
        weakref.finalize(self, self._file.close)

    def flush(self) -> None:
        """Have all that was written in the file."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def cut(self, end: int, shared: Iterable[Any]) -> bool:
        """Leave out what comes after so many bytes; False where there are not so many."""
        if self._file.seek(0, os.SEEK_END) < end:
            return False
        self._file.truncate(end)
        self._end, self.shared = end, list(shared)
        self._numbers = {id(thing): k for k, thing in enumerate(self.shared)}
        return True

    def write(self, thing: Any) -> tuple[int, int]:
        """Where it was written: first byte, and how many."""
        buffer = io.BytesIO()
        _Pickler(buffer, self._number).dump(thing)
        data, place = buffer.getbuffer(), (self._end, buffer.tell())
        try:
            self._file.seek(self._end)
            self._file.write(data)
        except OSError as error:
            remedy = "Set TMPDIR to a folder with more room: up to 1 MB for each frame with depth or silhouettes."
            raise ObservationError(
                f"measurements cannot be kept: {error.strerror}", file=tempfile.gettempdir(), remedy=remedy
            ) from error
        self._end += place[1]
        return place

    def read(self, place: tuple[int, int]) -> Any:
        self._file.seek(place[0])
        return _Unpickler(io.BytesIO(self._file.read(place[1])), self.shared).load()

    def _number(self, thing: Any) -> int | None:
        """Of what is kept as it is; None for what is written."""
        kind = type(thing)
        if kind not in self._written:
            self._written[kind] = _goes_along(kind)
        if self._written[kind]:
            return None
        number = self._numbers.get(id(thing))
        if number is None:
            number = self._numbers[id(thing)] = len(self.shared)
            self.shared.append(thing)
        return number
