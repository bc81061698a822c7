"""Read bodies from TOML: of the catalogue, and from a user's file."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from kinefit._arguments import checked
from kinefit._files import parse_toml, regular, repeated
from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.morphs.morph_files import morphs_of, with_images
from kinefit.bodies.surfaces.files import surfaces_of
from kinefit.bodies.surfaces.skins.skin_files import skin_of
from kinefit.bodies.toml.closures import closed, with_closure_images
from kinefit.bodies.toml.couplings import coupled, with_coupling_images, with_posture
from kinefit.bodies.toml.records import (
    FileRecord,
    JointRecord,
    MarkerSetRecord,
    SegmentRecord,
    Vector,
    extended,
    merged,
    stature_of,
)
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError, check_choice, choices

JOINT_TYPES = {"fixed": 0, "revolute": 1, "prismatic": 1, "universal": 2, "ball": 3, "free": 6}
_AXES = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}
_AXES |= {f"-{name}": [-v for v in axis] for name, axis in _AXES.items()}
_MAX_SEGMENTS = 1000  # and couplings etc.; detailed skeletons have 200, and tables of all pairs grow by the square
_CHOOSE = "Use one of these, or add it."


def read_toml_body(name_or_file: str | Path) -> Body:
    """Body from the catalogue or a TOML file; raises as `load_body` does."""
    return parse_body(*_text(name_or_file))


def _text(name_or_file: str | Path) -> tuple[str, str]:
    """Text of a body file, and its name for messages."""
    path = Path(name_or_file)
    if path.suffix == ".toml":
        try:
            return regular(path).read_text(encoding="utf-8"), str(path)
        except (OSError, ValueError) as error:
            remedy = "Give the path of a text file (UTF-8) in TOML."
            problem = f"cannot read the body file ({getattr(error, 'strerror', None) or error})"
            raise BodyError(problem, file=path, remedy=remedy) from error
    else:
        if str(name_or_file) not in catalogue():
            raise BodyError(
                choices("body in the catalogue named", str(name_or_file), catalogue()),
                remedy="A body file of your own is given by its path, ending in .toml.",
            )
        entry = resources.files("kinefit.bodies") / "catalogue" / f"{name_or_file}.toml"
        return entry.read_text(encoding="utf-8"), f"catalogue body {name_or_file}"


def catalogue() -> tuple[str, ...]:
    """Names of the bodies that come with kinefit."""
    folder = resources.files("kinefit.bodies") / "catalogue"
    return tuple(sorted(e.name[:-5] for e in folder.iterdir() if e.name.endswith(".toml")))


def catalogue_text(name: str) -> str:
    """TOML text of a body of the catalogue, as a template for a user's file.

    Raises
    ------
    BodyError
        Unknown name.
    """
    check_choice("body in the catalogue named", name, catalogue(), BodyError, remedy="Name one of these.")
    return _text(name)[0]


@checked
def parse_body(text: str, source: str = "body") -> Body:
    """Parse a body from TOML text; `source` names it in messages. Raises a BodyError as `load_body` does."""
    record = _record(text, source)
    mirror = bool(record.body.mirror)
    segments = _in_order(_mirrored(record.segment) if mirror else list(record.segment), source)
    points = {n: (p.segment, p.at) for n, p in record.landmarks.items()}
    if mirror:
        mirrored = {_left(n): (_left(p), (x, y, -z)) for n, (p, (x, y, z)) in points.items() if _left(n) != n}
        points |= {n: p for n, p in mirrored.items() if n not in points}
    groups = tuple(dict.fromkeys(s.scale or s.name for s in segments))
    index = {s.name: i for i, s in enumerate(segments)}
    landmarks = _points(points, index, source)
    sets = extended(record.keypoints)
    usual = {**({_left(n): v for n, v in record.usual.items()} if mirror else {}), **record.usual}
    couplings = with_coupling_images(record.coupling, _left) if mirror else record.coupling
    tree = with_posture(coupled(_tree(segments, index, source), couplings, source), usual, source)
    body = Body(
        name=record.body.name,
        tree=tree,
        joints=tuple(s.joint.name for s in segments),
        scale_groups=groups,
        segment_scale=np.array([groups.index(s.scale or s.name) for s in segments]),
        landmarks=landmarks,
        keypoint_sets={n: _renamed(s, landmarks, f"keypoints.{n}", source) for n, s in sets.items()},
        marker_sets={n: _markers(s, landmarks, index, f"markers.{n}", source) for n, s in record.markers.items()},
        surfaces=tuple(
            surface for s in segments
            for surface in surfaces_of(s.surface, index[s.name], source, f"surface of segment {s.name}")
        ),
        aliases={c: {s.name: s.names[c] for s in segments if c in s.names} for c in _conventions(segments)},
        stature=stature_of(record.body.stature or 0.0, source),
        skin=skin_of(record.skin, tree, source),
        morphs=morphs_of(with_images(record.morph, _left) if mirror else record.morph, tree, source),
    )
    if not (record.closure or record.dimension):
        return body
    closures = with_closure_images(record.closure, _left) if mirror else record.closure
    return closed(body, closures, record.dimension, source)


def _record(text: str, source: str, above: tuple[str, ...] = ()) -> FileRecord:
    """Record of a body file, merged with its base."""
    try:
        record = msgspec.convert(parse_toml(text, source, BodyError), FileRecord)
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$")
        where, remedy = place.strip(".`") or None, "See docs/bodies.md for its keys."
        raise BodyError(f"not a body file: {problem}", file=source, place=where, remedy=remedy) from error
    most = max(len(record.segment), len(record.coupling), len(record.closure), len(record.dimension))
    if most > _MAX_SEGMENTS:
        problem = f"{most} segments, couplings, closures or dimensions, more than {_MAX_SEGMENTS}"
        raise BodyError(problem, file=source, remedy="Merge segments that do not move on their own.")
    base = record.body.base
    if base is None:
        return record
    if base in above:
        problem = f"`base` entries form a cycle: {', '.join((*above, base))}"
        raise BodyError(problem, file=source, place="body.base", remedy="Remove one.")
    try:
        below, file = _text(base if not base.endswith(".toml") else Path(source).parent / base)
    except BodyError as error:
        raise BodyError(error.problem, file=source, place="body.base", remedy=error.remedy) from error
    return merged(_record(below, file, (*above, base)), record)


def _left(name: str) -> str:
    if name.endswith("_r"):
        return name[:-2] + "_l"
    if name.startswith("r_"):
        return "l_" + name[2:]
    return name.replace("Right", "Left")


def _mirrored(segments: list[SegmentRecord]) -> list[SegmentRecord]:
    out = []
    for s in segments:
        out.append(s)
        if not s.name.endswith("_r"):
            continue
        axes = [_mirrored_axis(axis, slides) for axis, slides in zip(*_axes(s.joint))]
        x, y, z = s.joint.at
        joint = msgspec.structs.replace(
            s.joint,
            name=_left(s.joint.name),
            at=(x, y, -z),
            axes=axes,
            coordinates=[_left(c) for c in s.joint.coordinates],
        )
        other = [r.mirrored() for r in s.surface] if isinstance(s.surface, list) else s.surface and s.surface.mirrored()
        names = {k: _left(n) if _left(n) != n else re.sub("^r", "l", n) for k, n in s.names.items()}  # CMU: rfemur
        parent = _left(s.parent) if s.parent else None
        out.append(
            msgspec.structs.replace(s, name=_left(s.name), parent=parent, joint=joint, surface=other, names=names)
        )
    return out


def _axes(joint: JointRecord) -> tuple[list[str | Vector], list[bool]]:
    """Axes of a joint, and whether it slides along each."""
    if joint.type == "free":
        return list(joint.axes) or ["x", "y", "z", "x", "y", "z"], [True] * 3 + [False] * 3
    return list(joint.axes), [joint.type == "prismatic"] * len(joint.axes)


def _mirrored_axis(axis: str | Vector, slides: bool) -> str | Vector:
    """Mirror an axis at z = 0: rotations about x and y and slides along z change their sign."""
    if isinstance(axis, str) and axis not in _AXES:
        return axis
    x, y, z = _AXES[axis] if isinstance(axis, str) else axis
    return (x, y, -z) if slides else (-x, -y, z)


def _in_order(segments: list[SegmentRecord], source: str) -> list[SegmentRecord]:
    """Sort segments depth first from the root: parents before children, limbs contiguous."""
    children: dict[str | None, list[SegmentRecord]] = {s.name: [] for s in segments}
    _refuse_repeated("segment", [s.name for s in segments], source)
    _refuse_repeated("joint", [s.joint.name for s in segments], source)
    roots = [s for s in segments if s.parent is None]
    if len(roots) != 1:
        found = ", ".join(s.name for s in roots) or "none"
        problem = f"a body has exactly one segment without a parent, here: {found}"
        raise BodyError(problem, file=source, remedy="Give the others a parent.")
    for s in segments:
        if s.parent is not None and s.parent not in children:
            place = f"parent of segment {s.name}"
            raise BodyError(choices("segment", s.parent, children), file=source, place=place, remedy=_CHOOSE)
        children.setdefault(s.parent, []).append(s)
    out: list[SegmentRecord] = []
    stack = [roots[0]]
    while stack:
        s = stack.pop()
        out.append(s)
        stack += reversed(children[s.name])
    if len(out) != len(segments):
        placed = {s.name for s in out}
        lost = ", ".join(s.name for s in segments if s.name not in placed)
        remedy = "Every chain of parents must end at the root."
        raise BodyError(f"the segments {lost} form a cycle", file=source, remedy=remedy)
    return out


def _refuse_repeated(what: str, names: list[str], source: str) -> None:
    if twice := repeated(names):
        problem = f"{what} named twice: {', '.join(sorted(twice))}"
        raise BodyError(problem, file=source, remedy="Rename one of them.")


def _tree(segments: list[SegmentRecord], index: dict[str, int], source: str) -> KinematicTree:
    names: list[str] = []
    rows: list[tuple[int, Any, bool, float, float, float, float]] = []
    for i, s in enumerate(segments):
        j, place = s.joint, f"joint {s.joint.name}"
        check_choice("joint type", j.type, JOINT_TYPES, BodyError, file=source, place=place, remedy="Use one of these.")
        if i == 0 and any(j.at):
            raise BodyError(
                "the root's joint is the origin of the body", file=source, place=place, remedy="Remove `at`."
            )
        _finite(j.at, source, place)
        if j.type == "free" and i == 0:
            continue
        axes, slides = _axes(j)
        count = JOINT_TYPES[j.type]
        coordinates = j.coordinates or ([j.name] if count == 1 else [f"{j.name}_{k + 1}" for k in range(count)])
        if len(axes) != count or len(coordinates) != count or {len(j.range), len(j.usual), len(j.spread)} - {0, count}:
            raise BodyError(
                f"a {j.type} joint has {count} axes, coordinates and, if any, ranges, usuals and spreads; "
                f"here {len(axes)}, {len(coordinates)}, {len(j.range)}, {len(j.usual)} and {len(j.spread)}",
                file=source,
                place=place,
                remedy="Give each of these lists one entry for each axis.",
            )
        for k in range(count):
            named = axes[k]
            axis = np.array(_AXES.get(named, [np.nan] * 3) if isinstance(named, str) else named, float)
            norm = np.linalg.norm(axis)
            if not 1e-9 < norm < np.inf:
                raise BodyError(
                    f"axis {axes[k]!r} of {coordinates[k]} has no direction",
                    file=source,
                    place=place,
                    remedy='Use "x", "-y", ... or three numbers that are not all zero.',
                )
            low, high = j.range[k] if j.range else (-np.inf, np.inf)
            if not low <= high:
                problem = f"range [{low}, {high}] of {coordinates[k]} is empty"
                raise BodyError(problem, file=source, place=place, remedy="Give the lower end first.")
            spread = j.spread[k] if j.spread else max(0.5 * (high - low), 1e-3)
            if not spread > 0:
                problem = f"spread {spread} of {coordinates[k]} is not positive"
                raise BodyError(problem, file=source, place=place, remedy="Give inf for no prior.")
            usual = j.usual[k] if j.usual else min(max(0.0, low), high)
            if not (low <= usual <= high and np.isfinite(usual)):
                problem = f"usual {usual} of {coordinates[k]} is out of its range"
                raise BodyError(problem, file=source, place=place, remedy=f"Give a number from {low} to {high}.")
            unit = 1.0 if slides[k] else np.pi / 180.0
            names.append(coordinates[k])
            rows.append((i, axis / norm, slides[k], low * unit, high * unit, usual * unit, spread * unit))
    _refuse_repeated("coordinate", names, source)
    return KinematicTree(
        segments=tuple(s.name for s in segments),
        parents=np.array([index[s.parent] if s.parent else -1 for s in segments]),
        offsets=np.array([s.joint.at if s.parent else (0.0, 0.0, 0.0) for s in segments]),
        coordinates=tuple(names),
        owners=np.array([r[0] for r in rows], np.int64),
        axes=np.array([r[1] for r in rows]),
        prismatic=np.array([r[2] for r in rows], bool),
        lower=np.array([r[3] for r in rows]),
        upper=np.array([r[4] for r in rows]),
        usual=np.array([r[5] for r in rows]),
        spread=np.array([r[6] for r in rows]),
        root_free=segments[0].joint.type == "free",
    )


def _finite(at: Vector, source: str, place: str) -> None:
    if not np.all(np.isfinite(at)):
        problem = f"`at` is not finite: {list(at)}"
        raise BodyError(problem, file=source, place=place, remedy="Give three numbers in metres.")


def _points(
    points: dict[str, tuple[str, Vector]], index: dict[str, int], source: str, what: str = "landmark "
) -> PointSet:
    for name, (segment, at) in points.items():
        check_choice("segment", segment, index, BodyError, file=source, place=what + name, remedy=_CHOOSE)
        _finite(at, source, what + name)
    return PointSet(
        tuple(points), np.array([index[s] for s, _ in points.values()]), np.array([a for _, a in points.values()])
    )


def _renamed(entries: dict[str, str], landmarks: PointSet, place: str, source: str) -> PointSet:
    known = set(landmarks.names)
    for name, landmark in entries.items():
        if landmark not in known:
            problem = choices("landmark", landmark, landmarks.names)
            raise BodyError(problem, file=source, place=f"{place}.{name}", remedy=_CHOOSE)
    chosen = landmarks.select(tuple(entries.values()))
    return PointSet(tuple(entries), chosen.segments, chosen.points)


def _markers(entry: MarkerSetRecord, landmarks: PointSet, index: dict[str, int], place: str, source: str) -> PointSet:
    on_landmarks = _renamed({n: n for n in entry.points}, landmarks, place, source)
    placed = _points({n: (p.segment, p.at) for n, p in entry.placed.items()}, index, source, f"{place}.")
    twice = sorted(entry.placed.keys() & set(entry.points))
    if twice:
        problem = f"marker named twice: {', '.join(twice)}"
        raise BodyError(problem, file=source, place=place, remedy="Keep it in points or in placed.")
    return PointSet(
        on_landmarks.names + placed.names,
        np.concatenate([on_landmarks.segments, placed.segments]),
        np.concatenate([on_landmarks.points, placed.points]),
    )


def _conventions(segments: list[SegmentRecord]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(c for s in segments for c in s.names))
