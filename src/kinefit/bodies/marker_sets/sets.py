"""Marker sets for identification: segments with their labels and joints, and the labels' positions on a body."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.marker_sets.files import (
    RANGE,
    MarkerSegmentRecord,
    SetRecord,
    catalogue,
    find_record,
    marker_set_names,
)
from kinefit.bodies.marker_sets.labels import matched, plain
from kinefit.errors import FileError, choices

MIN_COMMON_LABELS = 4
"""Of a set and a take, and half of the take's or the set's labels: fewer agree by chance."""


@dataclass(frozen=True, eq=False)
class SetSegment:
    """A segment of a marker set.

    Parameters
    ----------
    name : str
    parent : int, index of its parent, -1 for the root
    markers : labels that move with it; a label near a joint may be in both segments
    joint : (3,) [m] joint to its parent, in the frame of the set's positions; None for the root
    give : (k,) [m]
        Deviation of each marker from the rigid segment along one axis in vigorous motion, by skin and soft tissue. The
        catalogue has medians over seven takes of six subjects; in a distance, those of both ends add up.
    range : float [rad]
        Largest rotation of its joint about any one axis in vigorous motion.
    """

    name: str
    parent: int
    markers: tuple[str, ...]
    joint: NDArray | None = None
    give: tuple[float, ...] = ()
    range: float = RANGE


@dataclass(frozen=True, eq=False)
class MarkerSet:
    """A marker set: labels, their positions on an average body, segments.

    Parameters
    ----------
    name : str
    labels : (K,)
    places : (K, 3) [m]
        Positions on a body of 1.75 m standing upright with hanging arms, palms forward: x forward, y up, z to the
        right, from the middle of the hips. NaN where the set does not define them (markers of a cluster).
    segments : SetSegment, parents before children
    also : other names of the set
    computed : labels of computed points (joint centres), which are never used as markers
    """

    name: str
    labels: tuple[str, ...]
    places: NDArray
    segments: tuple[SetSegment, ...]
    also: tuple[str, ...] = ()
    computed: tuple[str, ...] = ()

    def match(self, labels: Iterable[str]) -> tuple[str | None, ...]:
        """Match each of a take's labels to a label of the set; None without a match.

        See `labels.matched`: the subject's prefix, letter case, . _ - and blanks are ignored.
        """
        return matched(labels, self.labels)

    def is_computed(self, label: str) -> bool:
        """Whether a label names a computed point, not a marker."""
        return plain(label) in {plain(c) for c in self.computed}


def load_marker_set(name_or_file: str | PathLike[str]) -> MarkerSet:
    """Load a marker set of the catalogue ("CMU_41", "HDM05_41", "PIG" ...), or from a TOML file.

    Raises
    ------
    ObservationError
        Unknown name.
    FileError
        A file that cannot be read, or is no marker set with segments.
    """
    record, source = find_record(name_or_file, marker_set_names())
    return _sets()[source] if source in _sets() else _built(record, source)


def find_marker_set(labels: Iterable[str]) -> MarkerSet | None:
    """Find the set of the catalogue that matches most labels; None if none matches half of them, or half of its own.

    Of sets with equal matches, the one with fewest other labels.
    """
    labels = tuple(labels)
    best, best_key = None, (MIN_COMMON_LABELS - 1, 0)
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
    """Build a set with its mirrored left side: labels of `sides`, segments that end in _r; z changes its sign."""
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
            problem, remedy = _fault(s, name, parent, own, names)
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
            f"`places` has labels that no segment has: {', '.join(unknown)}", file=source, place="places",
            remedy="Add each to a segment's markers, or remove it.",
        )
    places = np.array([at.get(label, [np.nan] * 3) for label in labels])
    computed = [n for label in record.computed for n in (label, mirror(label)) if n]
    return MarkerSet(record.name, labels, places, tuple(segments), tuple(record.also), tuple(dict.fromkeys(computed)))


def _fault(s: MarkerSegmentRecord, name: str, parent: str | None, own: list[str], names: list[str]) -> tuple[str, str]:
    """What is wrong with a segment, and what to do; empty if nothing is."""
    if name in names:
        return "a segment appears twice", "Give each its own name."
    if (parent is None) != (not names):
        return "the first segment is the root; every other has a parent", "Put the root first, children after parents."
    if parent is not None and parent not in names:
        return choices("segment", parent, names), "Parents come first."
    if not s.markers or len(set(own)) < len(own):
        return "no markers, or one twice", "List each label once."
    if unknown := sorted(set(s.loose) - set(s.markers)):
        return f"`loose` names {', '.join(unknown)}, which it does not have", "Give labels of its markers."
    numbers = [s.give, s.range, *s.loose.values(), *(s.joint or ())]
    if not np.isfinite(numbers).all() or min(s.give, s.range, *s.loose.values()) <= 0:
        return "joint, give or range is not finite, or not positive", "Give positive metres, and degrees for the range."
    return "", ""
