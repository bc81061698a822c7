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

from kinefit._files import read_npz, regular
from kinefit._pictures import page_sizes, read_page, read_picture
from kinefit.errors import FileError, ObservationError, names_file
from kinefit.geometry.camera import Camera

PICTURES = (".png", ".tif", ".tiff")
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


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """Key that sorts names by the numbers in them: 2.png before 10.png."""
    parts = re.split(r"(\d+)", name)
    return tuple((1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts)


def listed(path: Path) -> list[Path]:
    """Files of a folder, of a pattern such as frames/depth_*.png, or one file; in natural order."""
    if path.is_dir():
        found = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
    elif "*" in path.name:
        names = fnmatch.filter(os.listdir(path.parent), path.name) if path.parent.is_dir() else []
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


def raw_source(files: list[Path], size: tuple[int, int] | None) -> DepthSource:
    """Source of raw little-endian 16-bit counts, row by row: one file a frame, or all frames in one file.

    Reads the largest group of files whose names differ by their numbers only.

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
    frame = 2 * width * height
    for file in files:
        have = file.stat().st_size
        if have == 0 or have % frame or (len(files) > 1 and have != frame):
            raise ObservationError(
                f"{have} bytes, but {width}x{height} px of 16 bits are {frame}", file=file,
                remedy="Correct the size, or name only the depth files by a pattern (depth-*).",
            )  # fmt: skip
    per_file = length // frame

    def image(i: int) -> NDArray:
        file, place = (files[i], 0) if len(files) > 1 else (files[0], i)
        data = np.fromfile(file, "<u2", width * height, offset=place * frame)
        if len(data) < width * height:
            raise FileError("became shorter while it was read", file=file, place=f"frame {i}", remedy="Copy it again.")
        return counts_of(data.reshape(height, width))

    count = len(files) if len(files) > 1 else per_file
    return DepthSource(count, image, size, 0.001, names=tuple(f.name for f in files) if len(files) > 1 else ())


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
