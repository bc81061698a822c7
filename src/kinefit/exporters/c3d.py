"""C3D: joint centres and landmarks over time, for programs of motion laboratories.

Format: C3D User Guide, Motion Lab Systems, 2008. Little-endian, coordinates as 32-bit floats.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ExportError
from kinefit.exporters._atomic import write_bytes
from kinefit.exporters._skeleton import UNITS, bone_names, length_factor, plain_names, turned
from kinefit.motion import Motion

_BLOCK = 512
_INTEL, _FLOATS = 84, -1.0  # processor; a negative scale says that coordinates are floats
_CHARS, _INTEGERS, _REALS = -1, 2, 4  # kinds of parameters
_LONGEST = 255  # entries of one parameter, and characters of one text
_MOST_FRAMES = 65535  # beyond which the header cannot count; the group TRIAL can


def write_c3d(
    motion: Motion, path: str | PathLike[str], *, unit: str = "mm", up: str | None = None, names: str = "kinefit"
) -> None:
    """Write joint centres, then landmarks, as C3D; a landmark that bears a joint's name gets a number ("neck_2").

    All points are there in all frames, with residual 0: computed, not measured. The first frame's number follows from
    its time, frame 1 being at 0 s.

    Parameters
    ----------
    motion : Motion
    path : path
    unit : "mm", "cm" or "m"
    up : str, optional
        Vertical axis of the file's world, which POINT:Y_SCREEN tells. Default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim" or "bvh"
        Labels of the joint centres: names of their segments; with "kinefit" of the joints.

    Raises
    ------
    ExportError
        No frame, too many points, unknown unit, axis or names, or the file cannot be written.
    """
    body, factor, up = motion.body, length_factor(unit, UNITS, path), up or motion.up
    bones = list(body.joints) if names == "kinefit" else bone_names(body, names, path)
    labels = plain_names([*bones, *body.landmarks.names])
    about = [f"joint centre {joint}" for joint in body.joints] + ["landmark"] * len(body.landmarks)
    first = round(float(motion.times[0]) * motion.rate) + 1 if len(motion) else 0
    if not (len(motion) and len(labels) <= _MOST_FRAMES and first > 0):
        raise ExportError(
            f"C3D cannot hold {len(motion)} frames of {len(labels)} points from frame {first} on", file=path,
            remedy="Cut the motion to frames of time 0 and later, and at least one.",
        )
    world = turned(motion, up, path)
    points = factor * np.concatenate([world.segment_poses()[..., :3, 3], world.positions()], axis=1)
    told = (labels, about, unit, up, motion.rate, first, len(motion))
    blocks = -(-len(_parameters(*told, blocks=0)) // _BLOCK)
    parameters = _parameters(*told, blocks=blocks)
    data = np.pad(points, ((0, 0), (0, 0), (0, 1))).astype("<f4").tobytes()  # the fourth: residual and cameras
    head = _header(len(labels), motion.rate, first, len(motion), 2 + blocks)
    counted = len(motion) <= _MOST_FRAMES  # some readers count more frames than the header can by the file's length
    write_bytes(path, head + _padded(parameters) + (_padded(data) if counted else data))


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % _BLOCK)


def _header(points: int, rate: float, first: int, frames: int, start: int) -> bytes:
    clipped = (min(first, _MOST_FRAMES), min(first + frames - 1, _MOST_FRAMES))
    words = struct.pack("<BBHHHHHfHHf", 2, 0x50, points, 0, *clipped, 10, _FLOATS, start, 1, rate)
    return words + bytes(_BLOCK - len(words))


def _parameters(
    labels: Sequence[str], about: Sequence[str], unit: str, up: str, rate: float, first: int, frames: int,
    *, blocks: int,
) -> bytes:
    """The parameter section, which takes so many blocks."""
    sign, vertical = ("-", up[1:]) if up.startswith("-") else ("+", up)
    across = "xyz"[("xyz".index(vertical) + 1) % 3]
    last = first + frames - 1
    point = [
        _numbers("USED", _INTEGERS, [len(labels)]), _numbers("SCALE", _REALS, [_FLOATS]),
        _numbers("RATE", _REALS, [rate]), _numbers("FRAMES", _INTEGERS, [min(frames, _MOST_FRAMES)]),
        _numbers("DATA_START", _INTEGERS, [2 + blocks]),
        _texts("UNITS", [unit]), _texts("X_SCREEN", [f"+{across.upper()}"]),
        _texts("Y_SCREEN", [f"{sign}{vertical.upper()}"]),
    ]  # fmt: skip
    for k in range(0, len(labels), _LONGEST):
        suffix = str(k // _LONGEST + 1) if k else ""
        point += [_texts(f"LABELS{suffix}", labels[k : k + _LONGEST])]
        point += [_texts(f"DESCRIPTIONS{suffix}", about[k : k + _LONGEST])]
    trial = [
        _numbers(f"ACTUAL_{end}_FIELD", _INTEGERS, [number % 65536, number // 65536])
        for end, number in (("START", first), ("END", last))
    ]
    analog = [_numbers("USED", _INTEGERS, [0]), _numbers("RATE", _REALS, [rate]), _texts("LABELS", [])]
    groups = {"POINT": point, "ANALOG": analog, "TRIAL": trial}
    out = bytes([1, 0x50, blocks, _INTEL])
    for number, (name, parameters) in enumerate(groups.items(), 1):
        out += _record(name, -number, b"\0")
        for label, value in parameters:
            out += _record(label, number, value)
    return out + bytes(2)


def _record(name: str, group: int, value: bytes) -> bytes:
    """One group or parameter: lengths, name, way to the next record, value, no description."""
    content = value if group < 0 else value + b"\0"
    return struct.pack("<bb", len(name), group) + name.encode("ascii") + struct.pack("<H", 2 + len(content)) + content


def _numbers(name: str, kind: int, values: Sequence[float]) -> tuple[str, bytes]:
    array: NDArray = np.array(values, "<f4" if kind == _REALS else "<u2")
    shape = bytes([0]) if len(values) == 1 else bytes([1, len(values)])
    return name, struct.pack("<b", kind) + shape + array.tobytes()


def _texts(name: str, values: Sequence[str]) -> tuple[str, bytes]:
    coded = [value.encode("utf-8")[:_LONGEST] for value in values]
    width = max(map(len, coded), default=0)
    cells = b"".join(value.ljust(width) for value in coded)
    return name, struct.pack("<b", _CHARS) + bytes([2, width, len(coded)]) + cells
