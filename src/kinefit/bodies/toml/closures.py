"""Read `[[closure]]` and `[[dimension]]` of a body file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from kinefit._files import repeated
from kinefit.bodies.closures import KINDS, Closure, Dimension, with_dimensions
from kinefit.errors import BodyError, choices

if TYPE_CHECKING:
    from kinefit.bodies.body import Body

Vector = tuple[float, float, float]
ESTIMATE = "estimate"
_NAMED = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_MAX_DIMENSION = 1e4  # [m] or [deg]
_KINDS_WITH_AXIS = ("line", "plane")


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


def with_closure_images(records: Sequence[ClosureRecord], left: Callable[[str], str]) -> list[ClosureRecord]:
    """Closures, and the mirror images of those whose names end in `_r`."""
    out = list(records)
    for r in records:
        if left(r.name) == r.name or any(other.name == left(r.name) for other in records):
            continue
        flip: Callable[[Vector], Vector] = lambda v: (v[0], v[1], -v[2])
        axis = flip(r.axis) if isinstance(r.axis, tuple) else r.axis
        turn = None if r.turn is None else (-r.turn[0], -r.turn[1], r.turn[2])
        to = None if r.to is None else left(r.to)
        out.append(
            msgspec.structs.replace(r, name=left(r.name), point=left(r.point), to=to, axis=axis, turn=turn)
        )
    return out


def closed(
    body: Body, closures: Sequence[ClosureRecord], dimensions: Sequence[DimensionRecord], source: str
) -> Body:
    """Add the closures and dimensions of a file to a body.

    Raises
    ------
    BodyError
        A duplicate name; an unknown point, segment or kind; a closure of a segment with itself; a standard deviation
        that is not positive; missing or contradictory keys.
    """
    if body.morphs:
        problem = "closures of a body whose joints or surfaces morph"
        raise BodyError(problem, file=source, place="closure", remedy="Remove the morphs, or the closures.")
    for what, names in (("closure", [c.name for c in closures]), ("dimension", [d.name for d in dimensions])):
        if twice := sorted(repeated(names)):
            raise BodyError(f"{what} named twice: {', '.join(twice)}", file=source, remedy="Rename one of them.")
    body = replace(body, closures=tuple(_closure(body, r, source) for r in closures))
    drawn, wanted = [], {}
    for r in dimensions:
        d, value = _dimension(body, r, source)
        drawn.append(d)
        wanted[d.name] = value
    return with_dimensions(replace(body, dimensions=tuple(drawn)), wanted)


def _closure(body: Body, r: ClosureRecord, source: str) -> Closure:
    place = f"closure {r.name}"

    def wrong(problem: str, remedy: str) -> BodyError:
        return BodyError(problem, file=source, place=place, remedy=remedy)

    names = body.landmarks.names
    for point in (r.point, *([] if r.to is None else [r.to])):
        if point not in names:
            raise wrong(choices("landmark", point, names), "Use one of these, or add it under [landmarks].")
    if r.kind not in KINDS:
        raise wrong(choices("kind of closure", r.kind, KINDS), "Use one of these.")
    if r.mode not in ("soft", "hard"):
        raise wrong(choices("mode", r.mode, ("soft", "hard")), "Use one of these.")
    if (r.to is None) == (r.at is None):
        raise wrong("`to` and `at`: one of them is needed", "Give `to` a landmark, or `at` a place in the world.")
    if isinstance(r.at, str) and r.at != ESTIMATE:
        raise wrong(f"at = {r.at!r}", 'Give three numbers in metres, or "estimate".')
    if (r.kind in _KINDS_WITH_AXIS) != (r.axis is not None):
        raise wrong(f"a {r.kind} closure with axis {r.axis}", "Give an axis to lines and planes, and to no other.")
    if r.turn is not None and r.kind != "rigid":
        raise wrong(f"a {r.kind} closure with a turn", "Remove it: only rigid closures constrain rotation.")
    if r.mode == "hard" and (r.sigma is not None or r.turn_sigma is not None):
        raise wrong("a hard closure cannot have a standard deviation", 'Remove it, or set mode = "soft".')
    sigma = Closure.sigma if r.sigma is None else r.sigma
    sigmas = (sigma, 2.0 if r.turn_sigma is None else r.turn_sigma, r.std, r.turn_std)
    if not all(0.0 < s < np.inf for s in sigmas):
        raise wrong(f"standard deviations {sigmas}", "Give positive ones.")
    owner = body.landmarks.segments[list(names).index(r.point)]
    if r.to is not None and body.landmarks.segments[list(names).index(r.to)] == owner:
        raise wrong(f"'{r.point}' and '{r.to}' are of one segment", "Close the chain between two segments.")
    axis = _unit(r.axis)
    if axis is None:
        raise wrong(f"axis {r.axis!r} is no direction", 'Use "x", "y", "z", or three numbers that are not all zero.')
    at = r.mean if isinstance(r.at, str) else (r.at or (0.0, 0.0, 0.0))
    if not np.isfinite([*at, *(r.turn or ())]).all():
        raise wrong("numbers that are not finite", "Give metres and degrees.")
    unknown = isinstance(r.at, str)
    turn = np.radians(r.turn or (0.0, 0.0, 0.0))
    return Closure(
        r.name, r.kind, r.point, r.to or "", at, axis, (float(turn[0]), float(turn[1]), float(turn[2])),
        sigmas[0], float(np.radians(sigmas[1])), r.mode == "hard", r.std if unknown else 0.0,
        float(np.radians(r.turn_std)) if unknown and r.kind == "rigid" else 0.0,
    )  # fmt: skip


def _unit(axis: str | Vector | None) -> Vector | None:
    """Unit vector (3,) of an axis, default up; None if it has no direction."""
    v = np.array(_NAMED["y"] if axis is None else _NAMED.get(axis, (np.nan,) * 3) if isinstance(axis, str) else axis)
    length = float(np.linalg.norm(v))
    if not 1e-9 < length < np.inf:
        return None
    return (float(v[0] / length), float(v[1] / length), float(v[2] / length))


def _dimension(body: Body, r: DimensionRecord, source: str) -> tuple[Dimension, float]:
    """A dimension at its drawn value, and its actual value [m] or [rad]."""
    place = f"dimension {r.name}"

    def wrong(problem: str, remedy: str) -> BodyError:
        return BodyError(problem, file=source, place=place, remedy=remedy)

    if (r.along is None) == (r.about is None):
        raise wrong("`along` and `about`: one of them is needed", "Give `along` for a length, `about` for an angle.")
    if isinstance(r.value, str) and r.value != ESTIMATE:
        raise wrong(f"value = {r.value!r}", 'Give a number, or "estimate".')
    estimated = isinstance(r.value, str)
    if estimated and (r.std is None or not 0.0 < r.std < np.inf):
        raise wrong(f"a value to estimate with std = {r.std}", "Give `std`, its standard deviation about `mean`.")
    closures = {c.name: c for c in body.closures}
    if not r.moves:
        raise wrong("it moves nothing", "Name landmarks, segments or closures in `moves`.")
    for name in r.moves:
        kinds = [name in closures, name in body.landmarks.names, name in body.tree.segments]
        if sum(kinds) != 1:
            problem = f"'{name}' is " + ("a name with several meanings" if sum(kinds) else "nothing of the body")
            raise wrong(problem, "Name landmarks, segments or closures of this body.")
        if r.about is not None and not (kinds[0] and closures[name].kind == "rigid"):
            raise wrong(f"an angle that moves '{name}'", "Angles turn rigid closures, and nothing else.")
        if kinds[0] and r.along is not None and closures[name].to:
            raise wrong(f"it shifts closure '{name}' between two landmarks", "Name one of the landmarks.")
    stated = [r.mean, None if isinstance(r.value, str) else r.value]
    numbers = [r.drawn, *(r.along or r.about or ()), *(number for number in stated if number is not None)]
    if not (np.abs(numbers) < _MAX_DIMENSION).all():
        raise wrong("numbers are not finite, or not a dimension", "Give metres and degrees.")
    axis = (0.0, 0.0, 0.0)
    if r.about is not None:
        unit_axis = _unit(r.about)
        if unit_axis is None:
            raise wrong("`about` is no direction", "Give three numbers that are not all zero.")
        axis = unit_axis
    unit = 1.0 if r.about is None else np.pi / 180.0
    mean = r.drawn if r.mean is None else r.mean
    value = mean if isinstance(r.value, str) else r.value
    std = (r.std or 0.0) * unit if estimated else 0.0
    d = Dimension(r.name, r.drawn * unit, r.along or (0.0, 0.0, 0.0), axis, tuple(r.moves), std)
    return d, value * unit
