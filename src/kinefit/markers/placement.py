"""Where the markers of a set sit on a body, before a subject's own offsets are known."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.errors import FileError, ObservationError, choices

LANDMARK_SPREAD = 0.015
"""[m] of a marker on a bony landmark, along each axis: a palpated landmark varies by about 1 cm between examiners
(della Croce et al. 2005), and a marker's own radius and the body's average shape come on top."""

FEWEST = 4
"""Labels that a set and a file must have in common."""

_Vector = tuple[float, float, float]


class _Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    landmark: str | None = None
    segment: str | None = None
    at: _Vector | None = None
    offset: _Vector = (0.0, 0.0, 0.0)
    spread: float = LANDMARK_SPREAD


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: str
    markers: dict[str, _Entry]
    also: list[str] = []
    sides: list[tuple[str, str]] = []
    computed: list[str] = []


@dataclass(frozen=True, eq=False)
class Placement:
    """Markers of a set on a body.

    Parameters
    ----------
    name : str of the set.
    points : PointSet of K markers.
    spread : (K,) [m] standard deviation of a marker about its place, along each axis.
    """

    name: str
    points: PointSet
    spread: NDArray

    def select(self, names: Iterable[str]) -> Placement:
        """The named markers, in that order."""
        names = tuple(names)
        rows = [self.points.index(n) for n in names]
        return Placement(self.name, self.points.select(names), self.spread[rows])


def marker_set_names() -> tuple[str, ...]:
    """Names of the marker sets that come with kinefit."""
    return tuple(sorted(_catalogue()))


def placement(body: Body, marker_set: str | PathLike[str]) -> Placement:
    """A marker set on a body: one of the catalogue, one of the body's own, or a file of your own (.toml).

    Markers on segments or landmarks that the body does not have are left out.

    Raises
    ------
    ObservationError
        Unknown name.
    FileError
        A file that cannot be read, or is no marker set.
    """
    name = str(marker_set)
    if name.endswith(".toml"):
        try:
            text = Path(marker_set).read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise FileError(f"cannot read the marker set ({error})", file=name, remedy="Give a TOML file.") from error
        return _placed(body, _parsed(text, name))
    if name in body.marker_sets:
        points = body.markers(name)
        return Placement(name, points, np.full(len(points), LANDMARK_SPREAD))
    for record in _catalogue().values():
        if _plain(name) in map(_plain, (record.name, *record.also)):
            return _placed(body, record)
    raise ObservationError(
        choices("marker set", name, [*body.marker_sets, *marker_set_names()]), remedy="Or give a file of one (.toml)."
    )


def find_placement(body: Body, labels: Iterable[str], marker_set: str | PathLike[str] | None = None) -> Placement:
    """The markers of a set that are among the labels; default: of the set that shares most labels.

    Raises
    ------
    ObservationError
        Fewer than four labels are known to the set, or to any.
    """
    labels = tuple(labels)
    names = [marker_set] if marker_set else [*body.marker_sets, *marker_set_names()]
    best: Placement | None = None
    for name in names:
        whole = placement(body, name)
        shared = whole.select(n for n in whole.points.names if n in labels)
        if best is None or len(shared.points) > len(best.points):
            best = shared
    if best is None or len(best.points) < FEWEST:
        known = 0 if best is None else len(best.points)
        sets = f"set '{marker_set}'" if marker_set else "any marker set"
        raise ObservationError(
            f"only {known} of the labels are known to {sets}: {_listed(labels)}",
            remedy=f"Sets: {', '.join(str(n) for n in [*body.marker_sets, *marker_set_names()])}; or give a file.",
        )
    return best


def known_set(body: Body, labels: Iterable[str], marker_set: str | None = None) -> str:
    """The body's own marker set that labels belong to; "" where they are landmarks of the body.

    Raises
    ------
    ObservationError
        The body knows none of them.
    BodyError
        It has no such set.
    """
    labels = set(labels)
    sets = {marker_set: body.markers(marker_set)} if marker_set else {**body.marker_sets, "": body.landmarks}
    shared = {name: len(labels.intersection(points.names)) for name, points in sets.items()}
    best = max(shared, key=lambda name: shared[name])
    if not shared[best]:
        raise ObservationError(
            f"none of the labels is known to body '{body.name}': {_listed(tuple(sorted(labels)))}",
            remedy=f"Marker sets of the body: {', '.join(body.marker_sets) or 'none'}; or name its landmarks.",
        )
    return best


def _plain(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())


def _listed(labels: tuple[str, ...]) -> str:
    return ", ".join(labels[:8]) + (" ..." if len(labels) > 8 else "")


@cache
def _catalogue() -> dict[str, _File]:
    folder = resources.files("kinefit.markers") / "placements"
    files = [e for e in folder.iterdir() if e.name.endswith(".toml")]
    return {record.name: record for e in files if (record := _parsed(e.read_text("utf-8"), e.name))}


def _parsed(text: str, source: str) -> _File:
    try:
        record = msgspec.convert(tomllib.loads(text), _File)
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"not valid TOML ({error})", file=source, remedy="See https://toml.io.") from error
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `$")
        remedy = "It has name, sides and [markers], each with a landmark, or a segment and `at` [m], and a spread."
        where = place.strip(".`") or None
        raise FileError(f"not a marker set: {problem}", file=source, place=where, remedy=remedy) from error
    for label, entry in record.markers.items():
        numbers: list[Any] = [entry.spread, *entry.offset, *(entry.at or ())]
        if (entry.landmark is None) == (entry.segment is None or entry.at is None):
            raise FileError(
                "a marker sits on a landmark, or on a segment `at` a place", file=source, place=label,
                remedy='Such as { landmark = "r_asis" } or { segment = "thigh_r", at = [0.0, -0.2, 0.08] }.',
            )
        if not np.isfinite(numbers).all() or not entry.spread > 0:
            raise FileError("numbers that are not finite, or no spread", file=source, place=label, remedy="In metres.")
    return record


def _placed(body: Body, record: _File) -> Placement:
    names, segments, at, spread = [], [], [], []
    for label, entry in record.markers.items():
        for name, mirrored in _with_image(label, record):
            found = _place(body, entry, mirrored)
            if found is not None and name not in names:
                names.append(name)
                segments.append(found[0])
                at.append(found[1])
                spread.append(entry.spread)
    points = PointSet(tuple(names), np.array(segments, np.int64), np.array(at, float).reshape(-1, 3))
    return Placement(record.name, points, np.array(spread))


def _with_image(label: str, record: _File) -> list[tuple[str, bool]]:
    for right, left in record.sides:
        image = left + label[len(right) :]
        if label.startswith(right) and image not in record.markers:
            return [(label, False), (image, True)]
    return [(label, False)]


def _place(body: Body, entry: _Entry, mirrored: bool) -> tuple[int, NDArray] | None:
    side = np.array((1.0, 1.0, -1.0 if mirrored else 1.0))
    if entry.landmark is not None:
        name = f"l_{entry.landmark[2:]}" if mirrored and entry.landmark.startswith("r_") else entry.landmark
        if name not in body.landmarks.names:
            return None
        i = body.landmarks.index(name)
        return int(body.landmarks.segments[i]), body.landmarks.points[i] + side * entry.offset
    segment = str(entry.segment)
    segment = f"{segment[:-2]}_l" if mirrored and segment.endswith("_r") else segment
    if segment not in body.tree.segments:
        return None
    return body.tree.segment(segment), side * (np.array(entry.at) + entry.offset)
