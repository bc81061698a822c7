"""Acclaim skeleton (ASF): bones, their axes, degrees of freedom and limits."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike, fspath

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import FileError, check_choice, choices
from kinefit.readers.skeletons.common import euler_rotations, given_unit, parse_numbers, read_text

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
            raise FileError(f"holds no section :{name}", file=path, remedy="Give a whole ASF file.")
    units = {words[0].lower(): (n, words[1]) for n, words in sections.get("units", []) if len(words) > 1}
    degrees = units.get("angle", (0, "deg"))[1].lower().startswith("deg")
    if unit is None or unit == "auto":
        line, length = units.get("length", (0, "1.0"))
        (scale,) = parse_numbers([length], file=path, line=line)
        unit = _INCH / scale if scale > 0 else 0.0
    unit = given_unit(unit, path)

    root = {words[0].lower(): (n, words[1:]) for n, words in sections["root"]}
    angle = np.pi / 180.0 if degrees else 1.0
    position = np.array(_three(root.get("position", (0, ["0"] * 3)), path)) * unit
    order = tuple(word.lower() for word in root.get("order", (0, _DOFS[3:] + _DOFS[:3]))[1])
    axis = "".join(root.get("axis", (0, ["XYZ"]))[1])
    orientation = np.array(_three(root.get("orientation", (0, ["0"] * 3)), path)) * angle
    _check_dofs(order, path, root.get("order", (0,))[0])
    top = Bone("root", -1, np.zeros(3), _axes(orientation, axis, path, root.get("axis", (0,))[0]), order)
    loose = {"root": top}
    for bone in _bones(sections["bonedata"], unit, angle, path):
        if bone.name in loose:
            raise FileError(f"two bones are named '{bone.name}'", file=path, remedy="Rename one of them.")
        loose[bone.name] = bone
    bones = _in_order(sections["hierarchy"], loose, path)
    return AsfSkeleton(bones, position, float(unit), degrees, fspath(path))


def _sections(path: str | PathLike[str]) -> dict[str, list[tuple[int, list[str]]]]:
    """Words of every line with its number, by section; comments dropped."""
    sections: dict[str, list[tuple[int, list[str]]]] = {}
    current: list[tuple[int, list[str]]] = []
    for n, line in enumerate(read_text(path, "ASF").split("\n"), 1):
        words = line.partition("#")[0].split()
        if words and words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [])
            words = words[1:]
        if words:
            current.append((n, words))
    return sections


def _bones(lines: list[tuple[int, list[str]]], unit: float, angle: float, path: str | PathLike[str]) -> Iterator[Bone]:
    """Bones between "begin" and "end", with no parent yet."""
    entries: dict[str, tuple[int, list[str]]] | None = None
    key = ""
    for n, words in lines:
        word = words[0].lower()
        if (word == "begin") == (entries is not None):
            raise FileError("begin and end do not match", file=path, place=f"line {n}", remedy="Give a whole ASF file.")
        if word == "begin":
            entries, key = {}, ""
        elif word == "end":
            yield _bone(entries or {}, n, unit, angle, path)
            entries = None
        elif word.startswith("(") and key == "limits":
            entries[key][1].extend(words)  # type: ignore[index]  # limits go on over several lines
        else:
            key = word
            entries[key] = (n, words[1:])  # type: ignore[index]
    if entries is not None:
        raise FileError(
            "ends in the middle of a bone", file=path, place=f"line {lines[-1][0]}", remedy="Give a whole ASF file."
        )


def _bone(entries: dict, line: int, unit: float, angle: float, path: str | PathLike[str]) -> Bone:
    missing = [key for key in ("name", "direction", "length") if not entries.get(key, (0, []))[1]]
    if missing:
        raise FileError(f"the bone lacks {', '.join(missing)}", file=path, place=f"line {line}", remedy="Add it.")
    name = entries["name"][1][0]
    direction = np.array(_three(entries["direction"], path))
    (length,) = parse_numbers(entries["length"][1][:1], file=path, line=entries["length"][0])
    if length < 0 or not np.linalg.norm(direction) > 0:
        raise FileError(
            f"bone '{name}' has no direction or a negative length", file=path, place=f"line {line}", remedy="Set it."
        )
    axis_line, axis = entries.get("axis", (line, ["0", "0", "0", "XYZ"]))
    axes = _axes(np.array(_three((axis_line, axis[:3]), path)) * angle, "".join(axis[3:]) or "XYZ", path, axis_line)
    dof_line, dofs = entries.get("dof", (line, []))
    dofs = tuple(dof.lower() for dof in dofs)
    _check_dofs(dofs, path, dof_line)
    limits = None
    if "limits" in entries:
        limit_line, words = entries["limits"]
        numbers = re.sub(r"[(),]", " ", " ".join(words)).split()
        if len(numbers) != 2 * len(dofs):
            raise FileError(
                f"bone '{name}' has {len(numbers)} limits for {len(dofs)} degrees of freedom",
                file=path,
                place=f"line {limit_line}",
                remedy="Give a pair of limits for each.",
            )
        scale = np.array([angle if dof[0] == "r" else unit for dof in dofs])
        if not all(map(_LIMIT.fullmatch, numbers)):
            problem = f"bone '{name}' has limits that are no numbers"
            raise FileError(problem, file=path, place=f"line {limit_line}", remedy="Give two limits for each.")
        limits = np.array([float(x) for x in numbers]).reshape(-1, 2) * scale[:, None]  # may be infinite
    vector = direction / np.linalg.norm(direction) * length * unit
    return Bone(name, -1, vector, axes, dofs, limits)


def _three(entry: tuple[int, Sequence[str]], path: str | PathLike[str]) -> list[float]:
    line, words = entry
    numbers = parse_numbers(words, file=path, line=line)
    if len(numbers) != 3:
        raise FileError(f"{len(numbers)} numbers instead of 3", file=path, place=f"line {line}", remedy="Give 3.")
    return numbers


def _axes(angles: NDArray, order: str, path: str | PathLike[str], line: int) -> NDArray:
    """Rotation by angles listed in the given order, the first one acting first."""
    order = order.lower()
    if sorted(order) != ["x", "y", "z"]:
        raise FileError(
            f"the order of axes '{order}' is unknown", file=path, place=f"line {line}", remedy="Give one, as XYZ."
        )
    return euler_rotations(angles[::-1], order[::-1])


def _check_dofs(dofs: Sequence[str], path: str | PathLike[str], line: int) -> None:
    unknown = [dof for dof in dofs if dof not in _DOFS]
    if unknown:
        raise FileError(choices("degree of freedom", unknown[0], _DOFS), file=path, place=f"line {line}")
    if len(set(dofs)) < len(dofs):
        raise FileError("a degree of freedom is listed twice", file=path, place=f"line {line}", remedy="List it once.")


def _in_order(
    lines: list[tuple[int, list[str]]], loose: dict[str, Bone], path: str | PathLike[str]
) -> tuple[Bone, ...]:
    """Bones with their parents, depth first from the root."""
    parent_of: dict[str, str] = {}
    children: dict[str, list[str]] = {}
    for n, (parent, *names) in lines:
        if parent.lower() in ("begin", "end") and not names:
            continue
        for name in (parent, *names):
            check_choice("bone", name, loose, FileError, file=path, place=f"line {n}")
        for name in names:
            if name in parent_of or name == "root":
                raise FileError(
                    f"bone '{name}' has two parents or is the root",
                    file=path,
                    place=f"line {n}",
                    remedy="Name every bone once as a child.",
                )
            parent_of[name] = parent
            children.setdefault(parent, []).append(name)
    bones: list[Bone] = []
    index: dict[str, int] = {}
    stack = ["root"]
    while stack:
        name = stack.pop()
        bone = loose[name]
        index[name] = len(bones)
        above = index[parent_of[name]] if name in parent_of else -1
        bones.append(Bone(name, above, bone.vector, bone.R_world_axes, bone.dofs, bone.limits))
        stack.extend(reversed(children.get(name, [])))
    unreached = [name for name in loose if name not in index]
    if unreached:
        raise FileError(
            f"no path from the root to {', '.join(unreached)}",
            file=path,
            place=":hierarchy",
            remedy="Name every bone once as a child.",
        )
    return tuple(bones)
