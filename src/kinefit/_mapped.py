"""Large arrays in unnamed temporary files: they need memory only while they are used."""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import sys
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

_trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None

MIN_MAPPED_BYTES = 8 * 2**20
"""Bytes from which an array lies in a file: keypoints of a camera of some minutes."""


def room(shape: tuple[int, ...], dtype: Any = float) -> NDArray:
    """Zeros, in a file (`TMPDIR`) where they are many and there is room for them, else in memory."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < MIN_MAPPED_BYTES or not hasattr(os, "posix_fallocate"):
        return np.zeros(shape, dtype)
    try:
        with tempfile.TemporaryFile() as file:
            os.posix_fallocate(file.fileno(), 0, size)  # so that a full disk is noticed here, not by a signal later
            return np.ndarray(shape, dtype, buffer=mmap.mmap(file.fileno(), size))
    except OSError:
        return np.zeros(shape, dtype)


def kept(array: NDArray) -> NDArray:
    """The same numbers in a `room` of their own, where they are many; else the array itself."""
    if array.nbytes < MIN_MAPPED_BYTES:
        return array
    out = room(array.shape, array.dtype)
    out[...] = array
    release(out)
    return out


def release(*arrays: NDArray | None) -> None:
    """Give back the memory of what lies in files; the numbers stay, and take memory again when they are looked at."""
    some = False
    for array in arrays:
        owner: Any = array
        while isinstance(owner, np.ndarray):
            owner = owner.base
        if isinstance(owner, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
            owner.madvise(mmap.MADV_DONTNEED)
            some = True
    if some and _trim is not None:  # what was computed from them is gone, and left holes that are not given back
        _trim(0)
