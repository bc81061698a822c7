"""Images that claim to be larger than they are."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np


def png(side: int, depth: int = 8) -> bytes:
    """A black grey image, which packs a thousandfold."""
    row, pack = bytes(1 + side * depth // 8), zlib.compressobj(9, wbits=-15)
    packed = pack.compress(row) + pack.flush(zlib.Z_FULL_FLUSH)  # from which on nothing refers to what was before
    adler = struct.pack(">HH", side * len(row) % 65521, 1)  # of zeros
    pixels = b"\x78\xda" + side * packed + b"\x03\x00" + adler
    parts = (b"IHDR", struct.pack(">IIBBBBB", side, side, depth, 0, 0, 0, 0)), (b"IDAT", pixels), (b"IEND", b"")
    chunks = (struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def jpeg(side: int) -> bytes:
    """A small JPEG whose header claims another size."""
    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    struct.pack_into(">HH", data, data.find(b"\xff\xc0") + 5, side, side)
    return bytes(data)
