"""Read `[[morph]]` of a body file: shape changes that depend on angles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from kinefit._files import metres_of
from kinefit.bodies.morphs.operators import GlobalMorph, JointMotion, LocalMorph, Operator, SegmentMorph, Steering
from kinefit.bodies.surfaces.files import SurfaceRecord, surfaces_of
from kinefit.bodies.surfaces.mesh import read_obj
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError, check_choice, located
from kinefit.geometry import se3

Vector = tuple[float, float, float]
KINDS = {
    "joint": ({"segment"}, {"shift", "turn"}),  # required and optional keys
    "local": ({"segment", "centre", "radii", "shift"}, {"on", "moves", "tilt", "turn", "stretch"}),
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
    tilt: Vector | None = None
    stretch: Vector | None = None
    surface: SurfaceRecord | list[SurfaceRecord] | None = None
    target: str | None = None
    unit: str | None = None

    @property
    def place(self) -> str:
        """Description of the entry, for messages."""
        return f"{self.kind} morph of {self.segment or self.target or 'the surface'} by {self.angle}"


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
        placed = np.array(record.centre), np.array(record.radii), np.array(record.shift)
        tilt, turn = (np.radians(angles or (0.0, 0.0, 0.0)) for angles in (record.tilt, record.turn))
        return LocalMorph(
            *placed, steering, record.segment, tuple(record.on or ()), bool(record.moves), tilt, turn,
            record.stretch or (1.0, 1.0, 1.0),
        )  # fmt: skip
    if record.kind == "surface":
        assert record.segment
        surfaces = surfaces_of(record.surface, tree.segment(record.segment), source, "surface")
        return SegmentMorph(record.segment, tuple(surfaces), steering)
    metres = metres_of(record.unit or "m", BodyError, remedy="Use one of these.")
    vertices, _ = read_obj(Path(source).parent / str(record.target))
    return GlobalMorph(metres * vertices, steering)


def _check_keys(record: MorphRecord) -> None:
    check_choice("kind of morph", record.kind, KINDS, BodyError, remedy="Use one of these.")
    needed, allowed = KINDS[record.kind]
    given = {name for name in record.__struct_fields__ if getattr(record, name) is not None} - _COMMON
    if missing := needed - given:
        problem = f"a {record.kind} morph without {', '.join(sorted(missing))}"
        raise BodyError(problem, remedy="See docs/bodies.md for its keys.")
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
