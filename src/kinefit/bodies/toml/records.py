"""Records of a body file, their mirror images, and the merge of a body file with its base."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import repeated
from kinefit.bodies.morphs.morph_files import MorphRecord
from kinefit.bodies.surfaces.files import SurfaceRecord
from kinefit.bodies.surfaces.skins.skinning import SkinRecord
from kinefit.errors import BodyError

Vector = tuple[float, float, float]


class JointRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`joint` of a segment."""

    name: str
    type: str
    at: Vector = (0.0, 0.0, 0.0)
    axes: list[str | Vector] = []
    coordinates: list[str] = []
    range: list[tuple[float, float]] = []
    usual: list[float] = []
    spread: list[float] = []


class SegmentRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[[segment]]`."""

    name: str
    joint: JointRecord
    parent: str | None = None
    scale: str | None = None
    surface: SurfaceRecord | list[SurfaceRecord] | None = None
    names: dict[str, str] = {}


class CouplingRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[[coupling]]`."""

    name: str
    of: dict[str, float]
    spread: float


class ClosureRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[[closure]]`."""

    name: str
    point: str
    to: str | None = None
    at: str | Vector | None = None
    kind: str = "point"
    axis: str | Vector | None = None
    turn: Vector | None = None
    mode: str = "soft"
    sigma: float | None = None
    turn_sigma: float | None = None
    mean: Vector = (0.0, 0.0, 0.0)
    std: float = 3.0
    turn_std: float = 180.0


class DimensionRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[[dimension]]`."""

    name: str
    value: float | str
    drawn: float
    moves: list[str]
    along: Vector | None = None
    about: Vector | None = None
    mean: float | None = None
    std: float | None = None


_Record = TypeVar("_Record", CouplingRecord, ClosureRecord)


class PointRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A named point on a segment."""

    segment: str
    at: Vector


class HeadRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`[body]`; missing values come from the `base`, if there is one."""

    name: str
    base: str | None = None
    stature: float | None = None
    mass: float | None = None
    mirror: bool | None = None


def size_of(key: str, value: float) -> float:
    """Check a "stature" [m] or "mass" [kg] as stated in a file; 0 if not stated.

    Raises
    ------
    BodyError
        A number that is none.
    """
    most, unit, units = _MAX_SIZES[key]
    if not 0 <= value <= most:
        raise BodyError(f"a {key} of {value:g} {unit}", place=f"body.{key}", remedy=f"Give {units}.")
    return value


_MAX_SIZES = {"stature": (100.0, "m", "metres"), "mass": (1e5, "kg", "kilograms")}  # of machines, too


class MarkerSetRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[markers.SET]`."""

    points: list[str] = []
    placed: dict[str, PointRecord] = {}


class FileRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A body file."""

    body: HeadRecord
    segment: list[SegmentRecord] = []
    usual: dict[str, float] = {}
    coupling: list[CouplingRecord] = []
    closure: list[ClosureRecord] = []
    dimension: list[DimensionRecord] = []
    morph: list[MorphRecord] = []
    skin: SkinRecord | None = None
    landmarks: dict[str, PointRecord] = {}
    keypoints: dict[str, dict[str, str]] = {}
    markers: dict[str, MarkerSetRecord] = {}


def merged(base: FileRecord, own: FileRecord) -> FileRecord:
    """Merge a file into its base: segments and entries of the same name are replaced, all others added."""
    out: dict[str, Any] = {}
    for key in FileRecord.__struct_fields__:
        old, new = getattr(base, key), getattr(own, key)
        if isinstance(new, dict):
            out[key] = old | new
        elif isinstance(new, list) and key != "morph":
            named = {r.name: r for r in new}
            out[key] = [named.pop(r.name, r) for r in old] + list(named.values())
        else:
            out[key] = old + new if isinstance(new, list) else new or old
    stated = {key: value for key, value in msgspec.structs.asdict(own.body).items() if value is not None}
    out["body"] = msgspec.structs.replace(base.body, **stated | {"base": None})
    return FileRecord(**out)


AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
"""Directions by name."""

_FLIPS = dict.fromkeys(("at", "centre", "shift", "start", "end", "side", "axis"), (1.0, 1.0, -1.0))
_FLIPS["turn"] = _FLIPS["tilt"] = (-1.0, -1.0, 1.0)
_NAMES = ("name", "parent", "segment", "angle", "point", "to", "on", "coordinates", "of")


def left(name: str) -> str:
    """Name of the left side for one of the right side; others unchanged."""
    if name.endswith("_r"):
        return name[:-2] + "_l"
    if name.startswith("r_"):
        return "l_" + name[2:]
    return name.replace("Right", "Left")


def mirrored(value: Any, key: str = "") -> Any:
    """A record of the right side as one of the left: names, places and turns; also the value of one of its keys."""
    if isinstance(value, msgspec.Struct):
        new = {name: mirrored(getattr(value, name), name) for name in value.__struct_fields__}
        if isinstance(value, JointRecord):
            new["axes"] = [_mirrored_axis(axis, slides) for axis, slides in zip(*axes_of(value))]
        if isinstance(value, SurfaceRecord):
            new["mirror"] = not value.mirror
        if isinstance(value, ClosureRecord):
            new["at"] = value.at  # in the world
        return msgspec.structs.replace(value, **new)
    if isinstance(value, list):
        return [mirrored(one, key) for one in value]
    if key == "names":
        return {k: left(n) if left(n) != n else re.sub("^r", "l", n) for k, n in value.items()}  # CMU: rfemur
    if isinstance(value, dict):
        return {mirrored(name, key): one for name, one in value.items()}
    if isinstance(value, tuple) and key in _FLIPS:
        return tuple(sign * x for sign, x in zip(_FLIPS[key], value))
    return left(value) if isinstance(value, str) and key in _NAMES else value


def with_images(records: list[_Record]) -> list[_Record]:
    """Records of a file, and after them the images of those of the right side that it does not have itself."""
    there = {r.name for r in records}
    return records + [mirrored(r) for r in records if left(r.name) not in there]


def axes_of(joint: JointRecord) -> tuple[list[str | Vector], list[bool]]:
    """Axes of a joint, and whether it slides along each."""
    if joint.type == "free":
        return list(joint.axes) or ["x", "y", "z", "x", "y", "z"], [True] * 3 + [False] * 3
    return list(joint.axes), [joint.type == "prismatic"] * len(joint.axes)


def direction(axis: str | Vector) -> NDArray | None:
    """Unit vector (3,) of an axis, such as "x" or "-y"; None if it has no direction."""
    sign, name = (-1.0, axis[1:]) if isinstance(axis, str) and axis.startswith("-") else (1.0, axis)
    v = np.array(AXES.get(name, [np.nan] * 3) if isinstance(name, str) else name, float)
    length = float(np.linalg.norm(v))
    return sign * v / length if 1e-9 < length < np.inf else None


def _mirrored_axis(axis: str | Vector, slides: bool) -> str | Vector:
    """Mirror an axis at z = 0: rotations about x and y and slides along z change their sign."""
    named = direction(axis) if isinstance(axis, str) else axis
    if named is None:
        return axis
    x, y, z = named
    return (x, y, -z) if slides else (-x, -y, z)


def refuse_repeated(what: str, names: Iterable[str]) -> None:
    """Raise a BodyError for names that a file gives twice, such as of segments."""
    if twice := repeated(names):
        problem = f"{what} named twice: {', '.join(sorted(twice))}"
        raise BodyError(problem, remedy="Rename one of them.")


_EXTENDS = {
    "MEDIAPIPE_75": "MEDIAPIPE_33", "BODY_25_HANDS": "BODY_25", "COCO_WHOLEBODY_133": "COCO_17", "COCO_18": "COCO_17",
}  # fmt: skip
"""Keypoint sets with hands or a neck, and the sets that they extend."""


def extended(sets: dict[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """Keypoint sets of a file, and the sets that extend them, without hands or neck if the body has none."""
    return sets | {name: sets[of] | sets.get(name, {}) for name, of in _EXTENDS.items() if of in sets}
