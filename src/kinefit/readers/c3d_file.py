"""Parser of C3D files: header, parameters and 3D points, every offset checked against the file's size.

ezc3d is no alternative: it crashes on some damaged files, reads truncated ones without an error, and rejects big-endian
ones and unexpected types. Source: C3D User Guide, Motion Lab Systems, 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._files import read_bytes
from kinefit.errors import FileError, names_file

_BLOCK_BYTES = 512
_MAX_WORD = 65535  # what the header's counters hold
_MAX_RATIO_ERROR = 1e-3  # between header and parameters: above the rounding of a 32-bit float, below 59.94 to 60 Hz
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
    notes : which value counts where the file contradicts itself
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
    notes: tuple[str, ...] = ()


@names_file
def read_c3d(path: Path) -> C3d:
    """Read the points and all parameters; raises FileError for a damaged, truncated or contradictory file."""
    raw = read_bytes(path)
    if len(raw) < 2 * _BLOCK_BYTES or raw[1] != 0x50 or raw[0] == 0:
        raise FileError(f"not a C3D file ({len(raw)} bytes)", remedy="Name a C3D file of your system.")
    section = (raw[0] - 1) * _BLOCK_BYTES
    processor = _PROCESSORS.get(raw[section + 3]) if section + 4 <= len(raw) else None
    if processor is None:
        raise FileError("it points to no parameter section", place="header", remedy=_REMEDY)
    parameters = _read_parameters(raw, section, processor)
    return _read_points(raw, processor, parameters)


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


def _read_parameters(raw: bytes, section: int, processor: str) -> dict[str, Values]:
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
            raise FileError("a parameter extends beyond its section", place=f"after {last}", remedy=_REMEDY)
        name = raw[at + 2 : pointer].decode("latin-1").strip().upper()
        offset = int.from_bytes(raw[pointer : pointer + 2], "big" if processor == "mips" else "little")
        following = pointer + offset
        if not name.isprintable() or (offset and (offset < 3 or following > end)):
            problem = f"the record of parameter {name!r} points {offset} bytes ahead, outside its section"
            raise FileError(problem, place=f"after {last}", remedy=_REMEDY)
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
        parameters[key] = _values(record, processor, key)
    return parameters


def _values(record: bytes, processor: str, key: str) -> Values:
    kind, rank = (int(np.frombuffer(record[:1], np.int8)[0]), record[1]) if len(record) > 1 else (0, 0)
    shape = tuple(record[2 : 2 + rank])
    size = _SIZES.get(kind, 0) * int(np.prod(shape, dtype=object)) if rank else _SIZES.get(kind, 0)
    data = record[2 + rank : 2 + rank + size]
    if kind not in _SIZES or len(shape) < rank or len(data) < size:
        raise FileError("is longer than its record, or its type is unknown", place=key, remedy=_REMEDY)
    if kind != -1:
        try:
            return _numbers(data, kind, processor).reshape(shape, order="F")
        except ValueError as error:  # no numbers, in impossible dimensions
            raise FileError(f"impossible dimensions ({error})", place=key, remedy=_REMEDY) from error
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


def _stated(parameters: dict[str, Values], key: str) -> float:
    """A number that is stated; else 0."""
    value = _number(parameters, key) or 0.0
    return value if np.isfinite(value) else 0.0


def _read_points(raw: bytes, processor: str, parameters: dict[str, Values]) -> C3d:
    word = "<u2" if processor != "mips" else ">u2"
    count, analog, first, last, _, _, _, start, samples = (int(v) for v in np.frombuffer(raw[2:20], word))
    header_scale, rate = (float(_numbers(raw[at : at + 4], 4, processor)[0]) for at in (12, 20))
    notes: list[str] = []
    scale = _number(parameters, "POINT:SCALE") or header_scale
    if header_scale * scale < 0 or (_differ(header_scale, scale) and scale > 0):
        raise FileError(
            f"the header's scale is {header_scale:g}, POINT:SCALE is {scale:g} (negative: the data are floats, "
            "positive: integers to be multiplied by it)", place="header, POINT:SCALE", remedy=_REMEDY,
        )  # fmt: skip
    if _differ(header_scale, scale):
        notes.append(f"the header's scale of residuals is {-header_scale:g}, POINT:SCALE's {-scale:g} counts")
    rate = _rate(rate, samples if analog else 0, parameters, notes)
    points_used = _number(parameters, "POINT:USED")
    if points_used is not None and int(points_used) % 65536 != count:
        raise FileError(f"{count} points, POINT:USED says {points_used:.0f}", place="header", remedy=_REMEDY)
    if not (np.isfinite(scale) and scale != 0 and np.isfinite(rate) and rate > 0):
        raise FileError(f"scale {scale:g}, rate {rate:g} Hz", place="header", remedy=_REMEDY)
    width = 4 if scale < 0 else 2

    def spare(start: int, analog: int) -> int:
        """Bytes behind the last frame."""
        space, step = len(raw) - (start - 1) * _BLOCK_BYTES, (4 * count + analog) * width
        return space - step * _count(parameters, first, last, space // step)

    used, ratio = int(_stated(parameters, "ANALOG:USED")), round(_stated(parameters, "ANALOG:RATE") / rate)
    starts = dict.fromkeys((start, int(_stated(parameters, "POINT:DATA_START")) % 65536 or start))
    analogs = dict.fromkeys((analog, *(used % 65536 * n for n in (samples, ratio) if used and n > 0)))
    layouts = [(s, a) for s in starts for a in analogs]  # the header's, then what the parameters state otherwise
    exact = [layout for layout in layouts if count and layout[0] > 1 and 0 <= spare(*layout) < _BLOCK_BYTES]
    if len(layouts) > 1 and len(exact) != 1:
        listed = " or ".join(f"{a} analog values a frame from block {s} on" for s, a in layouts)
        raise FileError(
            f"header, ANALOG and POINT:DATA_START contradict each other: {listed}; the file's length fits "
            f"{len(exact) or 'none'} of them", place="header", remedy=_REMEDY,
        )  # fmt: skip
    if exact and exact[0] != layouts[0]:
        start, analog = exact[0]
        samples = analog // (used or analog or 1)
        notes.append(
            f"the header states {layouts[0][1]} analog values a frame from block {layouts[0][0]} on; {analog} from "
            f"block {start} on count, as the parameters state, which fit the file's length"
        )
    step = (4 * count + analog) * width
    begin = (start - 1) * _BLOCK_BYTES
    room = (len(raw) - begin) // step if step and start > 1 else 0
    frames = _count(parameters, first, last, room)
    if count == 0 or frames <= 0:
        raise FileError(f"{max(frames, 0)} frames of {count} points: no markers in this file")
    if frames > room:
        problem = f"the file is truncated: {max(room, 0)} of {frames} frames can be read"
        raise FileError(problem, remedy="Copy or export it again.")
    if (room - frames) * step >= _BLOCK_BYTES:
        notes.append(f"{room - frames} more frames have room in the file, which states {frames}")
    data = np.frombuffer(raw, np.uint8, frames * step, begin).reshape(frames, step)
    if _count(parameters, first, last, 0) < frames:  # counted by the file's length: its last block is filled up
        empty = int(np.argmax(data[: -_BLOCK_BYTES // step - 1 : -1].any(axis=1)))
        data, frames = data[: frames - empty], frames - empty
    trial = _trial(parameters)
    if trial and first not in (trial[0] % 65536, _MAX_WORD):
        notes.append(f"the header begins with frame {first}, TRIAL:ACTUAL_START_FIELD is {trial[0]}")
    if trial and not last - first + 1 == frames != trial[1] - trial[0] + 1:
        first = trial[0]  # else the header alone has the right number of frames
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
    return C3d(points, missing, residual, rate, first, parameters, sampled, max(samples, 1), events, tuple(notes))


def _header_events(raw: bytes, processor: str) -> tuple[tuple[str, float], ...]:
    """Labels (four characters) and times [s] of the header's events; none without the key."""
    key, count = np.frombuffer(raw[298:302], ">u2" if processor == "mips" else "<u2")
    if key != _EVENT_KEY or not 0 < count <= _MAX_EVENTS:
        return ()
    with np.errstate(invalid="ignore"):
        times = _numbers(raw[304 : 304 + 4 * _MAX_EVENTS], 4, processor)[:count].astype(float)
    labels = [_text(raw[396 + 4 * i : 400 + 4 * i]) for i in range(count)]
    return tuple((label, float(t)) for label, t in zip(labels, times, strict=True) if np.isfinite(t))


def _differ(a: float, b: float) -> bool:
    """Whether two values of one quantity contradict each other; one that is not stated (0, NaN) never does."""
    return bool(a and b and abs(abs(a / b) - 1.0) > _MAX_RATIO_ERROR)


def _rate(header: float, samples: int, parameters: dict[str, Values], notes: list[str]) -> float:
    """Rate [Hz] of the points: POINT:RATE, or the header's if the analog rate supports that alone."""
    rate = _number(parameters, "POINT:RATE") or header
    if not _differ(header, rate):
        return rate
    analog = _stated(parameters, "ANALOG:RATE") / samples if samples else 0.0
    supported = [r for r in (header, rate) if analog and not _differ(r, analog)]
    what = f"the header's rate is {header:g} Hz, POINT:RATE is {rate:g} Hz"
    if len(supported) != 1:
        raise FileError(what, place="header, POINT:RATE", remedy=f"Correct the wrong one. {_REMEDY}")
    notes.append(f"{what}: {supported[0]:g} Hz counts, which {samples} analog samples a frame support")
    return supported[0]


def _count(parameters: dict[str, Values], first: int, last: int, room: int) -> int:
    """Number of frames: of the header, POINT:FRAMES, POINT:LONG_FRAMES or TRIAL, the largest that fits the file."""
    counts = [last - first + 1]
    for key in ("POINT:FRAMES", "POINT:LONG_FRAMES"):
        stated = int(_stated(parameters, key))
        counts.append(stated % 65536 if abs(stated) < 65536 else stated)
    if trial := _trial(parameters):
        counts.append(trial[1] - trial[0] + 1)
    if last == _MAX_WORD and max(counts) > _MAX_WORD:
        return max(counts)  # the header's words are full
    if last == _MAX_WORD and not trial and "POINT:LONG_FRAMES" not in parameters:
        counts.append(max(room, *counts))
    fitting = [n for n in counts if 0 < n <= room]
    return max(fitting) if fitting else max(counts)


def _trial(parameters: dict[str, Values]) -> tuple[int, int] | None:
    """First and last frame by the group TRIAL, which counts beyond a word."""
    ends = [parameters.get(f"TRIAL:ACTUAL_{end}_FIELD") for end in ("START", "END")]
    if not all(isinstance(e, np.ndarray) and e.shape == (2,) and e.dtype.itemsize == 2 for e in ends):
        return None
    start, stop = (int(e[0]) % 65536 + 65536 * (int(e[1]) % 65536) for e in ends)  # type: ignore[index]
    return start, stop
