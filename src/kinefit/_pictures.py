"""Picture files that may be damaged, decoded within bounds of time."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_bytes
from kinefit.errors import FileError

_PNG = b"\x89PNG\r\n\x1a\n"


def read_picture(file: str | os.PathLike[str], flags: int = cv2.IMREAD_COLOR_RGB) -> NDArray:
    """A picture, (H, W) or (H, W, channels), of the type and channels that OpenCV's `flags` ask for.

    Raises
    ------
    FileError
        No picture, cut or damaged.
    """
    path = Path(file)
    data = read_bytes(path)
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and _is_whole(data) else None
    except cv2.error:
        picture = None
    if picture is None:
        raise FileError("no image, or damaged", file=path, remedy="Copy or write it again, or leave it out.")
    return np.asarray(picture)


def _is_whole(data: bytes) -> bool:
    """Whether the chunks of a PNG fit into the file: some decoders fill all that their lengths say.

    A file that ends within the closing chunk is whole.
    """
    if not data.startswith(_PNG):
        return True
    at = len(_PNG)
    while at + 8 <= len(data):
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        if kind == b"IEND":
            return length == 0
        at += 12 + length
    return at <= len(data)
