"""What all skeleton formats need: names and units of choice, Euler angles and quaternions without jumps."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body
from kinefit.errors import ExportError, check_choice, spelled
from kinefit.motion import UP_AXES, Motion

NAMES = ("kinefit", "bvh", "mixamo", "cmu", "opensim", "hanim")
"""Conventions of names: the body's own, then its aliases."""

UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
"""Units of length in a metre."""

_LOCKED = 1e-7  # cosine of the middle angle below which the outer two turn about one axis


def moving_segments(body: Body) -> NDArray:
    """(S,) bool: the root, and segments whose joint can slide, so that their offset changes."""
    out = np.zeros(len(body.tree.segments), bool)
    out[body.tree.owners[body.tree.prismatic]] = out[0] = True
    return out


def numbers(values: ArrayLike, form: str) -> str:
    """Numbers in a row as text, each in a form such as ".9g"; no minus before zero."""
    return " ".join(f"{value + 0.0:{form}}" for value in np.ravel(values).tolist())


def euler_zxy(rotations: NDArray, before: NDArray | None = None) -> NDArray:
    """Angles (F, ..., 3) [rad] about body-fixed z, x, y of rotations (F, ..., 3, 3), R = Rz Rx Ry, continuous over F.

    Of the two triples that give the same rotation, and of all whole turns, the nearest to the frame before is taken.
    At gimbal lock the first angle stays as it was, so that the triple always gives the rotation. `before` (..., 3) is
    the triple of the frame before the first.
    """
    R = np.asarray(rotations, float)
    out = np.empty((*R.shape[:-2], 3))
    before = np.zeros(R.shape[1:-2] + (3,)) if before is None else before
    for frame in range(len(R)):
        out[frame] = before = _nearest_zxy(R[frame], before)
    return out


def euler(rotations: NDArray, axes: str) -> NDArray:
    """(F, 3) [rad] angles about three different body-fixed axes in this order, without jumps, of (F, 3, 3)."""
    i, j, k = ("xyz".index(axis) for axis in axes)
    as_zxy = rotations[:, [[j], [k], [i]], [j, k, i]]  # axes renamed; where that mirrors, turns go the other way
    return euler_zxy(as_zxy) * (1.0 if (j - i) % 3 == 1 else -1.0)


def _nearest_zxy(R: NDArray, before: NDArray) -> NDArray:
    locked = np.hypot(R[..., 0, 1], R[..., 1, 1]) < _LOCKED
    z = np.where(locked, before[..., 0], np.arctan2(-R[..., 0, 1], R[..., 1, 1]))
    one, other = _given_z(R, z, before), _given_z(R, z + np.pi, before)
    nearer = np.sum((one - before) ** 2, -1) <= np.sum((other - before) ** 2, -1)
    return np.where((nearer | locked)[..., None], one, other)


def _given_z(R: NDArray, z: NDArray, before: NDArray) -> NDArray:
    """The triple whose first angle is z, by whole turns nearest to the triple before."""
    c, s = np.cos(z), np.sin(z)
    x = np.arctan2(R[..., 2, 1], c * R[..., 1, 1] - s * R[..., 0, 1])
    y = np.arctan2(c * R[..., 0, 2] + s * R[..., 1, 2], c * R[..., 0, 0] + s * R[..., 1, 0])
    angles = np.stack([z, x, y], -1)
    return angles + 2.0 * np.pi * np.round((before - angles) / (2.0 * np.pi))


def bone_names(body: Body, names: str, path: str | PathLike[str]) -> list[str]:
    """Name of every segment in one of `NAMES`, however spelled, each once; `path` for messages.

    A segment without a counterpart there keeps its own name; without any it raises ExportError, unless for "bvh".
    """
    names = convention(names)
    check_choice("convention of names", names, NAMES, ExportError, file=path)
    if names not in ("kinefit", "bvh") and not body.aliases.get(names):
        known = ", ".join(["kinefit", *(name for name in NAMES if body.aliases.get(name))])
        remedy = f"It has those of: {known}. Or write them into its body file: names = {{ {names} = ... }}."
        raise ExportError(f"body '{body.name}' has no names of {names}", file=path, remedy=remedy)
    return plain_names(body.alias(names, segment) for segment in body.tree.segments)


def convention(names: str) -> str:
    """One of `NAMES`, of a text that spells it in another way: "H-Anim", "OpenSim"; another text as it is."""
    return spelled(names, NAMES)


def length_factor(unit: str, units: Mapping[str, float], path: str | PathLike[str]) -> float:
    """Units of length in a metre; ExportError where the format has no such unit."""
    check_choice("unit of length", unit, units, ExportError, file=path)
    return units[unit]


def turned(motion: Motion, up: str, path: str | PathLike[str], allowed: Iterable[str] = UP_AXES) -> Motion:
    """The motion in a world whose vertical axis is `up`; ExportError where the format has no such axis."""
    check_up(up, path, allowed)
    return motion.turned(up)


def check_up(up: str, path: str | PathLike[str], allowed: Iterable[str] = UP_AXES) -> None:
    """ExportError where a format has no such vertical axis."""
    check_choice("vertical axis of this format", up, allowed, ExportError, file=path)


def plain_names(names: Iterable[str]) -> list[str]:
    """Names without blanks and slashes, each once: a repeated one gets a number."""
    out: list[str] = []
    for name in names:
        base = plain = re.sub(r"[\s/\\]+", "_", name) or "_"
        count = 1
        while plain in out:
            count += 1
            plain = f"{base}_{count}"
        out.append(plain)
    return out
