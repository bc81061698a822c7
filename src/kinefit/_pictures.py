"""Image files that may be damaged, decoded within bounds of time and memory."""

from __future__ import annotations

import io
import math
import os
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_bytes, regular
from kinefit._image_headers import IMAGE_KINDS, MAX_IMAGE_PIXELS, Size, image_sizes
from kinefit.errors import FileError

_PNG = b"\x89PNG\r\n\x1a\n"
_MAX_FILE_BYTES = 8 * MAX_IMAGE_PIXELS  # of one image, not compressed: four channels of 16 bits
_REMEDY_DAMAGED = "Copy or write it again, or leave it out."


def read_picture(file: str | os.PathLike[str], flags: int = cv2.IMREAD_COLOR_RGB) -> NDArray:
    """The first image of a file, (H, W) or (H, W, channels), of the type and channels that OpenCV's `flags` ask for.

    Raises
    ------
    FileError
        No image of a kind that is read, cut, damaged, or of more than `MAX_IMAGE_PIXELS`.
    """
    path = Path(file)
    page_sizes(path)  # before the file is loaded
    if (size := path.stat().st_size) > _MAX_FILE_BYTES:
        raise FileError(f"an image file of {size / 1e6:.0f} MB", file=path, remedy=_REMEDY_DAMAGED)
    return decode_picture(read_bytes(path), flags, file=path)


def decode_picture(
    data: bytes, flags: int = cv2.IMREAD_COLOR_RGB, *, file: str | os.PathLike[str], place: str | None = None
) -> NDArray:
    """The first image in the bytes of a file, as `read_picture`; `file` and `place` are for messages.

    Raises
    ------
    FileError
        As `read_picture`.
    """
    _checked_sizes(io.BytesIO(data), file, place)
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if _is_whole(data) else None
    except cv2.error:
        picture = None
    if picture is None:
        raise FileError("no image, or damaged", file=file, place=place, remedy=_REMEDY_DAMAGED)
    return np.asarray(picture)


def page_sizes(file: Path) -> list[Size]:
    """Sizes (width, height) [px] of the images in a file, of a TIFF one a page, by its header alone.

    Raises
    ------
    FileError
        No image of a kind that is read, a damaged header, or an image of more than `MAX_IMAGE_PIXELS`.
    """
    try:
        with regular(file).open("rb") as stream:
            return _checked_sizes(stream, file)
    except OSError as problem:
        raise FileError(f"cannot be read ({problem.strerror})", file=file, remedy="Check the path.") from problem


def _checked_sizes(stream: BinaryIO, file: str | os.PathLike[str], place: str | None = None) -> list[Size]:
    sizes = image_sizes(stream)
    if not sizes or min(map(min, sizes)) < 1:
        problem = f"no image, or damaged: kinefit reads {IMAGE_KINDS}"
        raise FileError(problem, file=file, place=place, remedy=_REMEDY_DAMAGED)
    check_image_size(max(sizes, key=math.prod), file, place)
    return sizes


def read_page(file: Path, number: int) -> NDArray:
    """One page of a TIFF whose `page_sizes` are known, unchanged.

    Raises
    ------
    FileError
        Damaged.
    """
    try:
        done, pages = cv2.imreadmulti(str(file), number, 1, flags=cv2.IMREAD_UNCHANGED)
    except cv2.error:
        done, pages = False, ()
    if not done or len(pages) != 1:
        raise FileError("a page that cannot be decoded", file=file, place=f"page {number}", remedy=_REMEDY_DAMAGED)
    return np.asarray(pages[0])


def check_image_size(size: Size, file: str | os.PathLike[str], place: str | None = None) -> None:
    """Raise FileError where an image, or a frame of a video, of (width, height) [px] is too large to be decoded."""
    if math.prod(size) > MAX_IMAGE_PIXELS:
        problem = f"an image of {size[0]} x {size[1]} px, more than {MAX_IMAGE_PIXELS // 10**6} million"
        remedy = "Write it smaller; or copy it again, if that is not its size."
        raise FileError(problem, file=file, place=place, remedy=remedy)


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
