"""Acclaim motion (AMC) with its skeleton (ASF), as of the CMU motion capture library."""

from __future__ import annotations

from os import PathLike, fspath

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.errors import FileError, choices
from kinefit.observations import SkeletonMotion
from kinefit.readers.skeletons.asf import AsfSkeleton, Bone, read_asf
from kinefit.readers.skeletons.common import euler_rotations, joint_poses, parse_numbers, read_text, vertical_axis


@checked
def read_amc(
    asf_path: str | PathLike[str],
    amc_path: str | PathLike[str],
    *,
    rate: float = 120.0,
    unit: float | str | None = None,
    up: str = "auto",
) -> SkeletonMotion:
    """Read an AMC motion with its ASF skeleton.

    Parameters
    ----------
    asf_path, amc_path : path
        The skeleton may be another subject's with the same bones and degrees of freedom.
    rate : float [Hz]
        Frames a second, which the format does not state; 120 in nearly all of the CMU library.
    unit : float [m] or a unit such as "cm", optional
        Unit of length; None takes inches divided by the ASF's `length`, as the CMU library means it.
    up : an axis such as "y" or "-z", or "auto"
        Vertical axis of the world. "auto" takes the axis along which, on average, the head is above the feet.

    Returns
    -------
    SkeletonMotion
        "root" and one joint a bone, under the bone's name, at the bone's START and turning with the bone; the end
        of every bone without children is the joint "<bone>_end". All frames are aligned with the world in the rest
        pose.

    Raises
    ------
    FileError
        If a file is missing, truncated or contradicts the other, or holds a value that is not finite.
    """
    skeleton = read_asf(asf_path, unit=unit)
    if not 0 < rate < np.inf:
        raise FileError(f"the rate {rate} is not positive", file=amc_path, remedy="Give frames a second.")
    values, degrees = _read_values(amc_path, skeleton)
    bones = skeleton.bones
    has_children = {bone.parent for bone in bones}
    leaves = [i for i in range(len(bones)) if i not in has_children]
    starts = [skeleton.position] + [bones[bone.parent].vector for bone in bones[1:]]
    parents = [bone.parent for bone in bones] + leaves
    offsets = np.array(starts + [bones[i].vector for i in leaves])

    Ts_parent_joint = np.tile(np.eye(4), (len(next(iter(values.values()))), len(parents), 1, 1))
    Ts_parent_joint[..., :3, 3] = offsets
    for i, bone in enumerate(bones):
        if bone.dofs:
            _move(Ts_parent_joint[:, i], bone, values[bone.name], skeleton.unit, degrees)
    names = tuple(bone.name for bone in bones) + tuple(f"{bones[i].name}_end" for i in leaves)
    Ts_world_joint = joint_poses(parents, Ts_parent_joint)
    return SkeletonMotion(
        names=names,
        parents=np.array(parents),
        offsets=offsets,
        rate=float(rate),
        Ts_world_joint=Ts_world_joint,
        up=vertical_axis(up, names, Ts_world_joint[..., :3, 3], amc_path),
        source=fspath(amc_path),
    )


def _move(Ts_parent_joint: NDArray, bone: Bone, values: NDArray, unit: float, degrees: bool) -> None:
    """Turn and shift one bone's rest pose (F, 4, 4) in place by its values (F, D): axes · M · axes⁻¹."""
    turns = [k for k, dof in enumerate(bone.dofs) if dof[0] == "r"][::-1]  # the first one listed acts first
    angles = np.radians(values[:, turns]) if degrees else values[:, turns]
    R = euler_rotations(angles, [bone.dofs[k][1] for k in turns])
    Ts_parent_joint[:, :3, :3] = bone.R_world_axes @ R @ bone.R_world_axes.T
    for k, dof in enumerate(bone.dofs):
        if dof[0] == "t":
            axis = np.eye(3)["xyz".index(dof[1])] if bone.parent < 0 else bone.R_world_axes[:, "xyz".index(dof[1])]
            Ts_parent_joint[:, :3, 3] += values[:, k, None] * unit * axis


def _read_values(path: str | PathLike[str], skeleton: AsfSkeleton) -> tuple[dict[str, NDArray], bool]:
    """Values (F, D) of every bone with degrees of freedom, in the file's units; whether angles are degrees."""
    counts = {bone.name: len(bone.dofs) for bone in skeleton.bones}
    moving = [bone.name for bone in skeleton.bones if bone.dofs]
    values: dict[str, list[list[float]]] = {name: [] for name in moving}
    degrees, first, frames, n = skeleton.degrees, 0, 0, 0

    def fault(problem: str, line: int, remedy: str) -> FileError:
        return FileError(problem, file=path, place=f"line {line}", remedy=remedy)

    def check_whole(line: int) -> None:
        lacking = [name for name in moving if len(values[name]) != frames]
        if lacking:
            remedy = "If it is the last frame the file was cut off: export it again or delete that frame."
            raise fault(f"frame {first + frames - 1} lacks or repeats {', '.join(lacking)}", line, remedy)

    for n, line in enumerate(read_text(path, "AMC").split("\n"), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if words[0].startswith(":"):
            degrees = {":degrees": True, ":radians": False}.get(words[0].lower(), degrees)
        elif len(words) == 1 and words[0].isdecimal() and len(words[0]) < 12:
            check_whole(n)
            first = first if frames else int(words[0])
            if int(words[0]) != first + frames:
                raise fault(f"frame {words[0]} follows frame {first + frames - 1}", n, "Give every frame, in order.")
            frames += 1
        elif not frames:
            raise fault(f"'{words[0]}' comes before the first frame number", n, "Give an AMC file.")
        elif words[0] not in counts:
            raise fault(choices("bone", words[0], counts), n, f"Give this motion's skeleton, not {skeleton.source}.")
        elif len(words) - 1 != counts[words[0]]:
            problem = f"{len(words) - 1} values for the {counts[words[0]]} degrees of freedom of '{words[0]}'"
            raise fault(problem, n, f"Give this motion's skeleton, not {skeleton.source}; or the file was cut off.")
        elif len(words) > 1:
            values[words[0]].append(parse_numbers(words[1:], file=path, line=n))
    if not frames:
        raise fault("holds no frames", n, "Give an AMC file.")
    check_whole(n)
    return {name: np.array(rows) for name, rows in values.items()}, degrees
