"""Checks of the values that a user's own sensor returns; errors name the sensor."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from kinefit.bodies import Body
from kinefit.errors import ObservationError
from kinefit.rows import AnyRows, DofRows, PairRows, ParameterRows, Rows
from kinefit.sensors import _kernels


def of_kind(value: object, kind: type, what: str, remedy: str, *, each: type | None = None) -> None:
    """Raise ObservationError if a value, called `what`, is text or not of a kind, or an item not of `each`."""
    if not isinstance(value, kind) or isinstance(value, str):
        raise ObservationError(f"{what} is a {type(value).__name__}, not a {kind.__name__}", remedy=remedy)
    if each is not None:
        for item in value.values() if isinstance(value, Mapping) else value:  # type: ignore[attr-defined]
            of_kind(item, each, f"one of {what}", remedy)


@contextmanager
def named(sensor: str) -> Iterator[None]:
    """Context in which every ObservationError raised names the sensor."""
    try:
        yield
    except ObservationError as error:
        if sensor in str(error):
            raise
        raise ObservationError(f"sensor '{sensor}': {error.problem}", remedy=error.remedy) from error


def check_rows(rows: Any, sensor: str, body: Body) -> list[AnyRows]:
    """Check the rows of a user's own sensor; errors name the sensor.

    Raises
    ------
    ObservationError
        No rows; of wrong shapes, not finite, of negative weight; on segments or degrees of freedom that the body does
        not have.
    """
    parts = [rows] if isinstance(rows, AnyRows) else rows
    if not isinstance(parts, Sequence) or not all(isinstance(p, AnyRows) for p in parts):
        kinds = type(rows).__name__
        remedy = "`rows` must return Rows, PairRows, ParameterRows or DofRows, or a list of them."
        raise ObservationError(f"`rows` of sensor '{sensor}' returned a {kinds}", remedy=remedy)
    count, n = len(body.tree.segments), body.tree.n_dofs
    for p in parts:
        if isinstance(p, Rows) and not p.segment.shape == p.group.shape == p.data.shape[1:] == (p.data.size // 8,):
            shapes = p.data.shape, p.segment.shape, p.group.shape
            raise ObservationError(f"sensor '{sensor}' has rows of shapes {shapes}", remedy="Create them with Rows.of.")
        if isinstance(p, Rows) and _kernels.sound(p.data, p.segment, count):
            continue
        if isinstance(p, Rows) and not math.isfinite(p.data.sum()):
            remedy = "Leave out rows that were not measured."
            raise ObservationError(f"sensor '{sensor}' has rows that are not finite", remedy=remedy)
        if p.weight.ndim == 1 and len(p) and p.weight.min() < 0.0:
            raise ObservationError(f"sensor '{sensor}' has rows of negative weight", remedy="Weights are 1/σ².")
        used = p.segments if isinstance(p, PairRows) else p.index if isinstance(p, ParameterRows) else p.segment
        what, most = ("degree of freedom", n) if isinstance(p, ParameterRows) else ("segment", count)
        if used is not None and used.size and not 0 <= used.min() <= used.max() < most:
            wrong = int(used.min() if used.min() < 0 else used.max())
            problem = f"sensor '{sensor}' has rows on {what} {wrong}; body '{body.name}' has {most}"
            raise ObservationError(problem, remedy="Use body.tree.segment(name), or the segments of a point set.")
        if isinstance(p, DofRows) and p.jacobian.shape[1] != n:
            problem = f"sensor '{sensor}' has a jacobian of {p.jacobian.shape[1]} columns; body '{body.name}' has {n}"
            raise ObservationError(problem, remedy="Give one column for each degree of freedom.")
    return list(parts)
