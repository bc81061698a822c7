"""BVH (Biovision hierarchy): the fitted skeleton and its motion, for animation programs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_lines
from kinefit.bodies import Body
from kinefit.exporters.skeletons.common import (
    UNITS,
    bone_names,
    check_up,
    euler_zxy,
    length_factor,
    moving_segments,
    numbers,
)
from kinefit.exporters.skeletons.rest import Rest, rest_pose
from kinefit.motion import Motion

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
    names : "bvh", "mixamo", "cmu", "opensim", "hanim" or "kinefit"
        Names of the joints; "bvh": the usual ones (Hips, RightUpLeg ...).
    rest : "body" or "t", optional
        Rest pose: the body's own, arms hanging, facing x; or a T facing z. Default: "t" with Mixamo's names.

    Raises
    ------
    ExportError
        Unknown unit, axis, names or rest pose, or the file cannot be written.
    """
    body, scale, joints = motion.body, length_factor(unit, UNITS, path), bone_names(motion.body, names, path)
    pose = rest_pose(body, rest, names, path)
    check_up(up, path)
    with_position = moving_segments(body)
    order: list[int] = []
    head = ["HIERARCHY", *_hierarchy(body, pose, joints, with_position, scale, order)]

    def tables() -> Iterator[NDArray]:
        before = None
        for part in motion.parts():
            Ts = pose.local_poses(part.turned(up))
            turns = euler_zxy(Ts[..., :3, :3], before)
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
    body: Body, pose: Rest, names: list[str], with_position: NDArray, scale: float, order: list[int]
) -> list[str]:
    """Lines of the hierarchy; fills `order` with the segments in the order of their channels."""
    tree = body.tree
    ends = {s: scale * pose.turns[s] @ end for s, end in body.segment_ends().items()}

    def joint(s: int, depth: int) -> list[str]:
        order.append(s)
        indent, inner = "\t" * depth, "\t" * (depth + 1)
        channels = f"6 {_POSITIONS} {_ROTATIONS}" if with_position[s] else f"3 {_ROTATIONS}"
        lines = [f"{indent}{'JOINT' if depth else 'ROOT'} {names[s]}", f"{indent}{{"]
        lines += [f"{inner}OFFSET {numbers(scale * pose.offsets[s], '.8f')}", f"{inner}CHANNELS {channels}"]
        children = np.flatnonzero(tree.parents == s)
        for child in children:
            lines += joint(int(child), depth + 1)
        if not len(children):
            end = numbers(ends.get(s, np.zeros(3)), ".8f")
            lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {end}", f"{inner}}}"]
        return [*lines, f"{indent}}}"]

    return joint(0, 0)

