"""Split the markers of several people in one file by the prefix of their labels ("Anna:LASI")."""

from __future__ import annotations

from dataclasses import replace

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import bare, subject_of
from kinefit.errors import ObservationError
from kinefit.observations import Markers

MIN_LABELS = 4
"""Least number of a person's labels; fewer belong to an object ("Sync:Sync")."""


@checked
def split_people(markers: Markers) -> dict[str, Markers]:
    """Split markers by person: a dictionary from prefix to markers whose labels have no prefix.

    Without any prefixed person, all labels belong to one person called "". Otherwise the others are excluded.

    Raises
    ------
    ObservationError
        A label appears twice for one person.
    """
    columns: dict[str, list[int]] = {}
    for i, name in enumerate(markers.names):
        columns.setdefault(subject_of(name), []).append(i)
    prefixed = {person: indices for person, indices in columns.items() if person and len(indices) >= MIN_LABELS}
    people = prefixed or {"": list(range(len(markers.names)))}
    out = {}
    for person, indices in people.items():
        labels = tuple(bare(markers.names[i]) for i in indices)
        duplicates = sorted({n for n in labels if labels.count(n) > 1})
        if duplicates:
            raise ObservationError(
                f"labels appear twice{f' for {person}' if person else ''}: {', '.join(duplicates)}",
                file=markers.source or None, remedy="Name every marker of a person once.",
            )
        residual = None if markers.residual is None else markers.residual[:, indices]
        out[person] = replace(markers, names=labels, positions=markers.positions[:, indices], residual=residual)
    return out
