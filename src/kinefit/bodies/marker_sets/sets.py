"""Marker sets for identification: segments with their labels and joints, and the labels' positions on a body."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from os import PathLike
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit._files import parse_toml, read_text, record_of
from kinefit.errors import FileError, ObservationError, choices

MIN_COMMON_LABELS = 4
"""Of a set and a take, and half of the take's or the set's labels: fewer agree by chance."""
GIVE = 0.004
"""[m] default give of a marker: its deviation from a rigid segment."""

RANGE = 1.5
"""[rad] default range of a joint."""

LANDMARK_SPREAD = 0.015
"""[m] sigma of a marker on a bony landmark, along each axis: a palpated landmark varies by about 1 cm between examiners
(della Croce et al. 2005); the marker's radius and the body's average shape add to that."""


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


PREFIXES = (("Right", "Left"), ("right", "left"), ("R", "L"), ("r", "l"), ("r", "L"), ("R", "l"))
SUFFIXES = (("_R", "_L"), ("_r", "_l"), (".R", ".L"), (".r", ".l"), ("_Right", "_Left"), ("R", "L"))

SIDES = ("labelled", "exchanged", "mirrored-x", "mirrored-y", "mirrored-z")
"""How a recording's sides are read: as labelled, with left and right labels exchanged, or with one axis negated."""


def bare(label: str) -> str:
    """A label without its subject's prefix: "Anna:LASI" -> "LASI"."""
    return label.rpartition(":")[2].strip()


def subject_of(label: str) -> str:
    """A label's prefix, the subject's name: "Anna:LASI" -> "Anna"; "" for none."""
    return label.rpartition(":")[0].strip()


def plain(label: str) -> str:
    """Normalise a label for comparison: no prefix, lower case, without . _ - and blanks."""
    return "".join(c for c in bare(label).lower() if c not in "._- ")


def matched(labels: Iterable[str], names: Iterable[str]) -> tuple[str | None, ...]:
    """Match each label to a name; None without a match.

    A name equal to the label without its prefix is preferred. Else prefix, letter case, . _ - and blanks are ignored,
    unless two names differ only by them.
    """
    names = tuple(names)
    exact, loose = set(names), dict[str, str | None]()
    for name in names:
        loose[plain(name)] = name if loose.get(plain(name), name) == name else None
    return tuple(bare(n) if bare(n) in exact else loose.get(plain(n)) for n in labels)


def side_pairs(labels: Sequence[str]) -> dict[str, str]:
    """Pairs of right and left labels that differ by their side only: a dictionary from right to left."""
    known, out = set(labels), dict[str, str]()
    for label in labels:
        for right, left in PREFIXES:
            image = left + label[len(right) :]
            if label.startswith(right) and label not in out and image in known and image != label:
                out[label] = image
        for right, left in SUFFIXES:
            image = label[: len(label) - len(right)] + left
            if label.endswith(right) and label not in out and image in known and image != label:
                out[label] = image
    return out


def read_sides(labels: Sequence[str], positions: NDArray, sides: str) -> tuple[tuple[str, ...], NDArray]:
    """Labels and positions (F, K, 3) of a recording whose sides are read as one of `SIDES` says.

    Raises
    ------
    ObservationError
        Another word, or no pairs of left and right labels to exchange.
    """
    if sides not in SIDES:
        raise ObservationError(choices("value of sides", sides, SIDES))
    if sides.startswith("mirrored"):
        return tuple(labels), positions * np.where(np.arange(3) == "xyz".index(sides[-1]), -1.0, 1.0)
    names = {(subject_of(n), bare(n)): n for n in labels}
    pairs = side_pairs([bare(n) for n in labels]) if sides == "exchanged" else {}
    if sides == "exchanged" and not pairs:
        raise ObservationError("no pairs of left and right labels to exchange", remedy="Remove sides.")
    image = pairs | {left: right for right, left in pairs.items()}
    return tuple(names.get((subject_of(n), image.get(bare(n), "")), n) for n in labels), positions


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
