"""Write C3D files: joint centres, landmarks and angles of a motion; headers, parameter groups, points, channels.

Format: C3D User Guide, Motion Lab Systems, 2008. Little-endian, coordinates and samples as 32-bit floats.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.errors import ExportError
from kinefit.exporters.atomic import write_bytes
from kinefit.exporters.curves import Curve, curves
from kinefit.exporters.skeletons.common import UNITS, bone_names, convention, length_factor, plain_names, turned
from kinefit.motion import Motion

Value = Sequence[str] | NDArray
Groups = Mapping[str, Mapping[str, Value]]

MAX_FRAMES = 65535
"""What an unsigned word counts to: points, and frames in the header (beyond which the group TRIAL counts)."""

_BLOCK, _INTEL = 512, 84
_CHARS, _BYTES, _INTEGERS, _REALS = -1, 1, 2, 4  # kinds of parameters
_MAX_DIMENSION = 255  # entries along one dimension, and characters of one text


def c3d_bytes(
    points: NDArray, fourth: NDArray, groups: Groups, *, scale: float, rate: float, first: int,
    analog: NDArray | None = None, samples: int = 1,
) -> bytes:
    """A whole file.

    Parameters
    ----------
    points : (F, N, 3) in the file's unit; fourth : (F, N) residual and cameras as the format packs them, -1 unseen.
    groups : {"POINT": {"UNITS": ["mm"], ...}, ...}; POINT's USED, SCALE, RATE, FRAMES, DATA_START and TRIAL are added.
    scale : negative, as floats have it; its size is the unit of residuals.
    rate : float [Hz]; first : number of the first frame.
    analog : (F, C) raw samples of every frame, channel by channel for each of `samples` times.
    """
    frames, count = points.shape[:2]
    last = first + frames - 1
    channels = 0 if analog is None else analog.shape[1]
    point: dict[str, Value] = {
        "USED": np.array(count, np.uint16), "SCALE": np.array(scale, np.float32), "RATE": np.array(rate, np.float32),
        "FRAMES": np.array(min(frames, MAX_FRAMES), np.uint16), "DATA_START": np.array(0, np.uint16),
    }  # fmt: skip
    trial: dict[str, Value] = {
        f"ACTUAL_{end}_FIELD": np.array([number % 65536, number // 65536], np.uint16)
        for end, number in (("START", first), ("END", last))
    }
    whole: dict[str, dict[str, Value]] = {name: dict(values) for name, values in groups.items()}
    whole["POINT"] = point | whole.get("POINT", {})
    whole["TRIAL"] = trial | {k: v for k, v in whole.get("TRIAL", {}).items() if k not in trial}
    blocks = -(-len(_parameters(whole, 0)) // _BLOCK)
    if blocks > 255:
        raise ExportError(f"{blocks} blocks of parameters, 255 are what C3D can hold", remedy="Use fewer labels.")
    whole["POINT"]["DATA_START"] = np.array(2 + blocks, np.uint16)
    table = np.concatenate([points, fourth[..., None]], axis=2).astype("<f4").reshape(frames, -1)
    if analog is not None:
        table = np.concatenate([table, analog.astype("<f4")], axis=1)
    clipped = (min(first, MAX_FRAMES), min(last, MAX_FRAMES))
    head = struct.pack(
        "<BBHHHHHfHHf", 2, 0x50, count, channels, *clipped, 10, scale, 2 + blocks, samples if channels else 1, rate
    )
    data = table.tobytes()
    counted = frames <= MAX_FRAMES  # some readers count more frames than the header can by the file's length
    return head.ljust(_BLOCK, b"\0") + _padded(_parameters(whole, blocks)) + (_padded(data) if counted else data)


def label_groups(labels: Sequence[str], about: Sequence[str]) -> dict[str, Value]:
    """LABELS, LABELS2 ... and DESCRIPTIONS: no list holds more than 255."""
    out: dict[str, Value] = {}
    for k in range(0, len(labels), _MAX_DIMENSION):
        suffix = str(k // _MAX_DIMENSION + 1) if k else ""
        out[f"LABELS{suffix}"] = labels[k : k + _MAX_DIMENSION]
        out[f"DESCRIPTIONS{suffix}"] = about[k : k + _MAX_DIMENSION]
    return out


def screens(up: str) -> dict[str, Value]:
    """X_SCREEN and Y_SCREEN of a world whose vertical axis is `up`."""
    sign, vertical = ("-", up[1:]) if up.startswith("-") else ("+", up)
    across = "xyz"[("xyz".index(vertical) + 1) % 3]
    return {"X_SCREEN": [f"+{across.upper()}"], "Y_SCREEN": [f"{sign}{vertical.upper()}"]}


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % _BLOCK)


def _parameters(groups: Groups, blocks: int) -> bytes:
    """The parameter section, which takes so many blocks."""
    out = bytes([1, 0x50, blocks % 256, _INTEL])
    for number, (name, parameters) in enumerate(groups.items(), 1):
        out += _record(name, -number, b"\0")
        for label, value in parameters.items():
            out += _record(label, number, _coded(value) + b"\0")
    return out + bytes(2)


def _record(name: str, group: int, content: bytes) -> bytes:
    """One group or parameter: lengths, name, way to the next record, content."""
    short = name.encode("latin-1", errors="replace")[:127]
    return struct.pack("<bb", len(short), group) + short + struct.pack("<H", 2 + len(content)) + content


def _coded(value: Value) -> bytes:
    if not isinstance(value, np.ndarray):
        coded = [text.encode("utf-8")[:_MAX_DIMENSION] for text in value]
        width = max(map(len, coded), default=0)
        cells = b"".join(text.ljust(width) for text in coded)
        return struct.pack("<b", _CHARS) + bytes([2, width, len(coded)]) + cells
    kind = _REALS if value.dtype.kind == "f" else _BYTES if value.dtype.itemsize == 1 else _INTEGERS
    array = value.astype({_REALS: "<f4", _BYTES: "i1", _INTEGERS: "<i2"}[kind])
    return struct.pack("<b", kind) + bytes([value.ndim, *value.shape]) + array.tobytes(order="F")


@checked
def write_c3d(
    motion: Motion, path: str | PathLike[str], *, unit: str = "mm", up: str | None = None, names: str = "kinefit"
) -> None:
    """Write joint centres, then landmarks, then angles, as C3D.

    A landmark that bears a joint's name gets a number ("neck_2").
    Centres and landmarks are there in all frames, with residual 0: computed, not measured. Angles are points that
    POINT:ANGLES lists, as laboratories' programs expect them: the coordinates of a joint in degrees as x, y and z, as
    `LHipAngles`; missing in frames in which none of them is observed. The first frame's number follows from its time,
    frame 1 being at 0 s.

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
    bones = list(body.joints) if convention(names) == "kinefit" else bone_names(body, names, path)
    angles = _angles(motion)
    labels = plain_names([*bones, *body.landmarks.names, *angles])
    about = [f"joint centre {joint}" for joint in body.joints] + ["landmark"] * len(body.landmarks)
    about += [f"{', '.join(c.name for c in found)} [deg]" for found in angles.values()]
    first = round(float(motion.times[0]) * motion.rate) + 1 if len(motion) else 0
    if not (len(motion) and len(labels) <= MAX_FRAMES and first > 0):
        raise ExportError(
            f"C3D cannot hold {len(motion)} frames of {len(labels)} points from frame {first} on", file=path,
            remedy="Cut the motion to frames of time 0 and later, and at least one.",
        )
    world = turned(motion, up, path)
    places = factor * np.concatenate([world.segment_poses()[..., :3, 3], world.positions()], axis=1)
    turned_by = np.zeros((len(motion), len(angles), 3))
    fourth = np.zeros((len(motion), len(labels)))
    for k, found in enumerate(angles.values()):
        turned_by[:, k, : len(found)] = np.stack([c.values for c in found], axis=1)
        fourth[~np.isfinite([c.std for c in found]).any(axis=0), places.shape[1] + k] = -1.0
    turned_by[fourth[:, places.shape[1] :] < 0] = 0.0
    points = np.concatenate([places, turned_by], axis=1)
    groups: Groups = {
        "POINT": {
            "UNITS": [unit], "ANGLE_UNITS": ["deg"], "ANGLES": labels[places.shape[1] :], **screens(up),
            **label_groups(labels, about),
        },
        "ANALOG": {"USED": np.array(0, np.uint16), "RATE": np.array(motion.rate, np.float32), "LABELS": []},
    }  # fmt: skip
    write_bytes(path, c3d_bytes(points, fourth, groups, scale=-1.0, rate=motion.rate, first=first))


def _angles(motion: Motion) -> dict[str, list[Curve]]:
    """{label: up to three coordinates} of every joint that turns, the root's first."""
    out: dict[str, list[Curve]] = {}
    for curve in curves(motion):
        if curve.unit == "deg":
            side = {"left": "L", "right": "R"}.get(curve.side, "")
            label, number = f"{side}{curve.joint.capitalize()}Angles", 1
            while len(out.get(label, ())) == 3:
                number += 1
                label = f"{side}{curve.joint.capitalize()}Angles{number}"
            out.setdefault(label, []).append(curve)
    return out
