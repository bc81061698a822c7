"""Read and write `[[morph]]` of a body file: shape changes that depend on angles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from kinefit.bodies.morphs.operators import GlobalMorph, JointMotion, LocalMorph, Operator, SegmentMorph
from kinefit.bodies.morphs.steering import Steering
from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.files import SurfaceRecord, surfaces_of
from kinefit.bodies.surfaces.obj import UNITS, read_obj
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError, check_choice, located
from kinefit.geometry import se3

Vector = tuple[float, float, float]
KINDS = {
    "joint": ({"segment"}, {"shift", "turn"}),  # required and optional keys
    "local": ({"segment", "centre", "radii", "shift"}, {"on", "moves"}),
    "surface": ({"segment", "surface"}, set[str]()),
    "global": ({"target"}, {"unit"}),
}
_COMMON = {"kind", "angle", "start", "end", "weight", "beyond"}


class MorphRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One `[[morph]]`: the change, and the angle that controls it from `start` to `end`."""

    kind: str
    angle: str
    start: float
    end: float
    weight: str | list[tuple[float, float]] = "linear"
    beyond: bool = False
    segment: str | None = None
    shift: Vector | None = None
    turn: Vector | None = None
    centre: Vector | None = None
    radii: Vector | None = None
    on: list[str] | None = None
    moves: bool | None = None
    surface: SurfaceRecord | list[SurfaceRecord] | None = None
    target: str | None = None
    unit: str | None = None

    @property
    def place(self) -> str:
        """Description of the entry, for messages."""
        return f"{self.kind} morph of {self.segment or self.target or 'the surface'} by {self.angle}"

    def mirrored(self, name: Callable[[str], str]) -> MorphRecord:
        """Mirror the morph to the other side of the body; `name` maps a right name to the left one."""
        flip = lambda v, signs: None if v is None else tuple(s * x for s, x in zip(signs, v))
        surface = self.surface
        other = [r.mirrored() for r in surface] if isinstance(surface, list) else surface and surface.mirrored()
        return msgspec.structs.replace(
            self,
            angle=name(self.angle),
            segment=self.segment and name(self.segment),
            shift=flip(self.shift, (1.0, 1.0, -1.0)),
            turn=flip(self.turn, (-1.0, -1.0, 1.0)),
            centre=flip(self.centre, (1.0, 1.0, -1.0)),
            on=self.on and [name(n) for n in self.on],
            surface=other,
        )


def with_images(records: Sequence[MorphRecord], name: Callable[[str], str]) -> list[MorphRecord]:
    """Records, and the mirror image of each that depends on an angle of the right side; not of global ones."""
    out = []
    for record in records:
        out.append(record)
        if name(record.angle) != record.angle and record.kind != "global":
            out.append(record.mirrored(name))
    return out


def morphs_of(records: Sequence[MorphRecord], tree: KinematicTree, source: str) -> tuple[Operator, ...]:
    """Operators of a body from its records.

    Raises
    ------
    BodyError
        An unknown kind, angle, segment or weighting, unknown or missing keys, two equal angles, a target that cannot be
        read.
    """
    out = []
    for record in records:
        with located(source, record.place):
            out.append(_morph(record, tree, source))
    return tuple(out)


def _morph(record: MorphRecord, tree: KinematicTree, source: str) -> Operator:
    _check_keys(record)
    check_choice("angle", record.angle, tree.coordinates, BodyError, remedy="Use one of these.")
    for name in [*([] if record.segment is None else [record.segment]), *(record.on or [])]:
        check_choice("segment", name, tree.segments, BodyError, remedy="Use one of these, or add it.")
    for what, value in (("shift", record.shift), ("turn", record.turn), ("centre", record.centre)):
        if value is not None and not np.isfinite(value).all():
            raise BodyError(f"`{what}` is not finite: {list(value)}", remedy="Give three numbers.")
    degrees = 1.0 if tree.prismatic[tree.coordinate(record.angle)] else math.pi / 180.0
    start, end = record.start * degrees, record.end * degrees
    steering = Steering(record.angle, start, end, record.weight, record.beyond)
    if record.kind == "joint":
        assert record.segment
        return _joint_motion(record, record.segment, tree, steering)
    if record.kind == "local":
        assert record.centre and record.radii and record.shift
        if not all(radius > 0.0 for radius in record.radii):
            raise BodyError(f"radii {list(record.radii)} of a bulge", remedy="Give positive ones; inf is no limit.")
        placed = np.array(record.centre), np.array(record.radii), np.array(record.shift)
        return LocalMorph(*placed, steering, record.segment, tuple(record.on or ()), bool(record.moves))
    if record.kind == "surface":
        assert record.segment
        surfaces = surfaces_of(record.surface, tree.segment(record.segment), source, "surface")
        return SegmentMorph(record.segment, tuple(surfaces), steering)
    unit = record.unit or "m"
    check_choice("unit", unit, UNITS, BodyError, remedy="Use one of these.")
    vertices, _ = read_obj(Path(source).parent / str(record.target))
    return GlobalMorph(UNITS[unit] * vertices, steering)


def _check_keys(record: MorphRecord) -> None:
    check_choice("kind of morph", record.kind, KINDS, BodyError, remedy="Use one of these.")
    needed, allowed = KINDS[record.kind]
    given = {name for name in record.__struct_fields__ if getattr(record, name) is not None} - _COMMON
    if missing := needed - given:
        problem = f"a {record.kind} morph without {', '.join(sorted(missing))}"
        raise BodyError(problem, remedy="See docs/morphing.md for its keys.")
    if unexpected := given - needed - allowed:
        problem = f"a {record.kind} morph has no {', '.join(sorted(unexpected))}"
        raise BodyError(problem, remedy=f"It has {', '.join(sorted(needed | allowed))}.")
    if record.kind == "joint" and not given & {"shift", "turn"}:
        raise BodyError("a joint morph that moves nothing", remedy="Give `shift` [m], `turn` [deg] or both.")


def _joint_motion(record: MorphRecord, segment: str, tree: KinematicTree, steering: Steering) -> JointMotion:
    """One screw motion from a shift [m] and a rotation [deg] about the joint."""
    s = tree.segment(segment)
    if s == 0:
        raise BodyError("the root has no joint that could move", remedy="Name a segment that has a joint.")
    R = se3.exp_so3(np.radians(record.turn or (0.0, 0.0, 0.0)))
    xi = se3.log(se3.transform(R, np.array(record.shift or (0.0, 0.0, 0.0))))
    return JointMotion(segment, se3.adjoint(se3.transform(np.eye(3), tree.rest[s])) @ xi, steering)


def format_morphs(morphs: Sequence[Operator], tree: KinematicTree) -> str:
    """Format morphs as `[[morph]]` entries of a body file; empty without morphs.

    Raises
    ------
    BodyError
        A weighting by a function, or a target of nodes or meshes, which a file cannot contain.
    """
    return "\n".join(_entry(morph, tree) for morph in morphs)


def _entry(morph: Operator, tree: KinematicTree) -> str:
    s = morph.steering
    degrees = 1.0 if tree.prismatic[tree.coordinate(s.coordinate)] else 180.0 / math.pi
    if callable(s.weight):
        raise BodyError("a file cannot hold a weighting by a function", remedy="Give a table of t and ω.")
    weight = f'"{s.weight}"' if isinstance(s.weight, str) else _numbers(s.weight)
    lines = [f'angle = "{s.coordinate}"', f"start = {_number(s.start * degrees)}", f"end = {_number(s.end * degrees)}"]
    lines += [f"weight = {weight}"] + ["beyond = true"] * s.beyond
    if isinstance(morph, JointMotion):
        to_joint = se3.transform(np.eye(3), -tree.rest[tree.segment(morph.segment)])
        T = se3.exp(se3.adjoint(to_joint) @ morph.twist)
        own = [f'segment = "{morph.segment}"', f"shift = {_numbers(T[:3, 3])}"]
        kind, own = "joint", own + [f"turn = {_numbers(np.degrees(se3.log(T)[3:]))}"]
    elif isinstance(morph, LocalMorph):
        segment = morph.segment or tree.segments[0]
        own = [f'segment = "{segment}"', f"centre = {_numbers(morph.centre)}", f"radii = {_numbers(morph.radii)}"]
        own += [f"shift = {_numbers(morph.shift)}"] + [f"on = {list(morph.on)}".replace("'", '"')] * bool(morph.on)
        own += ["moves = true"] * morph.moves
        kind = "local"
    elif isinstance(morph, SegmentMorph):
        kind, own = "surface", [f'segment = "{morph.segment}"', f"surface = {_surfaces(morph)}"]
    else:
        remedy = "Write the nodes to an OBJ file, and name that as `target`."
        raise BodyError("a body file cannot hold a morph to single nodes", remedy=remedy)
    return "\n".join(["[[morph]]", f'kind = "{kind}"', *own, *lines, ""])


def _surfaces(morph: SegmentMorph) -> str:
    out = []
    for c in morph.surfaces:
        if not isinstance(c, TaperedCylinder):
            remedy = "Name its OBJ file in the body file."
            raise BodyError("a body file cannot hold a morph to a mesh", remedy=remedy)
        side = f", side = {_numbers(c.side)}" if c.side is not None else ""
        radii = _numbers(np.array(c.radii))
        out.append(f"{{ start = {_numbers(c.start)}, end = {_numbers(c.end)}, radii = {radii}{side} }}")
    return f"[{', '.join(out)}]"


def _number(value: float) -> str:
    return repr(round(float(value), 12))


def _numbers(values: object) -> str:
    array = np.asarray(values, float)
    return f"[{', '.join(_numbers(v) if np.ndim(v) else _number(v) for v in array)}]"
