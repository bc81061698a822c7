"""The focal length that a phone states in its video: Apple's keys in the moov box, which FFmpeg omits."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_VIDEO_CROP_FACTOR = 1.15  # on the stated length: a video crops the sensor, wide and stabilised (one: 32 for 27 mm)
_MAX_MOOV_BYTES = 1 << 26  # an hour at 240 Hz has a tenth
_FULL_FRAME_MM = 36.0  # longer side of the sensor


def stated_focal_length(path: Path) -> float | None:
    """Focal length [mm, full-frame equivalent] that a video file states; None if it states none."""
    try:
        with path.open("rb") as file:
            while len(head := file.read(16)) == 16:
                size, kind, long = struct.unpack(">I4sQ", head)
                file.seek(-8 if size != 1 else 0, 1)
                left = size - 8 if size != 1 else long - 16
                if kind == b"moov" and 0 < left <= _MAX_MOOV_BYTES:
                    return _value(file.read(left))
                if left < 0:
                    break
                file.seek(left, 1)
    except (OSError, struct.error, ValueError, OverflowError):  # a file that is cut or of another kind states nothing
        pass
    return None


def field_of_view(focal_length: float) -> float:
    """Field of view [deg] across the longer side of a video, from the stated focal length [mm]; good to a tenth."""
    return float(2.0 * np.degrees(np.arctan(_FULL_FRAME_MM / 2.0 / (_VIDEO_CROP_FACTOR * focal_length))))


def _value(data: bytes) -> float | None:
    """Value of `_KEY` in any `meta` of a moov box; None without one."""
    for kind, inner in _boxes(data):
        if kind in (b"trak", b"udta"):
            found = _value(inner)
        elif kind == b"meta":
            parts = dict(_boxes(inner if inner[4:8] == b"hdlr" else inner[4:]))  # QuickTime's has no version
            found = _item(parts.get(b"keys", b""), parts.get(b"ilst", b""))
        else:
            continue
        if found is not None:
            return found
    return None


def _item(keys: bytes, items: bytes) -> float | None:
    """Value of `_KEY`, from names in a `keys` box and values in an `ilst` box, numbered from 1; None without it."""
    names = [name for _, name in _boxes(keys[8:])]
    values = {int.from_bytes(kind, "big"): item for kind, item in _boxes(items)}
    if _KEY not in names or (item := values.get(names.index(_KEY) + 1)) is None:
        return None
    data = dict(_boxes(item)).get(b"data", b"")
    kind, value = int.from_bytes(data[:4], "big"), data[8:]
    if kind == 1:  # well-known types of QuickTime: text, and numbers
        number = float(value.decode("ascii", "replace"))
    elif kind in (23, 24):
        number = float(struct.unpack(">f" if kind == 23 else ">d", value)[0])
    else:
        number = float(int.from_bytes(value, "big", signed=True))
    return number if 5.0 <= number <= 500.0 else None


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(kind, content) of consecutive boxes."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if size < 8 or at + size > len(data):
            return
        yield kind, data[at + 8 : at + size]
        at += size
