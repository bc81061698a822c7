"""Read bodies from TOML: of the catalogue, and from a user's file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import parse_toml, read_text, record_of
from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.morphs.morph_files import morphs_of
from kinefit.bodies.parts import with_dimensions
from kinefit.bodies.surfaces.files import surfaces_of
from kinefit.bodies.surfaces.skins.skinning import skin_of
from kinefit.bodies.toml import records as tables
from kinefit.bodies.tree import COLUMNS, KINDS, Closure, Dimension, KinematicTree
from kinefit.errors import BodyError, check_choice, choices, located

JOINT_TYPES = {"fixed": 0, "revolute": 1, "prismatic": 1, "universal": 2, "ball": 3, "free": 6}
_MAX_SEGMENTS = 1000  # and couplings etc.; detailed skeletons have 200, and tables of all pairs grow by the square
_CHOOSE = "Use one of these, or add it."


def read_toml_body(name_or_file: str | Path) -> Body:
    """Body from the catalogue or a TOML file; raises as `load_body` does."""
    return parse_body(*_text(name_or_file))


def _text(name_or_file: str | Path) -> tuple[str, str]:
    """Text of a body file, and its name for messages."""
    path = Path(name_or_file)
    if path.suffix == ".toml":
        remedy = "Give the path of a text file (UTF-8) in TOML."
        return read_text(path, "the body file", remedy=remedy, error=BodyError), str(path)
    name, remedy = str(name_or_file), "A body file of your own is given by its path, ending in .toml."
    check_choice("body in the catalogue named", name, catalogue(), BodyError, remedy=remedy)
    entry = resources.files("kinefit.bodies.toml") / "catalogue" / f"{name}.toml"
    return entry.read_text(encoding="utf-8"), f"catalogue body {name}"


def catalogue() -> tuple[str, ...]:
    """Names of the bodies that come with kinefit."""
    folder = resources.files("kinefit.bodies.toml") / "catalogue"
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
    with located(source):
        return _body(_record(text, source), source)


def _body(record: tables.FileRecord, source: str) -> Body:
    segments, points, usual, coupling, morph, closure = (
        record.segment, record.landmarks, record.usual, record.coupling, record.morph, record.closure
    )  # fmt: skip
    if record.body.mirror:
        segments = _with_mirror_images(segments, lambda s: s.name.endswith("_r"))
        others = {tables.left(n): tables.mirrored(p) for n, p in points.items()}
        points = points | {n: p for n, p in others.items() if n not in points}
        usual = {tables.left(n): v for n, v in usual.items()} | usual
        coupling, closure = tables.with_images(coupling), tables.with_images(closure)
        morph = _with_mirror_images(morph, lambda m: m.kind != "global" and tables.left(m.angle) != m.angle)
    segments = _in_order(segments)
    groups = tuple(dict.fromkeys(s.scale or s.name for s in segments))
    index = {s.name: i for i, s in enumerate(segments)}
    landmarks = _points(points, index)
    tree = _with_posture(_coupled(_tree(segments, index), coupling), usual)
    body = Body(
        name=record.body.name,
        tree=tree,
        joints=tuple(s.joint.name for s in segments),
        scale_groups=groups,
        segment_scale=np.array([groups.index(s.scale or s.name) for s in segments]),
        landmarks=landmarks,
        keypoint_sets={
            n: _renamed(s, landmarks, f"keypoints.{n}") for n, s in tables.extended(record.keypoints).items()
        },
        marker_sets={n: _markers(s, landmarks, index, f"markers.{n}") for n, s in record.markers.items()},
        surfaces=tuple(
            surface for s in segments
            for surface in surfaces_of(s.surface, index[s.name], source, f"surface of segment {s.name}")
        ),
        aliases={
            c: {s.name: s.names[c] for s in segments if c in s.names}
            for c in dict.fromkeys(c for s in segments for c in s.names)
        },
        stature=tables.size_of("stature", record.body.stature or 0.0),
        mass=tables.size_of("mass", record.body.mass or 0.0),
        skin=skin_of(record.skin, tree, source),
        morphs=morphs_of(morph, tree, source),
    )  # fmt: skip
    return closed(body, closure, record.dimension) if closure or record.dimension else body


def _record(text: str, source: str, above: tuple[str, ...] = ()) -> tables.FileRecord:
    """Record of a body file, merged with its base."""
    remedy = "See docs/bodies.md for its keys."
    record = record_of(parse_toml(text, source, BodyError), tables.FileRecord, "a body file", source, remedy, BodyError)
    most = max(len(record.segment), len(record.coupling), len(record.closure), len(record.dimension))
    if most > _MAX_SEGMENTS:
        problem = f"{most} segments, couplings, closures or dimensions, more than {_MAX_SEGMENTS}"
        raise BodyError(problem, remedy="Merge segments that do not move on their own.")
    base = record.body.base
    if base is None:
        return record
    if base in above:
        problem = f"`base` entries form a cycle: {', '.join((*above, base))}"
        raise BodyError(problem, place="body.base", remedy="Remove one.")
    try:
        below, file = _text(base if not base.endswith(".toml") else Path(source).parent / base)
    except BodyError as error:
        raise BodyError(error.problem, place="body.base", remedy=error.remedy) from error
    with located(file):
        return tables.merged(_record(below, file, (*above, base)), record)


def _with_mirror_images(records: Iterable[Any], sided: Callable[[Any], bool]) -> list[Any]:
    """Records, and after each of the right side its mirror image."""
    return [one for r in records for one in ((r, tables.mirrored(r)) if sided(r) else (r,))]


def _in_order(segments: list[tables.SegmentRecord]) -> list[tables.SegmentRecord]:
    """Sort segments depth first from the root: parents before children, limbs contiguous."""
    children: dict[str | None, list[tables.SegmentRecord]] = {s.name: [] for s in segments}
    tables.refuse_repeated("segment", [s.name for s in segments])
    tables.refuse_repeated("joint", [s.joint.name for s in segments])
    roots = [s for s in segments if s.parent is None]
    if len(roots) != 1:
        found = ", ".join(s.name for s in roots) or "none"
        problem = f"a body has exactly one segment without a parent, here: {found}"
        raise BodyError(problem, remedy="Give the others a parent.")
    for s in segments:
        if s.parent is not None and s.parent not in children:
            place = f"parent of segment {s.name}"
            raise BodyError(choices("segment", s.parent, children), place=place, remedy=_CHOOSE)
        children.setdefault(s.parent, []).append(s)
    out: list[tables.SegmentRecord] = []
    stack = [roots[0]]
    while stack:
        s = stack.pop()
        out.append(s)
        stack += reversed(children[s.name])
    if len(out) != len(segments):
        placed = {s.name for s in out}
        lost = ", ".join(s.name for s in segments if s.name not in placed)
        remedy = "Every chain of parents must end at the root."
        raise BodyError(f"the segments {lost} form a cycle", remedy=remedy)
    return out


def _tree(segments: list[tables.SegmentRecord], index: dict[str, int]) -> KinematicTree:
    rows: list[tuple[Any, ...]] = []
    for i, s in enumerate(segments):
        with located(None, f"joint {s.joint.name}"):
            rows += _coordinates(i, s.joint)
    names = ("coordinates", "owners", *COLUMNS)
    columns = dict(zip(names, zip(*rows) if rows else [()] * len(names)))
    tables.refuse_repeated("coordinate", columns["coordinates"])
    return KinematicTree(
        segments=tuple(index),
        parents=np.array([index[s.parent] if s.parent else -1 for s in segments]),
        offsets=np.array([s.joint.at for s in segments]),
        root_free=segments[0].joint.type == "free",
        **columns,  # type: ignore[arg-type]
    )


def _coordinates(owner: int, j: tables.JointRecord) -> Iterator[tuple[Any, ...]]:
    """Name, owner, axis, whether it slides, lower, upper, usual and spread of each coordinate of a joint."""
    check_choice("joint type", j.type, JOINT_TYPES, BodyError, remedy="Use one of these.")
    if owner == 0 and any(j.at):
        raise BodyError("the root's joint is the origin of the body", remedy="Remove `at`.")
    _check_finite(j.at)
    if j.type == "free" and owner == 0:
        return
    axes, slides = tables.axes_of(j)
    count = JOINT_TYPES[j.type]
    coordinates = j.coordinates or ([j.name] if count == 1 else [f"{j.name}_{k + 1}" for k in range(count)])
    if len(axes) != count or len(coordinates) != count or {len(j.range), len(j.usual), len(j.spread)} - {0, count}:
        problem = f"a {j.type} joint has {count} axes, coordinates and, if any, ranges, usuals and spreads; "
        problem += f"here {len(axes)}, {len(coordinates)}, {len(j.range)}, {len(j.usual)} and {len(j.spread)}"
        raise BodyError(problem, remedy="Give each of these lists one entry for each axis.")
    for k, name in enumerate(coordinates):
        axis = tables.direction(axes[k])
        if axis is None:
            remedy = 'Use "x", "-y", ... or three numbers that are not all zero.'
            raise BodyError(f"axis {axes[k]!r} of {name} has no direction", remedy=remedy)
        low, high = j.range[k] if j.range else (-np.inf, np.inf)
        if not low <= high:
            raise BodyError(f"range [{low}, {high}] of {name} is empty", remedy="Give the lower end first.")
        spread = j.spread[k] if j.spread else max(0.5 * (high - low), 1e-3)
        if not spread > 0:
            raise BodyError(f"spread {spread} of {name} is not positive", remedy="Give inf for no prior.")
        usual = j.usual[k] if j.usual else min(max(0.0, low), high)
        if not (low <= usual <= high and np.isfinite(usual)):
            remedy = f"Give a number from {low} to {high}."
            raise BodyError(f"usual {usual} of {name} is out of its range", remedy=remedy)
        unit = 1.0 if slides[k] else np.pi / 180.0
        yield name, owner, axis, slides[k], low * unit, high * unit, usual * unit, spread * unit


def _coupled(tree: KinematicTree, couplings: Sequence[tables.CouplingRecord]) -> KinematicTree:
    """Add the couplings of a file to a tree; weights have no unit, spreads are in degrees."""
    lines = np.zeros((len(couplings), len(tree.coordinates)))
    for line, c in zip(lines, couplings):
        with located(None, f"coupling {c.name}"):
            for name, weight in c.of.items():
                check_choice("coordinate", name, tree.coordinates, BodyError, remedy="Use one of these.")
                line[tree.coordinate(name)] = weight
            if not (np.isfinite(line).all() and line.any() and 0.0 < c.spread < np.inf):
                problem = f"spread {c.spread}, weights {list(c.of.values())}"
                raise BodyError(problem, remedy="Give a positive spread, weights other than 0.")
            if tree.prismatic[line != 0.0].any():
                raise BodyError("it couples a coordinate that slides", remedy="Couple angles.")
        line /= np.radians(c.spread)
    with located(None, "coupling"):
        return replace(tree, couplings=lines)


def _with_posture(tree: KinematicTree, usual: Mapping[str, float]) -> KinematicTree:
    """Change the mean posture of a tree: values [deg] or [m] of some coordinates."""
    out = np.array(tree.usual)
    for name, value in usual.items():
        with located(None, f"usual {name}"):
            check_choice("coordinate", name, tree.coordinates, BodyError, remedy="Use one of these.")
            d = tree.coordinate(name)
            unit = 1.0 if tree.prismatic[d] else np.pi / 180.0
            if not (np.isfinite(value) and tree.lower[d] <= value * unit <= tree.upper[d]):
                ends = f"{tree.lower[d] / unit:g} to {tree.upper[d] / unit:g}"
                raise BodyError(f"{value:g} is out of its range", remedy=f"Give {ends}.")
            out[d] = value * unit
    return replace(tree, usual=out)


def _check_finite(at: tables.Vector) -> None:
    if not np.isfinite(at).all():
        raise BodyError(f"`at` is not finite: {list(at)}", remedy="Give three numbers in metres.")


def _points(points: Mapping[str, tables.PointRecord], index: dict[str, int], what: str = "landmark ") -> PointSet:
    for name, p in points.items():
        with located(None, what + name):
            check_choice("segment", p.segment, index, BodyError, remedy=_CHOOSE)
            _check_finite(p.at)
    records = points.values()
    return PointSet(tuple(points), np.array([index[p.segment] for p in records]), np.array([p.at for p in records]))


def _renamed(entries: dict[str, str], landmarks: PointSet, place: str) -> PointSet:
    known = set(landmarks.names)
    for name, landmark in entries.items():
        if landmark not in known:
            problem = choices("landmark", landmark, landmarks.names)
            raise BodyError(problem, place=f"{place}.{name}", remedy=_CHOOSE)
    return replace(landmarks.select(tuple(entries.values())), names=tuple(entries))


def _markers(entry: tables.MarkerSetRecord, landmarks: PointSet, index: dict[str, int], place: str) -> PointSet:
    on_landmarks = _renamed({n: n for n in entry.points}, landmarks, place)
    placed = _points(entry.placed, index, f"{place}.")
    if twice := sorted(entry.placed.keys() & set(entry.points)):
        problem = f"marker named twice: {', '.join(twice)}"
        raise BodyError(problem, place=place, remedy="Keep it in points or in placed.")
    return PointSet(
        on_landmarks.names + placed.names,
        np.concatenate([on_landmarks.segments, placed.segments]),
        np.concatenate([on_landmarks.points, placed.points]),
    )


ESTIMATE = "estimate"
_MAX_DIMENSION = 1e4  # [m] or [deg]
_ZERO_VECTOR = (0.0, 0.0, 0.0)


def closed(body: Body, closures: Sequence[tables.ClosureRecord], dimensions: Sequence[tables.DimensionRecord]) -> Body:
    """Add the closures and dimensions of a file to a body.

    Raises
    ------
    BodyError
        A duplicate name; an unknown point, segment or kind; a closure of a segment with itself; a standard deviation
        that is not positive; missing or contradictory keys.
    """
    if body.morphs:
        problem = "closures of a body whose joints or surfaces morph"
        raise BodyError(problem, place="closure", remedy="Remove the morphs, or the closures.")
    tables.refuse_repeated("closure", [c.name for c in closures])
    tables.refuse_repeated("dimension", [d.name for d in dimensions])
    made, drawn, wanted = list[Closure](), list[Dimension](), dict[str, float]()
    for c in closures:
        with located(None, f"closure {c.name}"):
            made.append(_closure(body, c))
    body = replace(body, closures=tuple(made))
    for r in dimensions:
        with located(None, f"dimension {r.name}"):
            d, wanted[r.name] = _dimension(body, r)
        drawn.append(d)
    return with_dimensions(replace(body, dimensions=tuple(drawn)), wanted)


def _check(good: bool, problem: str, remedy: str) -> None:
    if not good:
        raise BodyError(problem, remedy=remedy)


def _closure(body: Body, r: tables.ClosureRecord) -> Closure:
    names, segments = body.landmarks.names, body.landmarks.segments
    for point in (r.point, r.point if r.to is None else r.to):
        check_choice("landmark", point, names, BodyError, remedy="Use one of these, or add it under [landmarks].")
    check_choice("kind of closure", r.kind, KINDS, BodyError, remedy="Use one of these.")
    check_choice("mode", r.mode, ("soft", "hard"), BodyError, remedy="Use one of these.")
    one = (r.to is None) != (r.at is None)
    _check(one, "`to` and `at`: one of them is needed", "Give `to` a landmark, or `at` a place in the world.")
    unknown = r.at == ESTIMATE
    at = r.mean if unknown else (r.at or _ZERO_VECTOR)
    if isinstance(at, str):
        raise BodyError(f"at = {at!r}", remedy='Give three numbers in metres, or "estimate".')
    wanted = (r.kind in ("line", "plane")) == (r.axis is not None)
    _check(wanted, f"a {r.kind} closure with axis {r.axis}", "Give an axis to lines and planes, and to no other.")
    turned = r.turn is None or r.kind == "rigid"
    _check(turned, f"a {r.kind} closure with a turn", "Remove it: only rigid closures constrain rotation.")
    free = r.mode == "soft" or (r.sigma is None and r.turn_sigma is None)
    _check(free, "a hard closure cannot have a standard deviation", 'Remove it, or set mode = "soft".')
    sigma = Closure.sigma if r.sigma is None else r.sigma
    sigmas = (sigma, 2.0 if r.turn_sigma is None else r.turn_sigma, r.std, r.turn_std)
    _check(all(0.0 < s < np.inf for s in sigmas), f"standard deviations {sigmas}", "Give positive ones.")
    apart = r.to is None or segments[names.index(r.to)] != segments[names.index(r.point)]
    _check(apart, f"'{r.point}' and '{r.to}' are of one segment", "Close the chain between two segments.")
    axis = tables.direction("y" if r.axis is None else r.axis)
    if axis is None:
        remedy = 'Use "x", "y", "z", or three numbers that are not all zero.'
        raise BodyError(f"axis {r.axis!r} is no direction", remedy=remedy)
    _check(bool(np.isfinite([*at, *(r.turn or ())]).all()), "numbers that are not finite", "Give metres and degrees.")
    turn, turn_sigma, turn_std = np.radians(r.turn or _ZERO_VECTOR), np.radians(sigmas[1]), np.radians(r.turn_std)
    return Closure(
        r.name, r.kind, r.point, r.to or "", at, _vector(axis), _vector(turn), sigma, float(turn_sigma),
        r.mode == "hard", r.std if unknown else 0.0, float(turn_std) if unknown and r.kind == "rigid" else 0.0,
    )  # fmt: skip


def _vector(v: NDArray) -> tables.Vector:
    return (float(v[0]), float(v[1]), float(v[2]))


def _dimension(body: Body, r: tables.DimensionRecord) -> tuple[Dimension, float]:
    """A dimension at its drawn value, and its actual value [m] or [rad]."""
    one = (r.along is None) != (r.about is None)
    _check(one, "`along` and `about`: one of them is needed", "Give `along` for a length, `about` for an angle.")
    mean = r.drawn if r.mean is None else r.mean
    estimated = r.value == ESTIMATE
    value = mean if estimated else r.value
    if isinstance(value, str):
        raise BodyError(f"value = {value!r}", remedy='Give a number, or "estimate".')
    std = r.std or 0.0
    if estimated:
        problem = f"a value to estimate with std = {r.std}"
        _check(0.0 < std < np.inf, problem, "Give `std`, its standard deviation about `mean`.")
    closures = {c.name: c for c in body.closures}
    _check(bool(r.moves), "it moves nothing", "Name landmarks, segments or closures in `moves`.")
    for name in r.moves:
        closure = closures.get(name)
        meanings = (closure is not None) + (name in body.landmarks.names) + (name in body.tree.segments)
        problem = f"'{name}' is " + ("a name with several meanings" if meanings else "nothing of the body")
        _check(meanings == 1, problem, "Name landmarks, segments or closures of this body.")
        rigid = r.about is None or (closure is not None and closure.kind == "rigid")
        _check(rigid, f"an angle that moves '{name}'", "Angles turn rigid closures, and nothing else.")
        placed = r.along is None or closure is None or not closure.to
        _check(placed, f"it shifts closure '{name}' between two landmarks", "Name one of the landmarks.")
    fits = np.abs([r.drawn, mean, value, *(r.along or r.about or ())]) < _MAX_DIMENSION
    _check(bool(fits.all()), "numbers are not finite, or not a dimension", "Give metres and degrees.")
    axis = np.zeros(3) if r.about is None else tables.direction(r.about)
    if axis is None:
        raise BodyError("`about` is no direction", remedy="Give three numbers that are not all zero.")
    unit = 1.0 if r.about is None else np.pi / 180.0
    std = std * unit if estimated else 0.0
    return Dimension(r.name, r.drawn * unit, r.along or _ZERO_VECTOR, _vector(axis), tuple(r.moves), std), value * unit
