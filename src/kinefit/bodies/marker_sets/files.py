"""Read and check files of marker sets (TOML): segments for identification, positions on a body for fitting."""

from __future__ import annotations

from functools import cache
from importlib import resources
from os import PathLike
from typing import Any

import msgspec
import numpy as np

from kinefit._files import parse_toml, read_text, record_of
from kinefit.bodies.marker_sets.labels import plain
from kinefit.errors import FileError, ObservationError, choices

GIVE = 0.004
"""[m] default give of a marker: its deviation from a rigid segment."""

RANGE = 1.5
"""[rad] default range of a joint."""

LANDMARK_SPREAD = 0.015
"""[m] sigma of a marker on a bony landmark, along each axis: a palpated landmark varies by about 1 cm between examiners
(della Croce et al. 2005); the marker's radius and the body's average shape add to that."""

_Vector = tuple[float, float, float]
_REMEDY = (
    "It has name, sides, [places] [m], [markers], each with a landmark, or a segment and `at` [m], and a spread, and "
    "[[segment]] with name, parent, joint [m], markers."
)


class MarkerSegmentRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """`[[segment]]`: labels that move rigidly, and the joint to its parent."""

    name: str
    markers: list[str]
    parent: str | None = None
    joint: _Vector | None = None
    give: float = GIVE
    loose: dict[str, float] = {}
    range: float = np.degrees(RANGE)


class MarkerRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A row of `[markers]`: on a landmark of the body, or at a position on a segment."""

    landmark: str | None = None
    segment: str | None = None
    at: _Vector | None = None
    offset: _Vector = (0.0, 0.0, 0.0)
    spread: float = LANDMARK_SPREAD


class SetRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A file: `[places]` and `[[segment]]` for identification, `[markers]` for fitting a body."""

    name: str
    segment: list[MarkerSegmentRecord] = []
    places: dict[str, _Vector] = {}
    markers: dict[str, MarkerRecord] = {}
    also: list[str] = []
    sides: list[tuple[str, str]] = []
    single: list[str] = []
    computed: list[str] = []

    def mirror(self, label: str) -> str | None:
        """Label of the left side for a label of the right side; None if there is none."""
        if label in self.single:
            return None
        return next((left + label[len(right) :] for right, left in self.sides if label.startswith(right)), None)


def marker_set_names(*, placed: bool = False) -> tuple[str, ...]:
    """Names of the marker sets that come with kinefit; `placed`: of those with positions of markers on a body."""
    return tuple(sorted(n for n, record in catalogue().items() if record.markers or not placed))


def find_record(name_or_file: str | PathLike[str], known: tuple[str, ...]) -> tuple[SetRecord, str]:
    """Find a set of the catalogue by any of its names, or read one from a file (.toml); and its source.

    Parameters
    ----------
    name_or_file : str or path
    known : names to choose from, for the message

    Raises
    ------
    ObservationError
        Unknown name.
    FileError
        A file that cannot be read, or is no marker set.
    """
    name = str(name_or_file)
    if name.lower().endswith(".toml"):
        return parsed(read_text(name, "the marker set", remedy="Give a TOML file."), name), name
    for record in catalogue().values():
        if plain(name) in map(plain, (record.name, *record.also)):
            return record, record.name
    raise ObservationError(choices("marker set", name, known), remedy="Or give a file of one (.toml).")


@cache
def catalogue() -> dict[str, SetRecord]:
    """The sets that come with kinefit, by name."""
    folder = resources.files("kinefit.bodies") / "marker_sets"
    files = sorted((e for e in folder.iterdir() if e.name.endswith(".toml")), key=lambda e: e.name)
    return {record.name: record for e in files if (record := parsed(e.read_text("utf-8"), e.name))}


def parsed(text: str, source: str) -> SetRecord:
    """Parse the text of a marker set's file.

    Raises
    ------
    FileError
        No TOML, or no marker set.
    """
    record = record_of(parse_toml(text, source), SetRecord, "a marker set", source, _REMEDY)
    if not record.segment and not record.markers:
        raise FileError("no segment and no markers", file=source, remedy=_REMEDY)
    for label, entry in record.markers.items():
        numbers: list[Any] = [entry.spread, *entry.offset, *(entry.at or ())]
        if (entry.landmark is None) == (entry.segment is None or entry.at is None):
            raise FileError(
                "a marker needs a landmark, or a segment and a position `at`", file=source, place=label,
                remedy='Such as { landmark = "r_asis" } or { segment = "thigh_r", at = [0.0, -0.2, 0.08] }.',
            )  # fmt: skip
        if not np.isfinite(numbers).all() or not entry.spread > 0:
            raise FileError("numbers that are not finite, or no spread", file=source, place=label, remedy="In metres.")
    return record
