"""Marker sets for identification: which labels belong to which segment, where on a body, and where segments meet."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets.files import (
    GIVE,
    RANGE,
    MarkerSegmentRecord,
    SetRecord,
    catalogue,
    find_record,
    set_names,
)
from kinefit.bodies.marker_sets.labels import matched, plain
from kinefit.errors import FileError, choices

__all__ = [
    "FEWEST", "GIVE", "RANGE", "MarkerSet", "SetSegment", "find_marker_set", "load_marker_set", "marker_set_names",
]  # fmt: skip

FEWEST = 4
"""Labels that a set and a take must have in common, and half of the take's or the set's: fewer agree by chance."""


@dataclass(frozen=True, eq=False)
class SetSegment:
    """A segment of a marker set.

    Parameters
    ----------
    name : str
    parent : int, index of its parent, -1 for the root
    markers : labels that move with it; a label may be in two segments that meet there
    joint : (3,) [m] where it meets its parent, in the frame of the set's places; None for the root
    give : (k,) [m]
        How far each of its markers strays from the segment along one axis in vigorous motion: skin, soft parts. The
        catalogue's are medians over seven takes of six subjects; a distance gives by both of its ends.
    range : float [rad]
        How far its joint turns at most, about any one axis, in vigorous motion.
    """

    name: str
    parent: int
    markers: tuple[str, ...]
    joint: NDArray | None = None
    give: tuple[float, ...] = ()
    range: float = RANGE


@dataclass(frozen=True, eq=False)
class MarkerSet:
    """Labels, their places on an average body, segments.

    Parameters
    ----------
    name : str
    labels : (K,)
    places : (K, 3) [m]
        On a body of 1.75 m standing upright with hanging arms, palms forward: x forward, y up, z to the right, from
        the middle of the hips. NaN where the set leaves it to the laboratory (markers of a cluster).
    segments : SetSegment, parents before children
    also : other names of the set
    computed : labels that are no markers but computed points (joint centres); they are left out everywhere
    """

    name: str
    labels: tuple[str, ...]
    places: NDArray
    segments: tuple[SetSegment, ...]
    also: tuple[str, ...] = ()
    computed: tuple[str, ...] = ()

    def match(self, labels: Iterable[str]) -> tuple[str | None, ...]:
        """What the set calls each of a take's labels; None where it does not know it.

        See `labels.matched`: the subject's prefix, letter case, and the marks . _ - and blank do not count.
        """
        return matched(labels, self.labels)

    def is_computed(self, label: str) -> bool:
        """Whether a label names a computed point, not a marker."""
        return plain(label) in {plain(c) for c in self.computed}


def marker_set_names() -> tuple[str, ...]:
    """Names of the marker sets that come with kinefit."""
    return set_names()


def load_marker_set(name_or_file: str | PathLike[str]) -> MarkerSet:
    """A marker set of the catalogue ("CMU_41", "HDM05_41", "PIG" ...), or from a TOML file.

    Raises
    ------
    ObservationError
        Unknown name.
    FileError
        A file that cannot be read, or is no marker set with segments: with the place.
    """
    record, source = find_record(name_or_file, marker_set_names())
    return _sets()[source] if source in _sets() else _built(record, source)


def find_marker_set(labels: Iterable[str]) -> MarkerSet | None:
    """The set of the catalogue that knows most of the labels; None if none knows half of them, or half of its own.

    Of sets that know as many, the one with fewest other labels.
    """
    labels = tuple(labels)
    best, best_key = None, (FEWEST - 1, 0)
    for found in _sets().values():
        known = sum(n is not None or found.is_computed(label) for label, n in zip(labels, found.match(labels)))
        key = (known, -len(found.labels))
        if key > best_key and (2 * known >= len(labels) or 2 * known >= len(found.labels)):
            best, best_key = found, key
    return best


@cache
def _sets() -> dict[str, MarkerSet]:
    return {name: _built(record, name) for name, record in catalogue().items()}


def _built(record: SetRecord, source: str) -> MarkerSet:
    """The set with its left side: labels of `sides`, segments that end in _r; z changes its sign."""
    mirror = record.mirror
    segments: list[SetSegment] = []
    names: list[str] = []
    for s in record.segment:
        right = s.name.endswith("_r") and bool(record.sides)
        for side in ("_r", "_l") if right else ("",):
            name = s.name.removesuffix("_r") + side if right else s.name
            parent = s.parent.removesuffix("_r") + side if right and s.parent and s.parent.endswith("_r") else s.parent
            give = {label: s.loose.get(label, s.give) for label in s.markers}
            give |= {m: g for label, g in give.items() if (m := mirror(label)) and m not in give}
            own = [n for label in s.markers for n in (label, mirror(label)) if n] if side == "" else s.markers
            own = [m for label in s.markers if (m := mirror(label))] if side == "_l" else list(dict.fromkeys(own))
            problem, remedy = _wrong(s, name, parent, own, names)
            if problem:
                raise FileError(problem, file=source, place=f"segment '{name}'", remedy=remedy)
            joint = None if s.joint is None else np.array(s.joint) * ([1, 1, -1] if side == "_l" else 1)
            if own:
                turn = float(np.radians(s.range))
                number = -1 if parent is None else names.index(parent)
                segments.append(SetSegment(name, number, tuple(own), joint, tuple(give[m] for m in own), turn))
                names.append(name)
    if not segments:
        raise FileError("no segment", file=source, remedy="Give at least one [[segment]].")
    labels = tuple(dict.fromkeys(label for s in segments for label in s.markers))
    at: dict[str, list[float]] = {}
    for label, (x, y, z) in record.places.items():
        at[label] = [x, y, z]
        if left := mirror(label):
            at.setdefault(left, [x, y, -z])
    if unknown := sorted(set(record.places) - set(labels)):
        raise FileError(
            f"places of labels that no segment has: {', '.join(unknown)}", file=source, place="places",
            remedy="Add each to a segment's markers, or leave it out.",
        )
    places = np.array([at.get(label, [np.nan] * 3) for label in labels])
    computed = [n for label in record.computed for n in (label, mirror(label)) if n]
    return MarkerSet(record.name, labels, places, tuple(segments), tuple(record.also), tuple(dict.fromkeys(computed)))


def _wrong(s: MarkerSegmentRecord, name: str, parent: str | None, own: list[str], names: list[str]) -> tuple[str, str]:
    """What is wrong with a segment, and what to do; empty if nothing is."""
    if name in names:
        return "a segment is there twice", "Give each its own name."
    if (parent is None) != (not names):
        return "the first segment is the root; every other has a parent", "Put the root first, children after parents."
    if parent is not None and parent not in names:
        return choices("segment", parent, names), "Parents come first."
    if not s.markers or len(set(own)) < len(own):
        return "no markers, or one twice", "List each label once."
    if strangers := sorted(set(s.loose) - set(s.markers)):
        return f"`loose` names {', '.join(strangers)}, which it does not have", "Give labels of its markers."
    numbers = [s.give, s.range, *s.loose.values(), *(s.joint or ())]
    if not np.isfinite(numbers).all() or min(s.give, s.range, *s.loose.values()) <= 0:
        return "joint, give or range is not finite, or not positive", "Give metres, and degrees for the range."
    return "", ""
