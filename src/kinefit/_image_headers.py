"""Sizes of images by the headers of their files, read before a decoder reserves memory for the pixels."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import BinaryIO

Size = tuple[int, int]

MAX_IMAGE_PIXELS = 110_000_000
"""Pixels of one image or video frame. The largest photographs have 108 million; 8-bit RGB of them takes 330 MB."""

IMAGE_KINDS = "PNG, JPEG, TIFF, BMP, GIF, WebP, PBM, PGM and PPM"
"""Formats of images that are decoded."""

_START_BYTES = 1024  # what is read at once; all headers but those of JPEG and TIFF end within it
_MAX_JPEG_SEGMENTS = 10_000  # before the frame header; metadata of 64 kB each, so 640 MB
_MAX_JPEG_FILL_BYTES = 4096  # between two segments; encoders write none, or a few to align them
_MAX_TIFF_PAGES = 100_000  # 55 minutes of a depth sensor at 30 Hz
_MAX_TIFF_TAGS = 1000  # of one page; writers give some thirty
_TIFF_SIZE_TAGS = 256, 257, 322, 323  # width and height of the image, then of its tiles
_TIFF_INTEGERS = {1: "B", 3: "H", 4: "I", 6: "b", 8: "h", 9: "i", 16: "Q", 17: "q"}  # types of a tag's value


def image_sizes(file: BinaryIO) -> list[Size]:
    """Sizes (width, height) [px] of the images in a file, of a TIFF one a page; no pixel is decoded.

    Empty where the file is of no kind in `IMAGE_KINDS`, or its header is damaged. A TIFF page has the size of its tiles
    where these are larger.
    """
    start = file.read(_START_BYTES)
    for signature, sizes in _READERS.items():
        if start.startswith(signature):
            try:
                return sizes(start, file)
            except (struct.error, IndexError, OverflowError, OSError):  # an offset beyond all files
                return []
    return []


def _png(start: bytes, file: BinaryIO) -> list[Size]:
    return [struct.unpack_from(">II", start, 16)] if start[12:16] == b"IHDR" else []


def _gif(start: bytes, file: BinaryIO) -> list[Size]:
    return [struct.unpack_from("<HH", start, 6)]


def _bmp(start: bytes, file: BinaryIO) -> list[Size]:
    (header_size,) = struct.unpack_from("<I", start, 14)
    width, height = struct.unpack_from("<HH" if header_size == 12 else "<ii", start, 18)
    return [(abs(width), abs(height))]  # a negative height: rows from the top


def _webp(start: bytes, file: BinaryIO) -> list[Size]:
    if start[8:12] != b"WEBP":
        return []
    kind = start[12:16]
    if kind == b"VP8X":
        low_width, high_width, low_height, high_height = struct.unpack_from("<HBHB", start, 24)
        return [(1 + (high_width << 16 | low_width), 1 + (high_height << 16 | low_height))]
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", start, 21)
        return [(1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF))]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", start, 26)
        return [(width & 0x3FFF, height & 0x3FFF)]
    return []


_PNM = re.compile(rb"P[1-6](?:[ \t\n]|\r\n|#[^\r\n]*+\r?\n)+(\d{1,9})(?:[ \t\n]|\r\n|#[^\r\n]*+\r?\n)+(\d{1,9})\s")


def _pnm(start: bytes, file: BinaryIO) -> list[Size]:
    found = _PNM.match(start)
    return [(int(found[1]), int(found[2]))] if found else []


def _jpeg(start: bytes, file: BinaryIO) -> list[Size]:
    file.seek(2)
    for _ in range(_MAX_JPEG_SEGMENTS):
        marker = _jpeg_marker(file)
        if 0xD0 <= marker <= 0xD8 or marker == 0x01:  # without a length
            continue
        (length,) = struct.unpack(">H", file.read(2))
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame header
            _, height, width = struct.unpack(">BHH", file.read(5))
            return [(width, height)]
        if marker in (0xD9, 0xDA) or length < 2:  # the end, or pixels without a frame
            return []
        file.seek(length - 2, 1)
    return []


def _jpeg_marker(file: BinaryIO) -> int:
    """The byte after the next 0xFF that is neither 0xFF nor 0; decoders skip what stands before it."""
    fill = file.read(1)
    for _ in range(_MAX_JPEG_FILL_BYTES):
        last, fill = fill, file.read(1)
        if last == b"\xff" and fill not in (b"\xff", b"\0"):
            return fill[0]
    raise IndexError("no marker")


def _tiff(start: bytes, file: BinaryIO) -> list[Size]:
    order = "<" if start[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", start, 2)[0] == 43
    count_format, tag_format, offset_format = ("Q", "HHQ8s", "Q") if big else ("H", "HHI4s", "I")
    (at,) = struct.unpack_from(order + offset_format, start, 8 if big else 4)
    sizes: list[Size] = []
    seen = set[int]()
    while at:
        if at in seen or len(sizes) >= _MAX_TIFF_PAGES:
            return []
        seen.add(at)
        file.seek(at)
        (count,) = struct.unpack(order + count_format, file.read(struct.calcsize("=" + count_format)))
        if count > _MAX_TIFF_TAGS:
            return []
        tags = file.read(count * struct.calcsize("=" + tag_format))
        found = dict.fromkeys(_TIFF_SIZE_TAGS, 0)
        for tag, kind, _, value in struct.iter_unpack(order + tag_format, tags):
            if tag in found and kind in _TIFF_INTEGERS:
                found[tag] = max(found[tag], struct.unpack_from(order + _TIFF_INTEGERS[kind], value)[0])
        image, tile = ((found[tag], found[tag + 1]) for tag in (256, 322))
        sizes.append(max(image, tile, key=lambda size: size[0] * size[1]))
        (at,) = struct.unpack(order + offset_format, file.read(struct.calcsize("=" + offset_format)))
    return sizes


_READERS: dict[bytes, Callable[[bytes, BinaryIO], list[Size]]] = {
    b"\x89PNG\r\n\x1a\n": _png, b"\xff\xd8": _jpeg, b"II*\0": _tiff, b"MM\0*": _tiff, b"II+\0": _tiff, b"MM\0+": _tiff,
    b"BM": _bmp, b"GIF87a": _gif, b"GIF89a": _gif, b"RIFF": _webp, **{b"P%d" % k: _pnm for k in range(1, 7)},
}  # fmt: skip
