"""Marker files for writing: C3D of motions and of markers, TRC of markers.

Format: C3D User Guide, Motion Lab Systems, 2008. Little-endian, coordinates and samples as 32-bit floats.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import LENGTHS, write_bytes, write_text
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError
from kinefit.exporters.opensim import trc_head
from kinefit.exporters.report.cycles import events_of
from kinefit.exporters.skeletons.common import UNITS, bone_names, convention, length_factor, plain_names, turned
from kinefit.exporters.tables import Curve, curves
from kinefit.observations import MarkerEvent, Markers
from kinefit.readers.c3d_file import C3d, read_c3d

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


def label_groups(labels: Sequence[str], about: Sequence[str], **others: Value) -> dict[str, Value]:
    """Lists of one length: LABELS, DESCRIPTIONS and others. None holds more than 255: LABELS2, LABELS3 ... go on."""
    lists, out = {"LABELS": labels, "DESCRIPTIONS": about, **others}, dict[str, Value]()
    for k in range(0, len(labels), _MAX_DIMENSION):
        suffix = str(k // _MAX_DIMENSION + 1) if k else ""
        out |= {name + suffix: values[k : k + _MAX_DIMENSION] for name, values in lists.items()}
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
    frame 1 being at 0 s. Contacts and toe-offs of a walk are EVENTs, "Foot Strike" and "Foot Off", in place of those of
    the recording, whose other events are kept. Force plates are analog channels and FORCE_PLATFORM, of type 2.

    Parameters
    ----------
    motion : Motion
    path : path
    unit : "mm", "cm" or "m"
    up : str, optional
        Vertical axis of the file's world, which POINT:Y_SCREEN tells. Default: the motion's own.
    names : "kinefit", "mixamo", "cmu", "opensim", "hanim", "bvh", "vrm", "unity" or "unreal"
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
    groups: dict[str, dict[str, Value]] = {
        "POINT": {
            "UNITS": [unit], "ANGLE_UNITS": ["deg"], "ANGLES": labels[places.shape[1] :], **screens(up),
            **label_groups(labels, about),
        },
        "ANALOG": {"USED": np.array(0, np.uint16), "RATE": np.array(motion.rate, np.float32), "LABELS": []},
    }  # fmt: skip
    if events := events_of(motion):
        groups["EVENT"] = _events(events)
    analog, samples = None, 1
    if world.plates:
        groups["ANALOG"], groups["FORCE_PLATFORM"], analog, samples = _plates(world, unit, factor)
    whole = c3d_bytes(
        points, fourth, groups, scale=-1.0, rate=motion.rate, first=first, analog=analog, samples=samples
    )
    write_bytes(path, whole)


def _plates(motion: Motion, unit: str, factor: float) -> tuple[dict[str, Value], dict[str, Value], NDArray, int]:
    """Groups ANALOG and FORCE_PLATFORM of plates as type 2, samples (F, C) of every frame, and how many a frame."""
    samples = max(round(max(plate.rate for plate in motion.plates) / motion.rate), 1)
    times = motion.times[0] + np.arange(len(motion) * samples) / (motion.rate * samples)
    columns, labels, corners = list[NDArray](), list[str](), list[NDArray]()
    for k, plate in enumerate((plate.at(times) for plate in motion.plates), 1):
        axes = np.vstack([plate.axes, np.cross(*plate.axes)])
        on_plate = np.concatenate([-plate.force @ axes.T, -factor * plate.moment @ axes.T], axis=1)
        columns += list(on_plate.T)
        labels += [f"{kind}{axis}{k}" for kind in ("Force.F", "Moment.M") for axis in "xyz"]
        corners.append(factor * plate.corners.T)
    count, channels = len(motion.plates), len(labels)
    analog: dict[str, Value] = {
        "USED": np.array(channels, np.uint16), "RATE": np.array(motion.rate * samples, np.float32),
        "SCALE": np.ones(channels, np.float32), "OFFSET": np.zeros(channels, np.int16),
        "GEN_SCALE": np.array(1.0, np.float32), "UNITS": (["N"] * 3 + [f"N{unit}"] * 3) * count,
        **label_groups(labels, ["force plate"] * channels),
    }  # fmt: skip
    platform: dict[str, Value] = {
        "USED": np.array(count, np.uint16), "TYPE": np.full(count, 2, np.uint16), "ZERO": np.zeros(2, np.uint16),
        "CORNERS": np.stack(corners, axis=-1).astype(np.float32), "ORIGIN": np.zeros((3, count), np.float32),
        "CHANNEL": np.arange(1, channels + 1, dtype=np.uint16).reshape(6, count, order="F"),
    }  # fmt: skip
    table = np.column_stack(columns).reshape(len(motion), samples * channels)
    return analog, platform, table, samples


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


MARKER_UNITS = {unit: 1.0 / LENGTHS[unit] for unit in ("m", "dm", "cm", "mm", "in", "ft")}
"""Units of length in a metre."""

_MOST_RESIDUAL = 255  # what a byte counts to
_OURS = ("POINT", "TRIAL", "EVENT")  # groups that are written anew


@checked
def write_markers(
    markers: Markers, path: str | PathLike[str], *, unit: str | None = None, like: str | PathLike[str] | None = None
) -> None:
    """Write markers as C3D or TRC, by the name's ending.

    Reading the file gives the same labels, gaps, unit, rate, clock and events, positions as 32-bit floats (TRC: to
    seven digits), and residuals to 1/255 of the largest (C3D; TRC holds none). C3D counts the clock in whole frames, so
    its first frame is the one at `first_time`, where frame 1 is at 0 s; TRC has that time and `first_frame`.

    Parameters
    ----------
    markers : Markers
    path : .c3d or .trc
    unit : "mm", "cm", "m" ...; default: that of the file which the markers came from.
    like : C3D file, optional
        Its analog channels (force plates, EMG) and all its groups of parameters are kept, in frames that are the same.

    Raises
    ------
    ExportError
        Another ending, no frame, more than the format can hold (C3D: a time before 0), or the file cannot be written.
    FileError
        `like` is damaged.
    """
    path = Path(path)
    unit = unit or (markers.unit if markers.unit in MARKER_UNITS else "mm")
    factor = length_factor(unit, MARKER_UNITS, path)
    if not len(markers) or not markers.names or len(markers.names) > MAX_FRAMES:
        problem = f"{len(markers)} frames of {len(markers.names)} markers cannot be written"
        raise ExportError(problem, file=path, remedy="Write at least one frame of at least one marker.")
    if path.suffix.lower() == ".c3d":
        write_bytes(path, _c3d(markers, path, unit, factor, read_c3d(Path(like)) if like else None))
    elif path.suffix.lower() == ".trc":
        write_text(path, _trc(markers, path, unit, factor))
    else:
        raise ExportError("neither .c3d nor .trc", file=path, remedy="Give the file one of these endings.")


def _c3d(markers: Markers, path: Path, unit: str, factor: float, like: C3d | None) -> bytes:
    first = round(markers.first_time * markers.rate) + 1
    if first < 1:
        problem = f"C3D counts no frames before 0 s, the markers begin at {markers.first_time:g} s"
        raise ExportError(problem, file=path, remedy="Write a .trc, or cut the markers to times from 0 on.")
    seen = np.isfinite(markers.positions).all(axis=2)
    residual = np.zeros(seen.shape) if markers.residual is None else np.nan_to_num(markers.residual) * factor
    scale = _residual_unit(residual[seen])
    fourth = np.where(seen, np.clip(np.round(residual / scale), 0, _MOST_RESIDUAL), -1.0)
    groups: dict[str, dict[str, Value]] = {
        "POINT": {
            "UNITS": [unit], **(screens(markers.up) if markers.up else {}),
            **label_groups(markers.names, ["marker"] * len(markers.names)),
        },
        "ANALOG": {"USED": np.array(0, np.uint16), "RATE": np.array(markers.rate, np.float32), "LABELS": []},
    }  # fmt: skip
    if markers.events:
        groups["EVENT"] = _events(markers.events)
    analog, samples = None, 1
    if like is not None:
        analog, samples = _rows(like, markers, path), like.samples
        for key, value in like.parameters.items():
            group, _, name = key.partition(":")
            if group not in _OURS:
                whole = key == "ANALOG:OFFSET" and isinstance(value, np.ndarray) and np.all(value == np.round(value))
                groups.setdefault(group, {})[name] = value.astype(np.int16) if whole else value  # type: ignore[union-attr]
    points = np.where(seen[..., None], markers.positions * factor, 0.0)
    return c3d_bytes(
        points, fourth, groups, scale=-scale, rate=markers.rate, first=first, analog=analog, samples=samples
    )


def _rows(like: C3d, markers: Markers, path: Path) -> NDArray | None:
    """Analog samples of the markers' frames."""
    start = markers.first_frame - like.first_frame
    if not 0 <= start <= len(like.points) - len(markers):
        raise ExportError(
            f"frames {markers.first_frame} to {markers.first_frame + len(markers) - 1} are not all in the file "
            f"given as `like` ({like.first_frame} to {like.first_frame + len(like.points) - 1})", file=path,
            remedy="Name the file that the markers came from.",
        )  # fmt: skip
    return like.analog[start : start + len(markers)].astype(np.float32) if like.analog.shape[1] else None


def _residual_unit(residual: NDArray) -> float:
    """Unit in which residuals are counted from 0 to 255: the one that they come in where they do, else the finest."""
    steps = np.unique(residual)
    gaps = np.diff(steps, prepend=0.0)
    if not np.any(gaps > 1e-9):
        return 1.0
    smallest = float(gaps[gaps > 1e-9].min())
    counted = steps / smallest
    own = counted[-1] <= _MOST_RESIDUAL + 0.5 and bool(np.all(np.abs(counted - np.round(counted)) < 1e-3))
    return smallest if own else float(steps[-1]) / _MOST_RESIDUAL


def _events(events: Sequence[MarkerEvent]) -> dict[str, Value]:
    """The group EVENT."""
    lists = label_groups(
        [e.label for e in events], [e.description for e in events], CONTEXTS=[e.context for e in events],
        SUBJECTS=[e.subject for e in events],
        TIMES=np.array([[e.time // 60.0, e.time % 60.0] for e in events], np.float32),
        ICON_IDS=np.array([e.icon for e in events], np.uint16),
        GENERIC_FLAGS=np.array([e.flag for e in events], np.uint8),
    )  # fmt: skip
    lists = {name: values.T if isinstance(values, np.ndarray) else values for name, values in lists.items()}
    return {"USED": np.array(len(events), np.uint16), **lists}


def _trc(markers: Markers, path: Path, unit: str, factor: float) -> str:
    names = [n.replace("\t", " ").replace("\n", " ") for n in markers.names]
    first = markers.first_frame
    lines = trc_head(path, names, f"{markers.rate:.10g}", len(markers), unit, first)
    lines[3] += "\t\t"  # as Vicon's programs write it
    seen = np.isfinite(markers.positions).all(axis=2)
    for f, (t, x) in enumerate(zip(markers.times.tolist(), (markers.positions * factor).tolist(), strict=True)):
        cells = [f"{p[0]:.7g}\t{p[1]:.7g}\t{p[2]:.7g}" if ok else "\t\t" for p, ok in zip(x, seen[f], strict=True)]
        end = "" if seen[f, -1] else "NaN"  # OpenSim refuses a row that ends in an empty cell
        lines.append(f"{first + f}\t{t:.9f}\t" + "\t".join(cells) + end)
    return "\n".join(lines) + "\n"
