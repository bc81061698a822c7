"""Depth images as files: folders of 16-bit PNG or TIFF, raw 16-bit files, numpy archives."""

from __future__ import annotations

import fnmatch
import os
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_npy, read_npz, regular
from kinefit._pictures import page_sizes, read_page, read_picture
from kinefit.errors import FileError, ObservationError, names_file
from kinefit.geometry.camera import Camera

PICTURES = (".png", ".tif", ".tiff")
_MAX_PERSON_DISTANCE = 8.0  # [m] of most of a depth image with a person in it
_SATURATED_COUNT = 65535  # the highest of a 16-bit sensor: too far or too bright


@dataclass(frozen=True, eq=False)
class DepthSource:
    """A source of depth images, before its unit is known.

    Parameters
    ----------
    count : int
        Frames.
    image : callable
        Frame number -> (H, W), counts or metres.
    size : (width, height) [px]
    unit : float [m]
        Of one count, by the format's convention.
    stated : bool
        Whether the file itself states the unit.
    times : (F,) [s] or None
    camera : Camera or None
    rate : float [Hz] or None
    names : tuple of str
        Of the files, if there is one for each frame; else empty.
    notes : tuple of str
        What is worth saying of the files.
    """

    count: int
    image: Callable[[int], NDArray]
    size: tuple[int, int]
    unit: float
    stated: bool = False
    times: NDArray | None = None
    camera: Camera | None = None
    rate: float | None = None
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """Key that sorts names by the numbers in them, whatever their case: 2.png before 10.png."""
    parts = re.split(r"(\d+)", name.lower())
    return tuple((1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts)


def listed(path: Path) -> list[Path]:
    """Files of a folder, of a pattern such as frames/depth_*.png, or one file; in natural order."""
    if path.is_dir():
        found = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
    elif "*" in path.name:
        there = os.listdir(path.parent) if path.parent.is_dir() else []
        literal = path.name.replace("[", "[[]")  # brackets in names of files, or else a choice of characters
        names = fnmatch.filter(there, literal) or fnmatch.filter(there, path.name)
        found = [file for name in names if (file := path.parent / name).is_file()]
    else:
        found = [path] if regular(path).is_file() else []
    return sorted(found, key=lambda file: natural(file.name))


def picture_source(files: list[Path]) -> DepthSource:
    """Source of 16-bit images (counts) or float TIFF (metres), one file a frame, or one TIFF of many pages."""
    pages = len(page_sizes(files[0])) if len(files) == 1 else 1  # one TIFF of many pages

    def image(i: int) -> NDArray:
        return depth_picture(files[i]) if pages == 1 else _depth_of(read_page(files[0], i), files[0])

    first, names = image(0), tuple(f.name for f in files) if pages == 1 else ()
    unit = 0.001 if first.dtype == np.uint16 else 1.0
    return DepthSource(len(files) * pages, lambda i: counts_of(image(i)), first.shape[::-1], unit, names=names)


def depth_picture(file: Path) -> NDArray:
    """(H, W) depth image of a file: 16-bit counts, or metres in float.

    Raises
    ------
    FileError
        No image, or damaged.
    ObservationError
        An image of 8 bits, or of several channels.
    """
    return _depth_of(read_picture(file, cv2.IMREAD_UNCHANGED), file)


def _depth_of(picture: NDArray, file: Path) -> NDArray:
    if picture.ndim != 2 or picture.dtype not in (np.uint16, np.float32, np.float64):
        channels = 1 if picture.ndim == 2 else picture.shape[2]
        raise ObservationError(
            f"an image of {picture.itemsize * 8} bits in {channels} channel(s), not a depth image", file=file,
            remedy="A depth image has one channel of 16 bits or of float. This may be a colour image. "
            "Name only the depth files: depth_*.png.",
        )  # fmt: skip
    return picture


def counts_of(picture: NDArray) -> NDArray:
    """(H, W) float32 counts of an image, 0 at saturated 16-bit pixels."""
    depth = picture.astype(np.float32)
    if picture.dtype == np.uint16:
        depth[picture == _SATURATED_COUNT] = 0.0
    return depth


def raw_source(files: list[Path], size: tuple[int, int] | None, unit: float | None = None) -> DepthSource:
    """Source of raw little-endian 16-bit counts, row by row: one file a frame, or all frames in one file.

    Without a `unit` [m], values that are depths in float16 or float32 are read as such, in metres. Reads the largest
    group of files whose names differ by their numbers only.

    Raises
    ------
    ObservationError
        No image size, or files whose length does not fit it.
    """
    alike = Counter(re.sub(r"\d+", "#", file.name) for file in files).most_common(1)[0][0]
    files = [file for file in files if re.sub(r"\d+", "#", file.name) == alike]
    length = files[0].stat().st_size
    if size is None:
        remedy = "Give size = [width, height]; 614400 bytes are 640x480 in 16 bits."
        raise ObservationError(f"raw files of {length} bytes without a stated image size", file=files[0], remedy=remedy)
    width, height = size
    kind, said = _raw_type(files[0], width * height, unit)
    frame = np.dtype(kind).itemsize * width * height
    for file in files:
        have = file.stat().st_size
        if have == 0 or have % frame or (len(files) > 1 and have != frame):
            raise ObservationError(
                f"{have} bytes, but {width}x{height} px of {8 * frame // (width * height)} bits are {frame}", file=file,
                remedy="Correct the size, or name only the depth files by a pattern (depth-*).",
            )  # fmt: skip
    per_file = length // frame

    def image(i: int) -> NDArray:
        file, place = (files[i], 0) if len(files) > 1 else (files[0], i)
        data = np.fromfile(file, kind, width * height, offset=place * frame)
        if len(data) < width * height:
            raise FileError("became shorter while it was read", file=file, place=f"frame {i}", remedy="Copy it again.")
        return counts_of(data.reshape(height, width))

    names = tuple(file.name for file in files) if len(files) > 1 else ()
    metres = 0.001 if kind == "<u2" else 1.0
    return DepthSource(len(names) or per_file, image, size, metres, names=names, notes=(said,) if said else ())


def _raw_type(file: Path, pixels: int, unit: float | None) -> tuple[str, str]:
    """Type of the numbers in a raw file, by its length and values, and what is worth saying of it.

    Depths as float16 or float32 [m] have bytes that are improbable as 16-bit counts of millimetres, and the reverse.
    """
    with file.open("rb") as stream:
        data = stream.read(4 * pixels)
    if file.stat().st_size == 4 * pixels and _is_metres(np.frombuffer(data, "<f4")):
        return "<f4", "raw files of 4 bytes a pixel, read as float32 in metres; two 16-bit images look the same"
    counts = np.frombuffer(data[: len(data) // 2 * 2], "<u2")
    is_far = counts.any() and np.median(counts[counts > 0]) * 0.001 > _MAX_PERSON_DISTANCE
    if unit is None and is_far and _is_metres(counts.view("<f2")):
        return "<f2", "raw 16-bit files, read as float16 in metres; for counts that look the same write unit"
    return "<u2", ""


def _is_metres(values: NDArray) -> bool:
    """Whether nearly all values that are not 0 or NaN are depths [m] of some metres."""
    with np.errstate(invalid="ignore"):
        known = values[np.isfinite(values) & (values != 0)].astype(float)
        return bool(len(known)) and float(np.mean((known > 0.05) & (known < 30.0))) > 0.99


def npy_source(files: list[Path]) -> DepthSource:
    """Source of numpy files: one image (H, W) a file, or all (F, H, W) in one; whole numbers are counts, else metres.

    Raises
    ------
    FileError
        Damaged, or no array of numbers.
    ObservationError
        An array of another shape or type.
    """
    remedy = "Give an image (height, width) a file, or an archive .npz with `depth` (frames, height, width)."

    def image(file: Path) -> NDArray:
        array = read_npy(file, remedy=remedy)
        if array.ndim not in ((2,) if len(files) > 1 else (2, 3)) or not array.size or array.dtype.kind not in "uif":
            raise ObservationError(f"an array of shape {array.shape} of {array.dtype}", file=file, remedy=remedy)
        return array

    first = image(files[0])
    unit = 1.0 if first.dtype.kind == "f" else 0.001
    if first.ndim == 3:
        return DepthSource(len(first), lambda i: counts_of(first[i]), first.shape[:0:-1], unit)
    names = tuple(file.name for file in files)
    return DepthSource(len(files), lambda i: counts_of(image(files[i])), first.shape[::-1], unit, names=names)


@names_file
def array_source(path: Path) -> DepthSource:
    """Source of a numpy archive: `depth` (F, H, W) or (H, W); optional `times` (F,) [s], `unit` [m], `rate` [Hz].

    Raises
    ------
    ObservationError
        No `depth`, or an array of a wrong shape or type.
    """
    content = read_npz(path, remedy="Write it with numpy.savez.")
    keys = sorted(content)
    depth = content.get("depth")
    if depth is None or depth.ndim not in (2, 3) or not depth.size or depth.dtype.kind not in "uif":
        shape = "" if depth is None else f", `depth` has shape {depth.shape} of {depth.dtype}"
        remedy = "Give `depth` (frames, height, width), in metres or in whole counts with `unit` [m]."
        raise ObservationError(f"it holds {', '.join(keys) or 'nothing'}{shape}", remedy=remedy)
    depth = depth if depth.ndim == 3 else depth[None]
    times = content.get("times")
    if times is not None and (times.shape != (len(depth),) or times.dtype.kind not in "uif"):
        problem = f"{times.shape} times for {len(depth)} frames, of type {times.dtype}"
        raise ObservationError(problem, remedy="Give `times` (frames,) in seconds.")
    number = {}
    for key in ("unit", "rate"):
        if key in content:
            value = content[key]
            if value.size != 1 or value.dtype.kind not in "uif":
                raise ObservationError(f"`{key}` is not a number", remedy="Give one number.")
            number[key] = float(value.ravel()[0])
    unit = number.get("unit", 1.0 if depth.dtype.kind == "f" else 0.001)
    return DepthSource(
        len(depth), lambda i: counts_of(depth[i]), depth.shape[:0:-1], unit, "unit" in number, times,
        rate=number.get("rate"),
    )  # fmt: skip
