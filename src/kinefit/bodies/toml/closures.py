"""Read `[[closure]]` and `[[dimension]]` of a body file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.closures import KINDS, Closure, Dimension, with_dimensions
from kinefit.bodies.toml.records import ClosureRecord, DimensionRecord, Vector, direction, refuse_repeated
from kinefit.errors import BodyError, check_choice, located

ESTIMATE = "estimate"
_MAX_DIMENSION = 1e4  # [m] or [deg]
_ZERO_VECTOR = (0.0, 0.0, 0.0)


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
    refuse_repeated("closure", [c.name for c in closures], source)
    refuse_repeated("dimension", [d.name for d in dimensions], source)
    made, drawn, wanted = list[Closure](), list[Dimension](), dict[str, float]()
    for c in closures:
        with located(source, f"closure {c.name}"):
            made.append(_closure(body, c))
    body = replace(body, closures=tuple(made))
    for r in dimensions:
        with located(source, f"dimension {r.name}"):
            d, wanted[r.name] = _dimension(body, r)
        drawn.append(d)
    return with_dimensions(replace(body, dimensions=tuple(drawn)), wanted)


def _check(good: bool, problem: str, remedy: str) -> None:
    if not good:
        raise BodyError(problem, remedy=remedy)


def _closure(body: Body, r: ClosureRecord) -> Closure:
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
    axis = direction("y" if r.axis is None else r.axis)
    if axis is None:
        remedy = 'Use "x", "y", "z", or three numbers that are not all zero.'
        raise BodyError(f"axis {r.axis!r} is no direction", remedy=remedy)
    _check(bool(np.isfinite([*at, *(r.turn or ())]).all()), "numbers that are not finite", "Give metres and degrees.")
    turn, turn_sigma, turn_std = np.radians(r.turn or _ZERO_VECTOR), np.radians(sigmas[1]), np.radians(r.turn_std)
    return Closure(
        r.name, r.kind, r.point, r.to or "", at, _vector(axis), _vector(turn), sigma, float(turn_sigma),
        r.mode == "hard", r.std if unknown else 0.0, float(turn_std) if unknown and r.kind == "rigid" else 0.0,
    )  # fmt: skip


def _vector(v: NDArray) -> Vector:
    return (float(v[0]), float(v[1]), float(v[2]))


def _dimension(body: Body, r: DimensionRecord) -> tuple[Dimension, float]:
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
    axis = np.zeros(3) if r.about is None else direction(r.about)
    if axis is None:
        raise BodyError("`about` is no direction", remedy="Give three numbers that are not all zero.")
    unit = 1.0 if r.about is None else np.pi / 180.0
    std = std * unit if estimated else 0.0
    return Dimension(r.name, r.drawn * unit, r.along or _ZERO_VECTOR, _vector(axis), tuple(r.moves), std), value * unit
