"""Shared functions of the readers of skeleton motions: text, Euler angles, forward kinematics."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit._files import LENGTHS, read_text, worth
from kinefit.bodies.motion import UP_AXES
from kinefit.errors import FileError, check_choice
from kinefit.geometry.se3 import exp_so3


def text_of(path: str | PathLike[str], kind: str) -> str:
    """Text of a file of the given kind ("BVH"); raises FileError if it cannot be read or is binary."""
    text = read_text(path, f"the {kind} file", remedy=f"Give the path of a {kind} file.", errors="replace")
    if "\0" in text:
        raise FileError(f"is a binary file, not {kind} text", remedy=f"Give a {kind} file.")
    return text


def parse_numbers(tokens: Sequence[str], line: int) -> list[float]:
    """Finite numbers of one line; raises FileError with the line."""
    values = []
    for token in tokens:
        try:
            values.append(float(token))
        except ValueError:
            remedy = "Export the motion again, with a point as the decimal mark."
            raise FileError(f"'{token}' is not a number", place=f"line {line}", remedy=remedy) from None
    if not all(map(math.isfinite, values)):
        remedy = "Fill the gaps of the motion before exporting, or cut these frames out."
        raise FileError("holds a value that is not finite", place=f"line {line}", remedy=remedy)
    return values


def euler_rotations(angles: NDArray, axes: Sequence[str]) -> NDArray:
    """Rotations of Euler angles: the product of elementary rotations about `axes`, from left to right.

    Parameters
    ----------
    angles : (..., A) [rad]
    axes : A of "x", "y", "z"
        "zyx" gives Rz(a0) Ry(a1) Rx(a2).

    Returns
    -------
    (..., 3, 3) rotations
    """
    rotations = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3))
    for k, axis in enumerate(axes):
        rotations = rotations @ exp_so3(angles[..., k, None] * np.eye(3)["xyz".index(axis)])
    return rotations


def joint_poses(parents: Sequence[int], Ts_parent_joint: NDArray) -> NDArray:
    """Poses (F, J, 4, 4) in the world, from poses (F, J, 4, 4) in the parents' frames; parents come first."""
    Ts_world_joint = np.array(Ts_parent_joint)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            Ts_world_joint[:, joint] = Ts_world_joint[:, parent] @ Ts_parent_joint[:, joint]
    return Ts_world_joint


def landmarks(names: Sequence[str]) -> tuple[int | None, list[int]]:
    """Joint of the head (None if not found by name) and joints of the feet."""
    heads = [i for i, name in enumerate(names) if "head" in name.lower()]
    feet = [i for i, name in enumerate(names) if re.search("foot|ankle", name.lower()) and not name.endswith("_end")]
    return (heads[0] if heads else None), feet


def vertical_axis(up: str, names: Sequence[str], positions: NDArray) -> str:
    """The given axis, such as "y" or "-z"; for "auto" the one along which the head is above the feet on average.

    Positions are (F, J, 3). "y" if no joint is named as head and feet. Raises FileError for another axis.
    """
    check_choice("vertical axis", up, (*UP_AXES, "auto"), FileError)
    head, feet = landmarks(names)
    if up != "auto" or head is None or not feet:
        return "y" if up == "auto" else up
    away = (positions[:, head] - positions[:, feet].mean(axis=1)).mean(axis=0)
    return max(UP_AXES, key=lambda axis: float(away @ UP_AXES[axis]))


def given_unit(unit: float | str) -> float:
    """Metres of a unit of length, given by its name or in metres; raises FileError if it is no length."""
    try:
        value = worth(unit, LENGTHS) or float(unit)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise FileError(f"unit {unit!r} is not a length", remedy="Give m, cm, mm, in, or metres per unit.")
    return value
