"""Records as bytes, and files of them: plain values, arrays and classes of a list; a file with a key has checksums.

Reading runs nothing. A record names its class by a number in the reader's own list, its attributes are set without a
constructor, and no array holds objects. The checksum of a record covers its bytes, its place in the file and the key of
the file, so that a record that is damaged, moved or of another file is never taken for one of this file.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

import msgspec
import numpy as np

from kinefit.errors import FileError

_PLAIN_TYPES = {type(None), bool, float, str, bytes}
_LIST, _TUPLE, _MAPPING, _ARRAY, _SCALAR, _LARGE_INTEGER, _REFERENCE, _RECORD = range(8)  # _RECORD + k: the k-th class
_INT64 = 2**63  # what msgpack holds of whole numbers; a generator of random numbers has longer ones
_HEAD = struct.Struct("<IBI16s")  # bytes that follow, tag, number, checksum
_NO_CHECKSUM = bytes(16)
_ERRORS = (msgspec.MsgspecError, ValueError, TypeError, LookupError, AttributeError, RecursionError)

Refer = Callable[[Any], int | str]
"""What stands in a record for an object that is not written."""

Resolve = Callable[[Any], Any]
"""The object that it stands for."""


@lru_cache
def _dtype(name: str) -> np.dtype[Any]:
    """The type of an array's numbers; never of objects, whose addresses would be read from the file."""
    dtype = np.dtype(name)
    if dtype.hasobject:
        raise ValueError("an array of objects")
    return dtype


class Codec:
    """Writes objects as bytes, and reads them: plain values, containers, arrays, and records of listed classes.

    Parameters
    ----------
    classes : records whose attributes are written (`__getstate__`) and set again; a file holds their numbers in this
        list, so only a reader with the same list reads it
    """

    def __init__(self, classes: Sequence[type]) -> None:
        self.classes = tuple(classes)
        self._codes = {one: _RECORD + k for k, one in enumerate(self.classes)}

    def encode(self, thing: Any, refer: Refer | None = None) -> bytes:
        """The bytes of an object; `refer` is asked for what stands for objects of classes that are not listed.

        Raises
        ------
        TypeError
            An object of another class, and no `refer`; an array of objects.
        """
        return msgspec.msgpack.encode(self._tree(thing, refer))

    def decode(self, data: bytes, resolve: Resolve | None = None, *, name: str = "") -> Any:
        """The object of some bytes of a file: a copy, with arrays that can be written where they could be.

        Raises
        ------
        FileError
            Bytes that no codec of these classes wrote.
        """
        try:
            return self._thing(msgspec.msgpack.decode(data), resolve)
        except _ERRORS as error:
            problem = f"this record is not from kinefit ({error})"
            raise FileError(problem, file=name, remedy="Run again: kinefit then computes it again.") from error

    def _tree(self, thing: Any, refer: Refer | None) -> Any:
        kind = type(thing)
        if kind in _PLAIN_TYPES:
            return thing
        if kind is int:
            return thing if -_INT64 <= thing < _INT64 else [_LARGE_INTEGER, str(thing)]
        code = self._codes.get(kind)
        if code is not None:
            out = [code]
            for name, value in (thing.__getstate__() or {}).items():
                out += (name, self._tree(value, refer))
            return out
        if kind is np.ndarray and not thing.dtype.hasobject:
            flags = thing.flags
            return [_ARRAY, thing.dtype.str, thing.shape, flags.fnc, flags.writeable, thing.tobytes("A")]
        if kind is tuple or kind is list:
            return [_TUPLE if kind is tuple else _LIST, *[self._tree(one, refer) for one in thing]]
        if kind is dict or kind is MappingProxyType:
            return [_MAPPING, *[self._tree(one, refer) for pair in thing.items() for one in pair]]
        if isinstance(thing, np.generic):
            return [_SCALAR, thing.dtype.str, thing.tobytes()]
        if refer is None:
            raise TypeError(f"a {kind.__name__} in a record")
        return [_REFERENCE, refer(thing)]

    def _thing(self, tree: Any, resolve: Resolve | None) -> Any:
        if type(tree) is not list:
            return tree
        code = tree[0]
        if code == _ARRAY:
            _, dtype, shape, fortran, writeable, data = tree
            room = bytearray(data) if writeable else data
            return np.ndarray(shape, _dtype(dtype), room, 0, None, "F" if fortran else "C")
        if code == _REFERENCE and resolve is not None:
            return resolve(tree[1])
        if code == _SCALAR:
            return np.frombuffer(tree[2], _dtype(tree[1]))[0]
        if code == _LARGE_INTEGER:
            return int(tree[1])
        if code >= _RECORD:
            thing = object.__new__(self.classes[code - _RECORD])
            vars(thing).update(zip(tree[1::2], [self._thing(one, resolve) for one in tree[2::2]], strict=True))
            return thing
        things = [self._thing(one, resolve) for one in tree[1:]]
        if code == _LIST:
            return things
        if code == _TUPLE:
            return tuple(things)
        if code == _MAPPING:
            return dict(zip(things[::2], things[1::2], strict=True))
        raise ValueError(f"a value of kind {code}")


def save_state(thing: Any) -> dict[str, Any]:
    """What changes of an object while frames are tracked: those attributes that its `state_attributes` name."""
    return {name: vars(thing)[name] for name in thing.state_attributes if name in vars(thing)}


def restore_state(thing: Any, state: Mapping[str, Any]) -> None:
    """Set an object, made anew, to what `save_state` gave of another."""
    vars(thing).update((name, state[name]) for name in thing.state_attributes if name in state)


class RecordFile:
    """Records one after the other in a file.

    Parameters
    ----------
    file : open to be read and written, exclusively
    key : up to 64 bytes, on which every checksum depends; default: no checksums, for a file that ends with the process
    start : byte at which the first record begins
    name : path for messages
    """

    def __init__(self, file: IO[bytes], key: bytes | None = None, *, start: int = 0, name: str | Path = "") -> None:
        self._file, self._key, self.start, self.end, self.name = file, key, start, start, str(name)

    def append(self, data: bytes, tag: int = 0, number: int = 0) -> int:
        """Add a record; returns the byte at which it begins. `tag` (a byte) and `number` say what it is."""
        at = self.end
        self._file.seek(at)
        self._file.write(_HEAD.pack(len(data), tag, number, self._checksum(at, tag, number, data)))
        self._file.write(data)
        self.end = at + _HEAD.size + len(data)
        return at

    def read(self, at: int) -> bytes:
        """The bytes of the record that begins at a byte.

        Raises
        ------
        FileError
            It is damaged.
        """
        found = self._record(at, self.end)
        if found is None:
            problem = f"the record at byte {at} is damaged"
            raise FileError(problem, file=self.name, remedy="Check the disk and run again.")
        return found[2]

    def scan(self) -> Iterator[tuple[int, int, int, bytes]]:
        """Begin, tag, number and bytes of each record of a file that was there, up to the first that is damaged."""
        size, self.end = self._file.seek(0, os.SEEK_END), self.start
        while (found := self._record(self.end, size)) is not None:
            at, self.end = self.end, self.end + _HEAD.size + len(found[2])
            yield at, *found

    def cut(self, end: int) -> None:
        """Remove what comes after a byte."""
        self._file.truncate(end)
        self.end = end

    def flush(self) -> None:
        """Have all records on the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def _record(self, at: int, size: int) -> tuple[int, int, bytes] | None:
        self._file.seek(at)
        head = self._file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return None
        length, tag, number, checksum = _HEAD.unpack(head)
        if at + _HEAD.size + length > size:  # never read more than there is, whatever a damaged head says
            return None
        data = self._file.read(length)
        return (tag, number, data) if checksum == self._checksum(at, tag, number, data) else None

    def _checksum(self, at: int, tag: int, number: int, data: bytes) -> bytes:
        if self._key is None:
            return _NO_CHECKSUM
        place = struct.pack("<QQ", at, tag << 32 | number)
        return hashlib.blake2b(data, digest_size=16, key=self._key, salt=place).digest()
