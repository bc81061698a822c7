"""What is kept of every frame of a long take: in memory while it is little, beyond that in a temporary file."""

from __future__ import annotations

import io
import pickle
import tempfile
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera, Rig
from kinefit.sensors.base import Sensor
from kinefit.sensors.channels import Channels
from kinefit.sensors.keypoints import Layout
from kinefit.sensors.settings import TrackSettings

T = TypeVar("T")

IN_MEMORY = 64 * 2**20
"""Bytes of each kind that stay in memory: depth and silhouettes of about ten seconds, markers of minutes."""

_OF_ALL_FRAMES = Body, Sensor, Camera, Rig, Channels, Layout, TrackSettings
_PLAIN = {
    tuple, list, dict, set, frozenset, str, bytes, bytearray, int, float, bool, complex, type(None), np.ndarray,
    np.dtype, pickle.PickleBuffer,
}  # fmt: skip


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
    """

    def __init__(self, things: Iterable[T] = (), *, in_memory: int | None = None) -> None:
        self._store = _Store(IN_MEMORY if in_memory is None else in_memory)
        self._places: list[tuple[int, int]] = []
        self._last: tuple[tuple[int, int], T] | None = None
        for thing in things:
            self.append(thing)

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, which: int) -> T: ...

    @overload
    def __getitem__(self, which: slice) -> Spool[T]: ...

    def __getitem__(self, which: int | slice) -> T | Spool[T]:
        if isinstance(which, slice):
            return self.chosen(range(len(self))[which])
        place = self._places[which]
        if self._last is None or self._last[0] != place:
            self._last = place, self._store.read(place)
        return self._last[1]

    def __setitem__(self, which: int, thing: T) -> None:
        self._places[which] = self._store.write(thing)

    def append(self, thing: T) -> None:
        """Add one at the end.

        Raises
        ------
        ObservationError
            No room in the temporary folder.
        """
        self._places.append(self._store.write(thing))

    def chosen(self, which: Iterable[int]) -> Spool[T]:
        """Some of them, in this order, in the same file."""
        out: Spool[T] = object.__new__(Spool)
        out._store, out._places, out._last = self._store, [self._places[i] for i in which], None
        return out


class _Pickler(pickle.Pickler):
    """Writes a record, with a number in place of each thing that is not written."""

    def __init__(self, file: io.BytesIO, number: Callable[[Any], int | None]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._number = number

    def persistent_id(self, thing: Any) -> int | None:
        return self._number(thing)


class _Unpickler(pickle.Unpickler):
    """Reads a record, with the things that were not written by their numbers."""

    def __init__(self, file: io.BytesIO, shared: Sequence[Any]) -> None:
        super().__init__(file)
        self._shared = shared

    def persistent_load(self, number: int) -> Any:
        return self._shared[number]


class _Store:
    """A file of records, and what they refer to."""

    def __init__(self, in_memory: int) -> None:
        self._file = tempfile.SpooledTemporaryFile(max(in_memory, 1))
        self._end = 0
        self._shared: list[Any] = []
        self._numbers: dict[int, int] = {}
        weakref.finalize(self, self._file.close)

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
        return _Unpickler(io.BytesIO(self._file.read(place[1])), self._shared).load()

    def _number(self, thing: Any) -> int | None:
        """Of what is kept as it is; None for what is written."""
        kind = type(thing)
        if kind in _PLAIN or issubclass(kind, np.generic | np.dtype):
            return None
        if kind.__module__.startswith("kinefit.") and not issubclass(kind, _OF_ALL_FRAMES):
            return None
        number = self._numbers.get(id(thing))
        if number is None:
            number = self._numbers[id(thing)] = len(self._shared)
            self._shared.append(thing)
        return number
