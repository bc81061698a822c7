"""Open Sound Control 1.0: messages and bundles as bytes, as much of it as VMC needs (strings, int32, float32)."""

from __future__ import annotations

import struct
from collections.abc import Sequence

_AT_ONCE = struct.pack(">Q", 1)  # the time tag that says: now


def message(address: str, *values: str | int | float) -> bytes:
    """One message with its arguments."""
    tags, data = ",", b""
    for value in values:
        if isinstance(value, str):
            tags, data = tags + "s", data + _text(value)
        elif isinstance(value, int):
            tags, data = tags + "i", data + struct.pack(">i", value)
        else:
            tags, data = tags + "f", data + struct.pack(">f", value)
    return _text(address) + _text(tags) + data


def bundle(messages: Sequence[bytes]) -> bytes:
    """Messages that belong together."""
    return b"".join([b"#bundle\0", _AT_ONCE, *(struct.pack(">i", len(one)) + one for one in messages)])


def _text(value: str) -> bytes:
    """A string, ended by a zero and filled up to a multiple of four bytes."""
    data = value.encode() + b"\0"
    return data + b"\0" * (-len(data) % 4)
