"""Closed chains: landmarks constrained to points, lines or planes, segments constrained to each other (P3 3.2).

A body is an open tree. Closures between its landmarks, or between a landmark and the world, close its chains: a boot in
its binding, a hand on a bar, a pedal's axle on the bike. An unknown length of the gear, such as the distance between
the bindings, is a dimension that a subject fit estimates (P3 5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import BodyError, check_choice
from kinefit.geometry import se3

if TYPE_CHECKING:
    from kinefit.bodies.body import Body, PointSet

KINDS = {"point": 3, "line": 2, "plane": 1, "rigid": 6}
"""Kinds of closures, and the number of degrees of freedom that each removes."""

FIXED = "fixed"
"""The scale group of gear, which is not scaled with the person."""

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Closure:
    """A constraint of a landmark to another landmark, or to a position in the world.

    The other frame is that of the other landmark's segment, or the world.

    Parameters
    ----------
    name : str
    kind : "point": the landmark stays on the other point; "line", "plane": on a line or plane through it, of direction
        or normal `axis`; "rigid": its segment also keeps its orientation in the other frame.
    point : name of the landmark.
    to : name of the other landmark; "" for a position in the world.
    place : (3,) [m] position in the world, if `to` is "".
    axis : (3,) unit vector in the other frame.
    turn : (3,) [rad] rotation vector of the landmark's segment in the other frame, of a rigid closure.
    sigma, turn_sigma : [m], [rad] standard deviation of a soft closure. With the default sigma, 99.8 % of poses are
        within 5 mm of a hard closure if measured points have a sigma of 5 mm (P3 3.2).
    hard : bool, whether it holds exactly.
    place_std, turn_std : [m], [rad] prior standard deviations of an estimated position and rotation in the world; 0 if
        known.
    """

    name: str
    kind: str
    point: str
    to: str = ""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma: float = 0.0005
    turn_sigma: float = np.radians(2.0)
    hard: bool = False
    place_std: float = 0.0
    turn_std: float = 0.0

    @property
    def rows(self) -> int:
        """Number of degrees of freedom that it removes."""
        return KINDS[self.kind]

    @property
    def directions(self) -> NDArray:
        """Constrained directions of the point: (3, 3), (2, 3) or (1, 3) unit vectors in the other frame."""
        axis = np.array(self.axis)
        if self.kind == "plane":
            return axis[None]
        if self.kind == "line":
            first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
            first /= np.linalg.norm(first)
            return np.stack([first, np.cross(axis, first)])
        return np.eye(3)

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of its rows, for messages."""
        if self.kind == "line":
            return ("across the line", "across the line, the other way")
        shifts = ("off the plane",) if self.kind == "plane" else tuple(f"along {a}" for a in AXES)
        return shifts + (tuple(f"about {a}" for a in AXES) if self.kind == "rigid" else ())


@dataclass(frozen=True)
class Dimension:
    """A length or an angle of gear on which landmarks, joints and closures depend.

    Parameters
    ----------
    name : str
    value : float [m] or [rad], current value.
    along : (3,) shift per metre of everything it moves, in the frame of that.
    about : (3,) unit axis about which the `turn` of rigid closures rotates; zeros for a length.
    moves : names of landmarks, of segments (their joints move in the parent's frame), of closures.
    std : [m] or [rad] prior standard deviation of an estimated value; 0 if known.
    """

    name: str
    value: float
    along: tuple[float, float, float] = (0.0, 0.0, 0.0)
    about: tuple[float, float, float] = (0.0, 0.0, 0.0)
    moves: tuple[str, ...] = ()
    std: float = 0.0

    @property
    def turns(self) -> bool:
        """Whether it is an angle."""
        return any(self.about)


def with_dimensions(body: Body, values: Mapping[str, float]) -> Body:
    """Change dimensions of gear to values [m] or [rad]. Everything they move shifts by the change, whatever its scale.

    Raises
    ------
    BodyError
        A dimension that the body does not have, or a value that is not finite.
    """
    known = {d.name: d for d in body.dimensions}
    for name in values:
        check_choice(f"dimension of body '{body.name}' named", name, known, BodyError, remedy="Use one of these.")
        if not np.isfinite(values[name]):
            raise BodyError(f"dimension '{name}' of {values[name]}", remedy="Give metres, or radians.")
    offsets, points = np.array(body.tree.offsets), np.array(body.landmarks.points)
    closures = {c.name: c for c in body.closures}
    moved = False
    for name, value in values.items():
        d, change = known[name], float(value) - known[name].value
        if change == 0.0:
            continue
        shift, moved = change * np.array(d.along), True
        for what in d.moves:
            if what in closures:
                closures[what] = _shifted(closures[what], shift, change * np.array(d.about))
            elif what in body.landmarks.names:
                points[body.landmarks.names.index(what)] += shift
            else:
                offsets[body.tree.segment(what)] += shift
        known[name] = replace(d, value=float(value))
    if not moved:
        return body
    landmarks = replace(body.landmarks, points=points)
    sets = {name: _moved_points(s, body.landmarks, landmarks) for name, s in body.keypoint_sets.items()}
    return replace(
        body, tree=body.tree.with_offsets(offsets), landmarks=landmarks, keypoint_sets=sets,
        closures=tuple(closures.values()), dimensions=tuple(known.values()),
    )  # fmt: skip


def _moved_points(points: PointSet, old: PointSet, new: PointSet) -> PointSet:
    """Move the points that coincide with an old landmark to the new one."""
    at = {(int(s), tuple(x)): k for k, (s, x) in enumerate(zip(old.segments, old.points))}
    out = np.array(points.points)
    for i, (s, x) in enumerate(zip(points.segments, points.points)):
        k = at.get((int(s), tuple(x)))
        if k is not None:
            out[i] = new.points[k]
    return replace(points, points=out)


def _shifted(closure: Closure, shift: NDArray, turn: NDArray) -> Closure:
    """Shift a closure's position by (3,) [m], and rotate its segment by a rotation vector (3,) [rad]."""
    out = closure
    if shift.any():
        out = replace(out, place=tuple((np.array(out.place) + shift).tolist()))
    if turn.any():
        R = se3.exp_so3(turn) @ se3.exp_so3(np.array(out.turn))
        out = replace(out, turn=tuple(se3.log_so3(R).tolist()))
    return out


def with_places(body: Body, places: Mapping[str, tuple[NDArray, NDArray]]) -> Body:
    """Replace the position (3,) [m] and rotation vector (3,) [rad] in the world of some closures."""
    out = []
    for c in body.closures:
        if c.name in places:
            at, turn = places[c.name]
            c = replace(c, place=tuple(np.asarray(at, float).tolist()), turn=tuple(np.asarray(turn, float).tolist()))
        out.append(c)
    return replace(body, closures=tuple(out))


def known_gear(body: Body) -> Body:
    """The body with all dimensions and positions in the world marked as known."""
    return replace(
        body, closures=tuple(replace(c, place_std=0.0, turn_std=0.0) for c in body.closures),
        dimensions=tuple(replace(d, std=0.0) for d in body.dimensions),
    )  # fmt: skip


def has_unknown_gear(body: Body) -> bool:
    """Whether a dimension or a position in the world is to be estimated."""
    return any(c.place_std > 0.0 for c in body.closures) or any(d.std > 0.0 for d in body.dimensions)


def without_landmarks(closures: tuple[Closure, ...], there: tuple[str, ...]) -> tuple[Closure, ...]:
    """The closures whose landmarks all exist."""
    return tuple(c for c in closures if c.point in there and (not c.to or c.to in there))
