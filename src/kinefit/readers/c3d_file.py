"""Parser of C3D files: header, parameters and 3D points, every offset checked against the file's size.

ezc3d is no alternative: it crashes on some damaged files, reads truncated ones without an error, and rejects big-endian
ones and unexpected types. Source: C3D User Guide, Motion Lab Systems, 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import regular
from kinefit.errors import FileError

_BLOCK_BYTES = 512
_REMEDY = "Export the file again, or repair it with a C3D editor such as Mokka."
_EVENT_KEY = 12345  # of the header's events
_MAX_EVENTS = 18  # in the header
_PROCESSORS = {84: "intel", 85: "dec", 86: "mips"}
_SIZES = {-1: 1, 1: 1, 2: 2, 4: 4}  # [bytes] of the parameter types

Values = list[str] | NDArray


@dataclass(frozen=True)
class C3d:
    """Content of a C3D file, in the file's own units.

    Parameters
    ----------
    points, missing, residual : (F, N, 3), (F, N) bool, (F, N)
    parameters : {"GROUP:NAME": list of str or array}
    analog : (F, A) raw samples of every frame, channel by channel for each of `samples` times
    events : (label, time [s]) of the header
    """

    points: NDArray
    missing: NDArray
    residual: NDArray
    rate: float
    first_frame: int
    parameters: dict[str, Values]
    analog: NDArray
    samples: int
    events: tuple[tuple[str, float], ...]


def read_c3d(path: Path) -> C3d:
    """Read the points and all parameters; raises FileError for a damaged or truncated file."""
    try:
        raw = regular(path).read_bytes()
    except FileNotFoundError as error:
        raise FileError("no such file", file=path) from error
    except OSError as error:
        raise FileError(f"cannot be read ({error})", file=path) from error
    if len(raw) < 2 * _BLOCK_BYTES or raw[1] != 0x50 or raw[0] == 0:
        raise FileError(f"not a C3D file ({len(raw)} bytes)", file=path, remedy="Name a C3D file of your system.")
    section = (raw[0] - 1) * _BLOCK_BYTES
    processor = _PROCESSORS.get(raw[section + 3]) if section + 4 <= len(raw) else None
    if processor is None:
        raise FileError("it points to no parameter section", file=path, place="header", remedy=_REMEDY)
    parameters = _read_parameters(raw, section, processor, path)
    return _read_points(raw, processor, parameters, path)


def _numbers(raw: bytes, kind: int, processor: str) -> NDArray:
    """Bytes, 16-bit integers or 32-bit floats of any of the three processors."""
    order = ">" if processor == "mips" else "<"
    if kind == 1:
        return np.frombuffer(raw, np.int8)
    if kind == 2:
        return np.frombuffer(raw, f"{order}i2")
    if processor != "dec":
        return np.frombuffer(raw, f"{order}f4")
    words = np.frombuffer(raw, "<u2").reshape(-1, 2).astype(np.uint32)  # VAX: words swapped, exponent larger by two
    bits = words[:, 0] << 16 | words[:, 1]
    return np.where(bits & 0x7F800000, bits.view(np.float32) / 4, np.float32(0)).astype(np.float32)


def _read_parameters(raw: bytes, section: int, processor: str, path: Path) -> dict[str, Values]:
    groups: dict[int, str] = {}
    records: list[tuple[int, str, bytes]] = []
    data_start = (int(np.frombuffer(raw[16:18], ">u2" if processor == "mips" else "<u2")[0]) - 1) * _BLOCK_BYTES
    end = min(len(raw), max(section + raw[section + 2] * _BLOCK_BYTES, data_start))  # some writers state too few blocks
    at, last = section + 4, "the first record"
    while at + 2 <= end and raw[at]:
        length = abs(int(np.int8(raw[at] - 256 if raw[at] > 127 else raw[at])))
        group = raw[at + 1] - 256 if raw[at + 1] > 127 else raw[at + 1]
        pointer = at + 2 + length
        if group == 0:
            break
        if pointer + 2 > end:
            raise FileError("a parameter extends beyond its section", file=path, place=f"after {last}", remedy=_REMEDY)
        name = raw[at + 2 : pointer].decode("latin-1").strip().upper()
        offset = int.from_bytes(raw[pointer : pointer + 2], "big" if processor == "mips" else "little")
        following = pointer + offset
        if not name.isprintable() or (offset and (offset < 3 or following > end)):
            raise FileError(
                f"the record of parameter {name!r} points {offset} bytes ahead, outside its section", file=path,
                place=f"after {last}", remedy=_REMEDY,
            )
        if group < 0:
            groups[-group] = name
        else:
            records.append((group, name, raw[pointer + 2 : following if offset else end]))
        last = f"parameter {name!r}"
        if not offset:
            break
        at = following
    parameters = {}
    for group, name, record in records:
        key = f"{groups.get(group, group)}:{name}"
        parameters[key] = _values(record, processor, key, path)
    return parameters


def _values(record: bytes, processor: str, key: str, path: Path) -> Values:
    kind, rank = (int(np.frombuffer(record[:1], np.int8)[0]), record[1]) if len(record) > 1 else (0, 0)
    shape = tuple(record[2 : 2 + rank])
    size = _SIZES.get(kind, 0) * int(np.prod(shape, dtype=object)) if rank else _SIZES.get(kind, 0)
    data = record[2 + rank : 2 + rank + size]
    if kind not in _SIZES or len(shape) < rank or len(data) < size:
        raise FileError("is longer than its record, or its type is unknown", file=path, place=key, remedy=_REMEDY)
    if kind != -1:
        try:
            return _numbers(data, kind, processor).reshape(shape, order="F")
        except ValueError as error:  # no numbers, in impossible dimensions
            raise FileError(f"impossible dimensions ({error})", file=path, place=key, remedy=_REMEDY) from error
    width = shape[0] if shape else 1
    cells = [data[i : i + width] for i in range(0, size, width)] if size else []
    return [_text(cell) for cell in cells]


def _text(cell: bytes) -> str:
    try:
        return cell.decode("utf-8").strip(" \0")
    except UnicodeDecodeError:
        return cell.decode("latin-1").strip(" \0")


def _number(parameters: dict[str, Values], key: str) -> float | None:
    values = parameters.get(key)
    return float(values.flat[0]) if isinstance(values, np.ndarray) and values.size else None


def _read_points(raw: bytes, processor: str, parameters: dict[str, Values], path: Path) -> C3d:
    word = "<u2" if processor != "mips" else ">u2"
    count, analog, first, last, _, _, _, start, samples = (int(v) for v in np.frombuffer(raw[2:20], word))
    scale, rate = (float(_numbers(raw[at : at + 4], 4, processor)[0]) for at in (12, 20))
    scale, rate = _number(parameters, "POINT:SCALE") or scale, _number(parameters, "POINT:RATE") or rate
    used = _number(parameters, "POINT:USED")
    if used is not None and int(used) % 65536 != count:
        raise FileError(f"{count} points, POINT:USED says {used:.0f}", file=path, place="header", remedy=_REMEDY)
    if not (np.isfinite(scale) and scale != 0 and np.isfinite(rate) and rate > 0):
        raise FileError(f"scale {scale:g}, rate {rate:g} Hz", file=path, place="header", remedy=_REMEDY)
    width = 4 if scale < 0 else 2
    step = (4 * count + analog) * width
    begin = (start - 1) * _BLOCK_BYTES
    room = (len(raw) - begin) // step if step and start > 1 else 0
    first, frames = _frames(parameters, first, last, room)
    if count == 0 or frames <= 0:
        raise FileError(f"{max(frames, 0)} frames of {count} points: no markers in this file", file=path)
    if frames > room:
        raise FileError(
            f"the file is truncated: {max(room, 0)} of {frames} frames can be read", file=path,
            remedy="Copy or export it again.",
        )
    data = np.frombuffer(raw, np.uint8, frames * step, begin).reshape(frames, step)
    with np.errstate(invalid="ignore"):  # signalling NaN
        values = _numbers(data[:, : 4 * count * width].tobytes(), width, processor)
        values = values.reshape(frames, count, 4).astype(float)
        sampled = _numbers(data[:, 4 * count * width :].tobytes(), width, processor).reshape(frames, analog)
    points = values[..., :3] * (scale if scale > 0 else 1.0)
    fourth = np.nan_to_num(values[..., 3], nan=-1.0, posinf=-1.0, neginf=-1.0)
    missing = (fourth < 0) | ~np.isfinite(points).all(axis=-1) | ~points.any(axis=-1)
    residual = np.where(missing, np.nan, np.mod(np.trunc(fourth), 256) * abs(scale))
    if width == 2 and "".join(map(str, parameters.get("ANALOG:FORMAT", []))).upper().startswith("UNSIGNED"):
        sampled = sampled.astype(sampled.dtype.newbyteorder("=")).view(np.uint16)
    events = _header_events(raw, processor)
    return C3d(points, missing, residual, rate, first, parameters, sampled, max(samples, 1), events)


def _header_events(raw: bytes, processor: str) -> tuple[tuple[str, float], ...]:
    """Labels (four characters) and times [s] of the header's events; none without the key."""
    key, count = np.frombuffer(raw[298:302], ">u2" if processor == "mips" else "<u2")
    if key != _EVENT_KEY or not 0 < count <= _MAX_EVENTS:
        return ()
    with np.errstate(invalid="ignore"):
        times = _numbers(raw[304 : 304 + 4 * _MAX_EVENTS], 4, processor)[:count].astype(float)
    labels = [_text(raw[396 + 4 * i : 400 + 4 * i]) for i in range(count)]
    return tuple((label, float(t)) for label, t in zip(labels, times, strict=True) if np.isfinite(t))


def _frames(parameters: dict[str, Values], first: int, last: int, room: int) -> tuple[int, int]:
    """First frame and number of frames: of the header, POINT:FRAMES or TRIAL, the largest that fits the file."""
    counts = [last - first + 1]
    stated = _number(parameters, "POINT:FRAMES")
    if stated is not None and np.isfinite(stated):
        counts.append(int(stated) % 65536 if abs(stated) < 65536 else int(stated))
    ends = [parameters.get(f"TRIAL:ACTUAL_{end}_FIELD") for end in ("START", "END")]
    if all(isinstance(e, np.ndarray) and e.shape == (2,) and e.dtype.itemsize == 2 for e in ends):
        start, stop = (int(e[0]) % 65536 + 65536 * (int(e[1]) % 65536) for e in ends)  # type: ignore[index]
        first = start
        counts.append(stop - start + 1)
    fitting = [n for n in counts if 0 < n <= room]
    return first, max(fitting) if fitting else max(counts)
