"""Open Sound Control 1.0: messages and bundles as bytes, as much of it as VMC needs (strings, int32, float32)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache

_AT_ONCE = struct.pack(">Q", 1)  # the time tag that says: now


def message(address: str, *values: str | int | float) -> bytes:
    """One message with its arguments."""
    kinds = "".join("s" if isinstance(v, str) else "i" if isinstance(v, int) else "f" for v in values)
    data = b"".join([
        _text(v) if kind == "s" else struct.pack(">" + kind, v) for kind, v in zip(kinds, values)
    ])  # fmt: skip
    return _text(address) + _text("," + kinds) + data


def bundle(messages: Sequence[bytes]) -> bytes:
    """Messages that belong together."""
    return b"".join([b"#bundle\0", _AT_ONCE, *(struct.pack(">i", len(one)) + one for one in messages)])


@lru_cache(maxsize=1000)  # the same addresses and bones in every pose
def _text(value: str) -> bytes:
    """A string, ended by a zero and filled up to a multiple of four bytes."""
    data = value.encode() + b"\0"
    return data + b"\0" * (-len(data) % 4)
