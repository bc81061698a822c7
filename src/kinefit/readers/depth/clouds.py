"""Clouds of points: PCD (ascii, binary, binary_compressed) and PLY (ascii, binary)."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_bytes
from kinefit.errors import CalibrationError, FileError, names_file
from kinefit.geometry.camera import Camera
from kinefit.geometry.se3 import inverse, rotation_from_quaternion, transform
from kinefit.readers.depth._kernels_clouds import lzf

ENDINGS = (".pcd", ".ply")
_REMEDY = "Export it again, as PCD or PLY with x, y and z."
_CUT = "The file is truncated: copy it again."
_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_MAX_LZF_RATIO = 100  # of unpacked to packed bytes: LZF makes 264 of three
_MAX_POINTS = 200_000_000  # more is a broken header


@dataclass(frozen=True, eq=False)
class FileCloud:
    """The point cloud of a file.

    Parameters
    ----------
    points : (N, 3)
        In the file's own unit and frame; NaN at pixels of an organised cloud without a point.
    shape : (height, width) or None
        Of the image of an organised cloud; its points are in row order.
    T_file_sensor : (4, 4)
        Pose of the sensor if the file states it (PCD's VIEWPOINT), else the identity; translation in the file's unit.
    """

    points: NDArray
    shape: tuple[int, int] | None
    T_file_sensor: NDArray


@names_file
def read_cloud(path: str | PathLike[str]) -> FileCloud:
    """Read a PCD or PLY file.

    Raises
    ------
    FileError
        Missing, truncated, or of another format.
    """
    data = read_bytes(Path(path))
    try:
        if data.startswith(b"ply"):
            return _ply(data)
        if b"FIELDS" in data[:2000]:
            return _pcd(data)
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
        raise FileError(f"its header cannot be understood ({error})", remedy=_REMEDY) from error
    raise FileError("neither PCD nor PLY", remedy=_REMEDY)


def _pcd(data: bytes) -> FileCloud:
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at)
        if end < 0 or at > 10_000:
            raise FileError("a PCD header without DATA", remedy=_REMEDY)
        words = data[at:end].decode("ascii").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    names, sizes, types = header["FIELDS"], [int(s) for s in header["SIZE"]], header["TYPE"]
    counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
    width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
    number = int(header.get("POINTS", [str(width * height)])[0])
    if not 0 <= number == width * height < _MAX_POINTS:
        raise FileError(f"{number} points, but {width} x {height}", remedy=_REMEDY)
    if not (set(sizes) <= {1, 2, 4, 8} and all(0 < c < 10_000 for c in counts) and len(counts) == len(names)):
        problem = f"SIZE {' '.join(map(str, sizes[:9]))}, COUNT {' '.join(map(str, counts[:9]))}"
        raise FileError(problem, remedy=_REMEDY)
    kinds = [np.dtype(f"<{_PCD_TYPES[t]}{s}") for t, s in zip(types, sizes, strict=True)]
    where = [_place(axis, names) for axis in "xyz"]
    body, kind = data[at:], header["DATA"][0]
    if kind == "ascii":
        columns = np.cumsum([0, *counts])
        points = _text(body, number, int(columns[-1]))[:, [columns[w] for w in where]]
    elif kind == "binary":
        record = np.dtype([(f"f{i}", k, (c,)) for i, (k, c) in enumerate(zip(kinds, counts, strict=True))])
        table = _binary(body, record, number)
        points = np.stack([table[f"f{w}"][:, 0].astype(float) for w in where], axis=1)
    elif kind == "binary_compressed":
        raw = _unpacked(body)
        starts = np.cumsum([0, *(number * s * c for s, c in zip(sizes, counts, strict=True))])
        if len(raw) < starts[-1]:
            raise FileError(f"{len(raw)} of {starts[-1]} bytes are there", remedy=_CUT)
        arrays = [np.frombuffer(raw, kinds[w], number * counts[w], int(starts[w]))[:: counts[w]] for w in where]
        points = np.stack([a.astype(float) for a in arrays], axis=1)
    else:
        raise FileError(f"DATA {kind}", remedy="There are: ascii, binary, binary_compressed.")
    tx, ty, tz, *q = [float(v) for v in header.get("VIEWPOINT", "0 0 0 1 0 0 0".split())]
    if len(q) != 4 or not np.linalg.norm(q) > 0.0:
        raise ValueError(f"VIEWPOINT with the quaternion {q}")
    T = transform(rotation_from_quaternion(np.array(q)), np.array([tx, ty, tz]))
    return FileCloud(points, (height, width) if height > 1 else None, T)


def _unpacked(body: bytes) -> NDArray[np.uint8]:
    packed, size = (int(v) for v in np.frombuffer(body, "<u4", 2))
    if len(body) < 8 + packed or size > _MAX_LZF_RATIO * len(body):
        raise FileError(f"{len(body) - 8} of {packed} bytes are there", remedy=_CUT)
    out = np.empty(size, np.uint8)
    if lzf(np.frombuffer(body, np.uint8, packed, 8), out) != size:
        raise FileError("its compressed data is broken", remedy="Copy it again, or write it as binary.")
    return out


def _ply(data: bytes) -> FileCloud:
    end = data.find(b"\n", data.find(b"end_header"))
    if b"end_header" not in data or end < 0:
        raise FileError("a PLY header without end_header", remedy=_CUT)
    lines, body = data[:end].decode("ascii").splitlines(), data[end + 1 :]
    kind = next((line.split()[1] for line in lines if line.startswith("format")), "")
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    name, number, properties = elements[0] if elements else ("", 0, [])
    if name != "vertex" or any(p[0] == "list" for p in properties) or not 0 <= number < _MAX_POINTS:
        raise FileError("its first element is not a plain 'vertex'", remedy=_REMEDY)
    where = [_place(axis, [p[1] for p in properties]) for axis in "xyz"]
    if kind == "ascii":
        points = _text(body, number, len(properties))[:, where]
    elif kind in ("binary_little_endian", "binary_big_endian"):
        order = "<" if kind == "binary_little_endian" else ">"
        record = np.dtype([(f"f{i}", order + _PLY_TYPES[p[0]]) for i, p in enumerate(properties)])
        table = _binary(body, record, number)
        points = np.stack([table[f"f{w}"].astype(float) for w in where], axis=1)
    else:
        raise FileError(f"format {kind or 'missing'}", remedy=_REMEDY)
    return FileCloud(points, None, np.eye(4))


def _place(axis: str, names: list[str]) -> int:
    if axis not in names:
        raise FileError(f"it has no {axis}, only {', '.join(names)}", remedy=_REMEDY)
    return names.index(axis)


def _text(body: bytes, rows: int, columns: int) -> NDArray:
    """(rows, columns) numbers; anything after them (faces) is ignored."""
    words = body.split(None, rows * columns)[: rows * columns]
    if len(words) < rows * columns:
        problem = f"{len(words) // max(columns, 1)} of {rows} points are there"
        raise FileError(problem, remedy=_CUT)
    return np.array(words, dtype="S32").astype(float).reshape(rows, columns)


def _binary(body: bytes, record: np.dtype, number: int) -> NDArray:
    if len(body) < number * record.itemsize:
        problem = f"{len(body) // record.itemsize} of {number} points are there"
        raise FileError(problem, remedy=_CUT)
    return np.frombuffer(body, record, number)


def depth_of(cloud: FileCloud) -> NDArray:
    """(H, W) depth of an organised cloud along its sensor's axis, in its unit; 0 at pixels without a point."""
    assert cloud.shape is not None
    z = in_sensor(cloud)[:, 2].reshape(cloud.shape)
    return np.where(z > 0.0, z, 0.0)


def in_sensor(cloud: FileCloud) -> NDArray:
    """(N, 3) points of a cloud in its sensor's frame, in its unit."""
    T = inverse(cloud.T_file_sensor)
    return cloud.points @ T[:3, :3].T + T[:3, 3]


def camera_of(cloud: FileCloud, name: str) -> Camera:
    """The pinhole camera of an organised cloud, at the origin, fitted to its points.

    Raises
    ------
    CalibrationError
        Points that do not lie on the rays of a pinhole camera within half a pixel: lens distortion, or no image.
    """
    assert cloud.shape is not None
    height, width = cloud.shape
    x = in_sensor(cloud)
    v, u = np.divmod(np.arange(len(x)), width)
    ok = np.isfinite(x).all(axis=1) & (x[:, 2] > 0)
    fits, K = [], np.eye(3)
    for axis, pixel in ((0, u), (1, v)):
        ray = x[ok, axis] / x[ok, 2]
        A = np.stack([ray, np.ones(len(ray))], axis=1)
        if len(ray) < 100 or np.ptp(ray) < 1e-3:
            raise CalibrationError("too few points to determine the camera", remedy="Give its intrinsics.")
        if not np.abs(A).max() < 1e6:
            raise CalibrationError("points that no camera sees", remedy="Give its intrinsics.")
        (K[axis, axis], K[axis, 2]), *_ = np.linalg.lstsq(A, pixel[ok], rcond=None)
        fits.append(np.percentile(np.abs(A @ (K[axis, axis], K[axis, 2]) - pixel[ok]), 99))
    if max(fits) > 0.5 or K[0, 0] <= 0 or K[1, 1] <= 0:
        problem = f"its points do not lie on the rays of a pinhole camera ({max(fits):.2g} px off)"
        raise CalibrationError(problem, remedy="Give intrinsics, or the points as an unorganised cloud (HEIGHT 1).")
    return Camera(name, (width, height), K)
