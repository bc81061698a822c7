"""Positions of a set's markers on a body, before a subject's own offsets are estimated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.marker_sets import sets as marker_sets
from kinefit.errors import FileError, ObservationError


@dataclass(frozen=True, eq=False)
class MarkerPlacement:
    """Markers of a set on a body.

    Parameters
    ----------
    name : str of the set.
    points : PointSet of K markers.
    spread : (K,) [m] standard deviation of each marker's position, along each axis.
    """

    name: str
    points: PointSet
    spread: NDArray

    def select(self, names: Iterable[str]) -> MarkerPlacement:
        """The named markers, in that order."""
        names = tuple(names)
        rows = [self.points.index(n) for n in names]
        return MarkerPlacement(self.name, self.points.select(names), self.spread[rows])


def placed_set_names() -> tuple[str, ...]:
    """Names of the marker sets of the catalogue with positions of markers on a body."""
    return marker_sets.marker_set_names(placed=True)


@checked
def placement(body: Body, marker_set: str | PathLike[str] | MarkerPlacement) -> MarkerPlacement:
    """Place a marker set on a body: a set of the body or of the catalogue, a file (.toml), or a placement as given.

    Markers on segments or landmarks that the body does not have are dropped.

    Raises
    ------
    ObservationError
        Unknown name.
    FileError
        A file that cannot be read, is no marker set, or has no positions on a body.
    """
    if isinstance(marker_set, MarkerPlacement):
        return marker_set
    name = str(marker_set)
    if name in body.marker_sets:
        points = body.markers(name)
        return MarkerPlacement(name, points, np.full(len(points), marker_sets.LANDMARK_SPREAD))
    record, source = marker_sets.find_record(marker_set, (*body.marker_sets, *placed_set_names()))
    if not record.markers:
        raise FileError(
            "has no positions of its markers on a body", file=source, place="markers",
            remedy=f"Add [markers] to a file of your own, or use one of: {', '.join(placed_set_names())}.",
        )  # fmt: skip
    return placed(body, record)


def find_placement(
    body: Body, labels: Iterable[str], marker_set: str | PathLike[str] | MarkerPlacement | None = None
) -> MarkerPlacement:
    """Select the markers of a set that match the labels; default: of the set with most matches.

    `labels.matched` matches labels to markers. A `MarkerPlacement` is a set too.

    Raises
    ------
    ObservationError
        Fewer than four labels match the set, or any set; or the default explains neither half of the labels nor half of
        its own.
    """
    labels = tuple(labels)
    names = [marker_set] if marker_set else [*body.marker_sets, *placed_set_names()]
    best, size = None, 0
    for name in names:
        whole = placement(body, name)
        known = set(marker_sets.matched(labels, whole.points.names))
        shared = whole.select(n for n in whole.points.names if n in known)
        if best is None or len(shared.points) > len(best.points):
            best, size = shared, len(whole.points)
    if (best is None or not len(best.points)) and labels and all(label.startswith("*") for label in labels):
        raise ObservationError(
            f"{len(labels)} trajectories without names",
            remedy="Identify first: `kinefit markers identify TAKE SUBJECT.json`, or `fit --subject SUBJECT.json`.",
        )
    if best is None or len(best.points) < marker_sets.MIN_COMMON_LABELS:
        count = 0 if best is None else len(best.points)
        given = marker_set.name if isinstance(marker_set, MarkerPlacement) else marker_set
        sets = f"set '{given}'" if given else "any marker set"
        raise ObservationError(
            f"{sets} knows only {count} of the labels: {_listed(labels)}",
            remedy=f"Sets: {', '.join(str(n) for n in [*body.marker_sets, *placed_set_names()])}; or a file (--set): "
            "`kinefit markers set` writes a first one.",
        )
    ignored = ignored_labels(best, labels)
    if not marker_set and len(best.points) < min(len(ignored), (size + 1) // 2):
        raise ObservationError(
            f"no marker set explains most of the labels: {best.name} knows {len(best.points)} of "
            f"{len(best.points) + len(ignored)}, not {_listed(ignored)}",
            remedy="`kinefit markers set` writes a set for these labels (then --set FILE); "
            f"or fit the few that are known (--set {best.name}; in a take: set).",
        )
    return best


def ignored_labels(placed: MarkerPlacement, labels: Iterable[str]) -> tuple[str, ...]:
    """Labels of a recording that a set does not place: without computed points, and points without names ("*1")."""
    known = marker_sets.catalogue().get(placed.name)
    names = () if known is None else (n for c in known.computed for n in (c, known.mirror(c) or c))
    computed = {marker_sets.plain(n) for n in names}
    found = zip(labels, marker_sets.matched(labels, placed.points.names))
    unplaced = (n for n, own in found if own is None and not n.startswith("*"))
    return tuple(n for n in unplaced if marker_sets.plain(n) not in computed)


def known_set(body: Body, labels: Iterable[str], marker_set: str | None = None) -> str:
    """Name of the body's marker set with most of the labels; "" if these are landmarks of the body.

    Raises
    ------
    ObservationError
        No label matches.
    BodyError
        The body has no such set.
    """
    labels = tuple(labels)
    sets = {marker_set: body.markers(marker_set)} if marker_set else {**body.marker_sets, "": body.landmarks}
    shared = {name: len(set(marker_sets.matched(labels, points.names)) - {None}) for name, points in sets.items()}
    best = max(shared, key=lambda name: shared[name])
    if not shared[best]:
        raise ObservationError(
            f"body '{body.name}' knows none of the labels: {_listed(tuple(sorted(labels)))}",
            remedy=f"Marker sets of the body: {', '.join(body.marker_sets) or 'none'}; or name its landmarks.",
        )
    return best


def _listed(labels: tuple[str, ...]) -> str:
    return ", ".join(labels[:8]) + (" ..." if len(labels) > 8 else "")


def placed(body: Body, record: marker_sets.SetRecord) -> MarkerPlacement:
    """Place a set's record on a body; markers on segments or landmarks that the body does not have are dropped."""
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
    return MarkerPlacement(record.name, points, np.array(spread))


def _with_image(label: str, record: marker_sets.SetRecord) -> list[tuple[str, bool]]:
    image = record.mirror(label)
    return [(label, False)] + ([(image, True)] if image and image not in record.markers else [])


def _place(body: Body, entry: marker_sets.MarkerRecord, mirrored: bool) -> tuple[int, NDArray] | None:
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
