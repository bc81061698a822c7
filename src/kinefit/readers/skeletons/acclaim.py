"""Acclaim skeletons (ASF) and motions (AMC), as of the CMU motion capture library."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.errors import FileError, check_choice, choices, located, names_file
from kinefit.observations import SkeletonMotion
from kinefit.readers.skeletons import common

_INCH = 0.0254  # [m]
_DOFS = ("rx", "ry", "rz", "tx", "ty", "tz")


@dataclass(frozen=True, eq=False)
class Bone:
    """One bone of an ASF skeleton, in metres and radians.

    Parameters
    ----------
    name : str
    parent : int
        Index among the skeleton's bones; -1 for the root.
    vector : (3,) [m] from the bone's start to its end in the rest pose; zero for the root.
    R_world_axes : (3, 3) axes of its degrees of freedom in the rest pose.
    dofs : degrees of freedom ("rx", "tz", ...) in the order of the values in the AMC.
    limits : (D, 2) [rad or m], or None if the file states none.
    """

    name: str
    parent: int
    vector: NDArray
    R_world_axes: NDArray
    dofs: tuple[str, ...]
    limits: NDArray | None = None


@dataclass(frozen=True, eq=False)
class AsfSkeleton:
    """An ASF skeleton: bones, the root first and parents before children.

    Parameters
    ----------
    bones : tuple of Bone
    position : (3,) [m] of the root in the rest pose.
    unit : float [m] per unit of length of the file.
    degrees : bool
        Whether the file's angles are degrees.
    source : str
    """

    bones: tuple[Bone, ...]
    position: NDArray
    unit: float
    degrees: bool
    source: str
_LIMIT = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|[-+]?inf(?:inity)?", re.IGNORECASE)


@names_file
def read_asf(path: str | PathLike[str], *, unit: float | str | None = None) -> AsfSkeleton:
    """Read an ASF skeleton.

    Parameters
    ----------
    path : path
    unit : float [m] or a unit such as "cm", optional
        Unit of length; None: inches divided by the file's `length`, the convention of the CMU library.

    Raises
    ------
    FileError
        Missing, truncated, or a hierarchy that is not a tree of the bones from the root.
    """
    sections = _sections(path)
    for name in ("root", "bonedata", "hierarchy"):
        if name not in sections:
            raise FileError(f"holds no section :{name}", remedy="Give a whole ASF file.")
    units = {words[0].lower(): (n, words[1]) for n, words in sections.get("units", []) if len(words) > 1}
    degrees = units.get("angle", (0, "deg"))[1].lower().startswith("deg")
    if unit is None or unit == "auto":
        line, length = units.get("length", (0, "1.0"))
        (scale,) = common.parse_numbers([length], line)
        unit = _INCH / scale if scale > 0 else 0.0
    unit = common.given_unit(unit)

    root = {words[0].lower(): (n, words[1:]) for n, words in sections["root"]}
    angle = np.pi / 180.0 if degrees else 1.0
    position = np.array(_three(root.get("position", (0, ["0"] * 3)))) * unit
    order = tuple(word.lower() for word in root.get("order", (0, _DOFS[3:] + _DOFS[:3]))[1])
    axis = "".join(root.get("axis", (0, ["XYZ"]))[1])
    orientation = np.array(_three(root.get("orientation", (0, ["0"] * 3)))) * angle
    _check_dofs(order, root.get("order", (0,))[0])
    top = Bone("root", -1, np.zeros(3), _axes(orientation, axis, root.get("axis", (0,))[0]), order)
    loose = {"root": top}
    for bone in _bones(sections["bonedata"], unit, angle):
        if bone.name in loose:
            raise FileError(f"two bones are named '{bone.name}'", remedy="Rename one of them.")
        loose[bone.name] = bone
    bones = _in_order(sections["hierarchy"], loose)
    return AsfSkeleton(bones, position, float(unit), degrees, fspath(path))


def _sections(path: str | PathLike[str]) -> dict[str, list[tuple[int, list[str]]]]:
    """Words of every line with its number, by section; comments dropped."""
    sections: dict[str, list[tuple[int, list[str]]]] = {}
    current: list[tuple[int, list[str]]] = []
    for n, line in enumerate(common.text_of(path, "ASF").split("\n"), 1):
        words = line.partition("#")[0].split()
        if words and words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [])
            words = words[1:]
        if words:
            current.append((n, words))
    return sections


def _bones(lines: list[tuple[int, list[str]]], unit: float, angle: float) -> Iterator[Bone]:
    """Bones between "begin" and "end", with no parent yet."""
    entries: dict[str, tuple[int, list[str]]] | None = None
    key = ""
    for n, words in lines:
        word = words[0].lower()
        if (word == "begin") == (entries is not None):
            raise FileError("begin and end do not match", place=f"line {n}", remedy="Give a whole ASF file.")
        if word == "begin":
            entries, key = {}, ""
        elif word == "end":
            yield _bone(entries or {}, n, unit, angle)
            entries = None
        elif word.startswith("(") and key == "limits":
            entries[key][1].extend(words)  # type: ignore[index]  # limits go on over several lines
        else:
            key = word
            entries[key] = (n, words[1:])  # type: ignore[index]
    if entries is not None:
        raise FileError("ends in the middle of a bone", place=f"line {lines[-1][0]}", remedy="Give a whole ASF file.")


def _bone(entries: dict, line: int, unit: float, angle: float) -> Bone:
    missing = [key for key in ("name", "direction", "length") if not entries.get(key, (0, []))[1]]
    if missing:
        raise FileError(f"the bone lacks {', '.join(missing)}", place=f"line {line}", remedy="Add it.")
    name = entries["name"][1][0]
    direction = np.array(_three(entries["direction"]))
    (length,) = common.parse_numbers(entries["length"][1][:1], entries["length"][0])
    if length < 0 or not np.linalg.norm(direction) > 0:
        raise FileError(f"bone '{name}' has no direction or a negative length", place=f"line {line}", remedy="Set it.")
    axis_line, axis = entries.get("axis", (line, ["0", "0", "0", "XYZ"]))
    axes = _axes(np.array(_three((axis_line, axis[:3]))) * angle, "".join(axis[3:]) or "XYZ", axis_line)
    dof_line, dofs = entries.get("dof", (line, []))
    dofs = tuple(dof.lower() for dof in dofs)
    _check_dofs(dofs, dof_line)
    limits = None
    if "limits" in entries:
        limit_line, words = entries["limits"]
        numbers = re.sub(r"[(),]", " ", " ".join(words)).split()
        if len(numbers) != 2 * len(dofs):
            problem = f"bone '{name}' has {len(numbers)} limits for {len(dofs)} degrees of freedom"
            raise FileError(problem, place=f"line {limit_line}", remedy="Give a pair of limits for each.")
        scale = np.array([angle if dof[0] == "r" else unit for dof in dofs])
        if not all(map(_LIMIT.fullmatch, numbers)):
            problem = f"bone '{name}' has limits that are no numbers"
            raise FileError(problem, place=f"line {limit_line}", remedy="Give two limits for each.")
        limits = np.array([float(x) for x in numbers]).reshape(-1, 2) * scale[:, None]  # may be infinite
    vector = direction / np.linalg.norm(direction) * length * unit
    return Bone(name, -1, vector, axes, dofs, limits)


def _three(entry: tuple[int, Sequence[str]]) -> list[float]:
    line, words = entry
    numbers = common.parse_numbers(words, line)
    if len(numbers) != 3:
        raise FileError(f"{len(numbers)} numbers instead of 3", place=f"line {line}", remedy="Give 3.")
    return numbers


def _axes(angles: NDArray, order: str, line: int) -> NDArray:
    """Rotation by angles listed in the given order, the first one acting first."""
    order = order.lower()
    if sorted(order) != ["x", "y", "z"]:
        raise FileError(f"the order of axes '{order}' is unknown", place=f"line {line}", remedy="Give one, as XYZ.")
    return common.euler_rotations(angles[::-1], order[::-1])


def _check_dofs(dofs: Sequence[str], line: int) -> None:
    unknown = [dof for dof in dofs if dof not in _DOFS]
    if unknown:
        raise FileError(choices("degree of freedom", unknown[0], _DOFS), place=f"line {line}")
    if len(set(dofs)) < len(dofs):
        raise FileError("a degree of freedom is listed twice", place=f"line {line}", remedy="List it once.")


def _in_order(lines: list[tuple[int, list[str]]], loose: dict[str, Bone]) -> tuple[Bone, ...]:
    """Bones with their parents, depth first from the root."""
    parent_of: dict[str, str] = {}
    children: dict[str, list[str]] = {}
    for n, (parent, *names) in lines:
        if parent.lower() in ("begin", "end") and not names:
            continue
        for name in (parent, *names):
            check_choice("bone", name, loose, FileError, place=f"line {n}")
        for name in names:
            if name in parent_of or name == "root":
                problem = f"bone '{name}' has two parents or is the root"
                raise FileError(problem, place=f"line {n}", remedy="Name every bone once as a child.")
            parent_of[name] = parent
            children.setdefault(parent, []).append(name)
    bones: list[Bone] = []
    index: dict[str, int] = {}
    stack = ["root"]
    while stack:
        name = stack.pop()
        index[name] = len(bones)
        above = index[parent_of[name]] if name in parent_of else -1
        bones.append(replace(loose[name], parent=above))
        stack.extend(reversed(children.get(name, [])))
    unreached = [name for name in loose if name not in index]
    if unreached:
        problem = f"no path from the root to {', '.join(unreached)}"
        raise FileError(problem, place=":hierarchy", remedy="Name every bone once as a child.")
    return tuple(bones)


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
    Ts_world_joint = common.joint_poses(parents, Ts_parent_joint)
    with located(amc_path):
        up = common.vertical_axis(up, names, Ts_world_joint[..., :3, 3])
    return SkeletonMotion(
        names=names,
        parents=np.array(parents),
        offsets=offsets,
        rate=float(rate),
        Ts_world_joint=Ts_world_joint,
        up=up,
        source=fspath(amc_path),
    )


def _move(Ts_parent_joint: NDArray, bone: Bone, values: NDArray, unit: float, degrees: bool) -> None:
    """Turn and shift one bone's rest pose (F, 4, 4) in place by its values (F, D): axes · M · axes⁻¹."""
    turns = [k for k, dof in enumerate(bone.dofs) if dof[0] == "r"][::-1]  # the first one listed acts first
    angles = np.radians(values[:, turns]) if degrees else values[:, turns]
    R = common.euler_rotations(angles, [bone.dofs[k][1] for k in turns])
    Ts_parent_joint[:, :3, :3] = bone.R_world_axes @ R @ bone.R_world_axes.T
    for k, dof in enumerate(bone.dofs):
        if dof[0] == "t":
            axis = np.eye(3)["xyz".index(dof[1])] if bone.parent < 0 else bone.R_world_axes[:, "xyz".index(dof[1])]
            Ts_parent_joint[:, :3, 3] += values[:, k, None] * unit * axis


@names_file
def _read_values(path: str | PathLike[str], skeleton: AsfSkeleton) -> tuple[dict[str, NDArray], bool]:
    """Values (F, D) of every bone with degrees of freedom, in the file's units; whether angles are degrees."""
    counts = {bone.name: len(bone.dofs) for bone in skeleton.bones}
    moving = [bone.name for bone in skeleton.bones if bone.dofs]
    values: dict[str, list[list[float]]] = {name: [] for name in moving}
    degrees, first, frames, n = skeleton.degrees, 0, 0, 0

    def fault(problem: str, line: int, remedy: str) -> FileError:
        return FileError(problem, place=f"line {line}", remedy=remedy)

    def check_whole(line: int) -> None:
        lacking = [name for name in moving if len(values[name]) != frames]
        if lacking:
            remedy = "If it is the last frame the file was cut off: export it again or delete that frame."
            raise fault(f"frame {first + frames - 1} lacks or repeats {', '.join(lacking)}", line, remedy)

    for n, line in enumerate(common.text_of(path, "AMC").split("\n"), 1):
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
            values[words[0]].append(common.parse_numbers(words[1:], n))
    if not frames:
        raise fault("holds no frames", n, "Give an AMC file.")
    check_whole(n)
    return {name: np.array(rows) for name, rows in values.items()}, degrees
