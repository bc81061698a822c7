"""BVH (Biovision hierarchy): a skeleton and its motion."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.errors import FileError, names_file
from kinefit.observations import SkeletonMotion
from kinefit.readers.skeletons import common

UNITS = (0.001, 0.01, 0.0254, 0.0254 / 0.45, 1.0)
"""Metres per unit that "auto" chooses from: mm, cm, inch, the unit of CMU's ASF files, m."""

_TYPICAL_STATURE = 1.7  # [m]
_MIN_STATURE = 1.0  # [m] a child of six
_MAX_STATURE = 2.2  # [m]
_UNIT_REMEDY = "Give the unit: `kinefit retarget --unit cm`; in Python unit=0.01."
_HEAD_TO_ANKLE_SHARE = 0.85  # of the stature: length of the chain of bones from the head's joint to the ankle


@dataclass(frozen=True)
class _BvhJoint:
    name: str
    parent: int
    offset: tuple[float, ...]
    channels: tuple[str, ...]  # such as "xposition", in the file's order


@checked
@names_file
def read_bvh(path: str | PathLike[str], *, unit: float | str = "auto", up: str = "auto") -> SkeletonMotion:
    """Read a BVH file.

    Rotation channels multiply from left to right in the order of the file. Position channels replace the joint's
    OFFSET in some programs' files and are added to it in others'; the reader takes them as replaced where their
    lengths are nearer to the OFFSET's than to zero (for the root: their height). The rest pose has all angles zero;
    a person may be unable to take it. Where joints have position channels, its bones are the medians of those, as
    some programs write OFFSETs of zero.

    Parameters
    ----------
    path : path
    unit : float [m], a unit such as "cm", or "auto"
        Unit of length of the file, which BVH does not state. "auto" chooses the one of `UNITS` with
        the most plausible stature (within 1.0 to 2.2 m, nearest to 1.7 m). The motion's `source` states it.
    up : an axis such as "y" or "-z", or "auto"
        Vertical axis of the file's world. "auto" takes the axis along which, on average, the head is above the
        feet; the common "y" if no joint is named as head and feet.

    Returns
    -------
    SkeletonMotion
        In the file's world. A frame time that is the rounded reciprocal of a whole rate (or one / 1.001) gives
        that rate exactly.

    Raises
    ------
    FileError
        Missing, truncated, not BVH, numbers that are not finite, or no unit with a plausible stature.
    """
    text = common.text_of(path, "BVH")
    hierarchy, *motion = re.split(r"^[ \t]*MOTION\b", text, maxsplit=1, flags=re.M | re.I)
    joints = _read_hierarchy(hierarchy)
    if not motion:
        raise FileError("holds no MOTION section", remedy="Export the skeleton with its motion.")
    channels = sum(len(joint.channels) for joint in joints)
    rate, values = _read_motion(motion[0], channels, hierarchy.count("\n") + 1)

    names = tuple(joint.name for joint in joints)
    parents = [joint.parent for joint in joints]
    Ts_parent_joint = _local_poses(joints, values)
    offsets = np.median(Ts_parent_joint[..., :3, 3], axis=0)
    offsets[0] = joints[0].offset
    scale = _human_unit(names, parents, offsets) if unit == "auto" else common.given_unit(unit)
    Ts_world_joint = common.joint_poses(parents, Ts_parent_joint)
    up = common.vertical_axis(up, names, Ts_world_joint[..., :3, 3])
    Ts_world_joint[..., :3, 3] += _root_shift(joints[0], values, up)
    Ts_world_joint[..., :3, 3] *= scale
    return SkeletonMotion(
        names=names,
        parents=np.array(parents),
        offsets=offsets * scale,
        rate=rate,
        Ts_world_joint=Ts_world_joint,
        up=up,
        source=f"{fspath(path)} (unit {scale:.6g} m)",
    )


def _read_hierarchy(text: str) -> list[_BvhJoint]:
    """Joints and end sites in the order of the file, parents first."""
    tokens = [(word, n) for n, line in enumerate(text.split("\n"), 1) for word in re.findall(r"[{}]|[^\s{}]+", line)]
    if not tokens or tokens[0][0].upper() != "HIERARCHY":
        raise FileError("does not begin with HIERARCHY", place="line 1", remedy="Give a BVH file.")
    joints: list[_BvhJoint] = []
    open_joints: list[dict] = []  # stack of open braces: name, parent, index
    at = 1

    def fault(problem: str, line: int) -> FileError:
        return FileError(problem, place=f"line {line}", remedy="Export the file again.")

    def take(count: int) -> list[str]:
        nonlocal at
        if at + count > len(tokens):
            raise fault("the hierarchy ends in the middle", tokens[-1][1])
        at += count
        return [word for word, _ in tokens[at - count : at]]

    while at < len(tokens):
        line = tokens[at][1]
        (word,) = take(1)
        match word.upper():
            case "ROOT" | "JOINT" | "END" as kind:
                words = []
                while (next_word := take(1)[0]) != "{":
                    words.append(next_word)
                if (kind == "ROOT") != (not open_joints) or (kind == "ROOT" and joints):
                    raise fault(f"{kind} {' '.join(words)} is not allowed here", line)
                parent = open_joints[-1]["index"] if open_joints else -1
                if parent is None:
                    raise fault("a joint comes before its parent's OFFSET", line)
                taken = {joint.name for joint in joints}
                name = _end_name(joints[parent].name, taken) if kind == "END" else " ".join(words)
                if not name or name in taken:
                    raise fault(f"the joint name '{name}' is missing or already used", line)
                open_joints.append({"name": name, "parent": parent, "end": kind == "END", "index": None})
            case "OFFSET" if open_joints and open_joints[-1]["index"] is None:
                offset = tuple(common.parse_numbers(take(3), line))
                open_joints[-1]["index"] = len(joints)
                joints.append(_BvhJoint(open_joints[-1]["name"], open_joints[-1]["parent"], offset, ()))
            case "CHANNELS" if open_joints and open_joints[-1]["index"] is not None and not open_joints[-1]["end"]:
                count = take(1)[0]
                channels = tuple(word.lower() for word in take(int(count) if re.fullmatch(r"\d{1,3}", count) else 0))
                if (
                    not count.isdecimal()
                    or len(set(channels)) < len(channels)
                    or not all(re.fullmatch("[xyz](position|rotation)", channel) for channel in channels)
                ):
                    raise fault(f"CHANNELS {count} {' '.join(channels)} is not a list of that many channels", line)
                joints[open_joints[-1]["index"]] = replace(joints[open_joints[-1]["index"]], channels=channels)
            case "}" if open_joints and open_joints[-1]["index"] is not None:
                open_joints.pop()
            case _:
                raise fault(f"unexpected '{word}'", line)
    if open_joints or not joints:
        raise fault("the hierarchy ends in the middle", tokens[-1][1])
    return joints


def _end_name(parent: str, taken: set[str]) -> str:
    name, count = f"{parent}_end", 1
    while name in taken:
        count += 1
        name = f"{parent}_end{count}"
    return name


def _read_motion(text: str, channels: int, line: int) -> tuple[float, NDArray]:
    """Rate [Hz] and values (F, C) of the motion; `line` is the line number at which `text` begins."""
    lines = [(n, content) for n, content in enumerate(text.split("\n"), line) if content.strip()]
    found = []
    for i, pattern in enumerate((r"\s*Frames\s*:\s*(\d{1,12})\s*", r"\s*Frame\s+Time\s*:\s*(\S+)\s*")):
        match = re.fullmatch(pattern, lines[i][1], flags=re.I) if i < len(lines) else None
        if match is None:
            problem = f"the line '{('Frames:', 'Frame Time:')[i]} ...' is missing or not a number"
            remedy = "Export the motion again."
            raise FileError(problem, place=f"line {lines[i][0] if i < len(lines) else line}", remedy=remedy)
        found.append(match[1])
    frames, rows = int(found[0]), lines[2:]
    (frame_time,) = common.parse_numbers([found[1]], lines[1][0])
    if frame_time <= 0 or frames == 0:
        problem = "the frame time is not positive" if frames else "the motion has no frames"
        raise FileError(problem, place=f"line {lines[1 if frames else 0][0]}", remedy="Export the motion again.")
    values: list[list[float]] = []
    for n, row in rows:
        numbers = common.parse_numbers(row.split(), n)
        if len(numbers) != channels:
            raise FileError(
                f"{len(numbers)} values for {channels} channels", place=f"line {n}",
                remedy="If it is the last line the file was cut off: export it again, or delete the line and set "
                f"'Frames: {len(values)}'.",
            )
        values.append(numbers)
    if len(values) != frames:
        problem = f"{len(values)} frames, but the file announces {frames}"
        remedy = f"Export it again, or set 'Frames: {len(values)}' on line {lines[0][0]}."
        raise FileError(problem, place=f"line {rows[-1][0] if rows else lines[1][0]}", remedy=remedy)
    return _exact_rate(frame_time, found[1]), np.array(values)


def _exact_rate(frame_time: float, printed: str) -> float:
    """Rate [Hz]: whole, or whole / 1.001, if its frame time [s] rounds to the printed one; else the reciprocal."""
    decimals = len(printed.partition(".")[2]) if "e" not in printed.lower() else 15
    for step in (1.0, 1.0 / 1.001):
        rate = max(round(1.0 / frame_time / step), 1) * step
        if abs(1.0 / rate - frame_time) <= 0.6 * 10.0**-decimals and abs(rate * frame_time - 1.0) < 1e-3:
            return rate
    return 1.0 / frame_time


def _local_poses(joints: Sequence[_BvhJoint], values: NDArray) -> NDArray:
    """(F, J, 4, 4) pose of every joint in its parent's frame, lengths in the file's unit."""
    Ts_parent_joint = np.zeros((len(values), len(joints), 4, 4))
    Ts_parent_joint[..., 3, 3] = 1.0
    at = 0
    for i, joint in enumerate(joints):
        columns = values[:, at : at + len(joint.channels)]
        at += len(joint.channels)
        turns = [k for k, channel in enumerate(joint.channels) if channel.endswith("rotation")]
        Ts_parent_joint[:, i, :3, :3] = common.euler_rotations(
            np.radians(columns[:, turns]), [joint.channels[k][0] for k in turns]
        )
        Ts_parent_joint[:, i, :3, 3] = joint.offset
        shifts = [k for k, channel in enumerate(joint.channels) if channel.endswith("position")]
        axes = ["xyz".index(joint.channels[k][0]) for k in shifts]
        offset = np.array(joint.offset)[axes]
        added = i > 0 and _is_added(columns[:, shifts], offset)
        Ts_parent_joint[:, i, axes, 3] = columns[:, shifts] + (offset if added else 0.0)
    return Ts_parent_joint


def _is_added(positions: NDArray, offset: NDArray) -> bool:
    """Whether position channels (F, P) are added to the OFFSET (P,), not in place of it: then they are not as long."""
    lengths = np.linalg.norm(positions, axis=1)
    return bool(np.median(lengths) <= np.median(np.abs(lengths - np.linalg.norm(offset))))


def _root_shift(root: _BvhJoint, values: NDArray, up: str) -> NDArray:
    """(3,) the root's OFFSET if its position channels are added to it, else zero."""
    shift, up = np.zeros(3), up[-1]
    height = [k for k, channel in enumerate(root.channels) if channel == f"{up}position"]
    if _is_added(values[:, height], np.array(root.offset)[["xyz".index(up)] * len(height)]):
        axes = ["xyz".index(channel[0]) for channel in root.channels if channel.endswith("position")]
        shift[axes] = np.array(root.offset)[axes]
    return shift


def _human_unit(names: Sequence[str], parents: Sequence[int], offsets: NDArray) -> float:
    """The unit of `UNITS` with the most plausible stature.

    The stature is the length of the bones from head to ankle, independent of the pose; the extent of the rest pose
    if no joint is named as head and feet.
    """
    head, feet = common.landmarks(names)
    if head is not None and feet:
        chains = [set(_chain(head, parents)) ^ set(_chain(foot, parents)) for foot in feet]
        lengths = np.linalg.norm(offsets, axis=1)
        height = float(np.mean([lengths[list(chain)].sum() for chain in chains])) / _HEAD_TO_ANKLE_SHARE
    else:
        rest = np.array(offsets)
        for joint, parent in enumerate(parents):
            rest[joint] = offsets[joint] + rest[parent] if parent >= 0 else 0.0
        height = float(np.ptp(rest, axis=0).max())
    unit = min(UNITS, key=lambda u: abs(height * u - _TYPICAL_STATURE))
    if not _MIN_STATURE <= height * unit <= _MAX_STATURE:
        remedy = _UNIT_REMEDY if height > 0 else "Export the skeleton again, with the lengths of its bones."
        raise FileError(f"the skeleton is {height:.4g} units tall: no known unit makes that a person", remedy=remedy)
    return unit


def _chain(joint: int, parents: Sequence[int]) -> list[int]:
    """The joint and its ancestors."""
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = parents[joint]
    return chain
