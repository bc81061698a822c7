"""Skeletons as text: BVH for animation programs, X3D with H-Anim figures for browsers and archives."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from os import PathLike
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_lines
from kinefit.bodies import Body
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError
from kinefit.exporters.skeletons import common

_ROTATIONS = "Zrotation Xrotation Yrotation"
_POSITIONS = "Xposition Yposition Zposition"


@checked
def write_bvh(
    motion: Motion, path: str | PathLike[str], *, unit: str = "cm", up: str = "y", names: str = "bvh",
    rest: str | None = None,
) -> None:
    """Write a motion as BVH.

    Rotations are Euler angles Z, X, Y without jumps. The root has six channels, every other joint three; a joint that
    slides has six, its position standing instead of its OFFSET.

    Parameters
    ----------
    motion : Motion
    path : path
    unit : "cm", "m" or "mm"
        Unit of length in the file; the format does not state it.
    up : str
        Vertical axis of the file's world.
    names : "bvh", "kinefit", "mixamo", "cmu", "opensim", "hanim", "vrm", "unity" or "unreal"
        Names of the joints; "bvh": common ones (Hips, RightUpLeg ...).
    rest : "body" or "t", optional
        Rest pose: the body's own, arms hanging, facing x; or a T facing z. Default: "t" with the
        names of Mixamo, VRM, Unity and Unreal.

    Raises
    ------
    ExportError
        Unknown unit, axis, names or rest pose, or the file cannot be written.
    """
    body, scale = motion.body, common.length_factor(unit, common.UNITS, path)
    joints = common.bone_names(body, names, path)
    pose = common.rest_pose(body, rest, names, path)
    common.check_up(up, path)
    with_position = common.moving_segments(body)
    order: list[int] = []
    head = ["HIERARCHY", *_hierarchy(body, pose, joints, with_position, scale, order)]

    def tables() -> Iterator[NDArray]:
        before = None
        for part in motion.parts():
            Ts = pose.local_poses(part.turned(up))
            turns = common.euler_zxy(Ts[..., :3, :3], before)
            before = turns[-1] if len(turns) else None
            columns: list[NDArray] = []
            for s in order:
                columns += [scale * Ts[:, s, :3, 3]] * bool(with_position[s]) + [np.degrees(turns[:, s])]
            yield np.concatenate(columns, axis=1)

    write_lines(path, chain(head, bvh_motion(motion, tables())))


def bvh_motion(motion: Motion, tables: Iterable[NDArray]) -> Iterator[str]:
    """Lines of the motion, from the values of its channels (F, C) in pieces."""
    yield from ("MOTION", f"Frames: {len(motion)}", f"Frame Time: {1.0 / motion.rate:.9f}")
    for table in tables:
        row = " ".join(["%.8f"] * table.shape[1])  # twice as fast as number by number
        yield from (row % tuple(values) for values in (table + 0.0).tolist())


def _hierarchy(
    body: Body, pose: common.Rest, names: list[str], with_position: NDArray, scale: float, order: list[int]
) -> list[str]:
    """Lines of the hierarchy; fills `order` with the segments in the order of their channels."""
    tree = body.tree
    ends = {s: scale * pose.turns[s] @ end for s, end in body.segment_ends().items()}

    def joint(s: int, depth: int) -> list[str]:
        order.append(s)
        indent, inner = "\t" * depth, "\t" * (depth + 1)
        channels = f"6 {_POSITIONS} {_ROTATIONS}" if with_position[s] else f"3 {_ROTATIONS}"
        lines = [f"{indent}{'JOINT' if depth else 'ROOT'} {names[s]}", f"{indent}{{"]
        lines += [f"{inner}OFFSET {common.numbers(scale * pose.offsets[s], '.8f')}", f"{inner}CHANNELS {channels}"]
        children = np.flatnonzero(tree.parents == s)
        for child in children:
            lines += joint(int(child), depth + 1)
        if not len(children):
            end = common.numbers(ends.get(s, np.zeros(3)), ".8f")
            lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {end}", f"{inner}}}"]
        return [*lines, f"{indent}}}"]

    return joint(0, 0)


_FORM = ".9g"  # of numbers
_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<!DOCTYPE X3D PUBLIC "ISO//Web3D//DTD X3D 4.0//EN" "https://www.web3d.org/specifications/x3d-4.0.dtd">
<X3D profile="Immersive" version="4.0" xmlns:xsd="http://www.w3.org/2001/XMLSchema-instance" \
xsd:noNamespaceSchemaLocation="https://www.web3d.org/specifications/x3d-4.0.xsd">"""


@checked
def write_x3d(motion: Motion, path: str | PathLike[str], *, names: str | None = None, rest: str | None = None) -> None:
    """Write a motion as X3D 4.0: an HAnimHumanoid of HAnimJoints, turned by interpolators.

    Metres, y up, as the standard has it. At rest the figure stands as H-Anim asks: arms hanging, facing z. Every
    joint turns by an OrientationInterpolator; the root, and joints that slide, move by a PositionInterpolator, too.
    Keys are the frames, over one cycle of the TimeSensor. Segments are lines between joints, under the body's names.

    Parameters
    ----------
    motion : Motion
    path : path
    names : "hanim", "kinefit", "mixamo", "cmu", "opensim", "bvh", "vrm", "unity" or "unreal", optional
        Names of the joints. Default: "hanim" for a body that has such names, else its own.
    rest : "body" or "t", optional
        Rest pose: arms hanging, facing z; or a T facing z. Default: "t" with the
        names of Mixamo, VRM, Unity and Unreal.

    Raises
    ------
    ExportError
        Fewer than two frames, unknown names or rest pose, or the file cannot be written.
    """
    body = motion.body
    if len(motion) < 2:
        raise ExportError("X3D moves a figure between two frames or more", file=path, remedy="Give a longer motion.")
    names = names or ("hanim" if body.aliases.get("hanim") else "kinefit")
    joints, segments = common.bone_names(body, names, path), common.plain_names(body.tree.segments)
    ids = _ids(joints, segments)
    plain = common.rest_pose(body, rest, names, path)
    pose = common.standing(body) if np.all(plain.turns == np.eye(3)) else plain
    turns, places = pose.local_moves(motion, "y")
    moves = common.moving_segments(body)
    keys = common.numbers(np.arange(len(motion)) / (len(motion) - 1), _FORM)

    def lines() -> Iterator[str]:
        seconds = (len(motion) - 1) / motion.rate
        yield _HEAD
        yield f'<head><component name="HAnim" level="1"/><meta name="title" content={quoteattr(motion.name)}/>'
        yield '<meta name="generator" content="kinefit"/></head>\n<Scene>'
        yield f'<TimeSensor DEF="clock" cycleInterval="{seconds:.9g}" loop="true"/>'
        yield '<HAnimHumanoid DEF="humanoid" name="humanoid" version="2.0">'
        yield from _joints(body, pose, joints, segments, ids)
        yield from (f'<HAnimJoint USE="{joint}" containerField="joints"/>' for joint, _ in ids)
        yield from (f'<HAnimSegment USE="{segment}" containerField="segments"/>' for _, segment in ids)
        yield "</HAnimHumanoid>"
        for s in range(len(joints)):
            yield from _moved("Orientation", "rotation", ids[s][0], keys, _axis_angles(turns[:, s]))
            if moves[s]:
                yield from _moved("Position", "translation", ids[s][0], keys, places[:, s] - pose.offsets[s])
        yield "</Scene>\n</X3D>"

    write_lines(path, lines())


def _ids(joints: Sequence[str], segments: Sequence[str]) -> list[tuple[str, str]]:
    """What each joint and its segment are called in the file: after the humanoid and their names, as H-Anim asks."""

    def after(name: str, kind: str, s: int) -> str:
        return f"humanoid_{name}" if re.fullmatch(r"[\w.-]+", name) else f"humanoid_{kind}_{s}"

    limbs = [after(name, "segment", s) for s, name in enumerate(segments)]
    out: list[tuple[str, str]] = []
    for s, name in enumerate(joints):
        own, others = after(name, "joint", s), {*limbs, *(joint for joint, _ in out)}
        out.append((f"{own}_joint" if own in others else own, limbs[s]))
    return out


def _joints(
    body: Body, pose: common.Rest, names: Sequence[str], plain: Sequence[str], ids: Sequence[tuple[str, str]]
) -> Iterator[str]:
    """The tree of joints, each with its segment: lines to the joints below, or to its end."""
    tree, ends = body.tree, body.segment_ends()

    def joint(s: int) -> Iterator[str]:
        field = ' containerField="skeleton"' if tree.parents[s] < 0 else ""
        centre = common.numbers(pose.positions[s], _FORM)
        yield f'<HAnimJoint{field} DEF="{ids[s][0]}" name={quoteattr(names[s])} center="{centre}">'
        children = [int(child) for child in np.flatnonzero(tree.parents == s)]
        to = [pose.positions[child] for child in children]
        if not to and s in ends:
            to = [pose.positions[s] + pose.turns[s] @ ends[s]]
        yield f'<HAnimSegment DEF="{ids[s][1]}" name={quoteattr(plain[s])}>'
        if to:
            points = common.numbers([[pose.positions[s], end] for end in to], _FORM)
            yield '<Shape><Appearance><Material emissiveColor="0.1 0.4 0.7"/></Appearance>'
            yield f'<LineSet vertexCount="{" ".join(["2"] * len(to))}"><Coordinate point="{points}"/></LineSet></Shape>'
        yield "</HAnimSegment>"
        for child in children:
            yield from joint(child)
        yield "</HAnimJoint>"

    for root in np.flatnonzero(tree.parents < 0):
        yield from joint(int(root))


def _moved(kind: str, field: str, joint: str, keys: str, values: NDArray) -> Iterator[str]:
    """An interpolator, and its routes from the clock and to the joint."""
    name = f"{field}_{joint}"
    yield f'<{kind}Interpolator DEF="{name}" key="{keys}" keyValue="{common.numbers(values, _FORM)}"/>'
    yield f'<ROUTE fromNode="clock" fromField="fraction_changed" toNode="{name}" toField="set_fraction"/>'
    yield f'<ROUTE fromNode="{name}" fromField="value_changed" toNode="{joint}" toField="set_{field}"/>'


def _axis_angles(quaternions: NDArray) -> NDArray:
    """(F, 4) axis and angle [rad] of quaternions w, x, y, z; the axis z where nothing turns."""
    sines = np.linalg.norm(quaternions[:, 1:], axis=1)
    turned = sines > 1e-12
    axes = np.where(turned[:, None], quaternions[:, 1:] / np.where(turned, sines, 1.0)[:, None], [0.0, 0.0, 1.0])
    return np.column_stack([axes, 2.0 * np.arctan2(sines, quaternions[:, 0])])
