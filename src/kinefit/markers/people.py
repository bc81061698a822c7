"""Several people in one marker file: told apart by the prefix of their labels ("Anna:LASI")."""

from __future__ import annotations

from dataclasses import replace

from kinefit._arguments import checked
from kinefit.bodies.marker_sets import bare, subject_of
from kinefit.errors import ObservationError
from kinefit.observations import Markers

FEWEST = 4
"""Labels that a person bears at least; fewer belong to a thing ("Sync:Sync")."""


@checked
def split_people(markers: Markers) -> dict[str, Markers]:
    """Markers of every person by name, labels without the name; one person without any is called "".

    Labels without a prefix stand beside those with one only where they are no person's: they are left out then.

    Raises
    ------
    ObservationError
        A label is there twice for one person.
    """
    columns: dict[str, list[int]] = {}
    for i, name in enumerate(markers.names):
        columns.setdefault(subject_of(name), []).append(i)
    named = {person: own for person, own in columns.items() if person and len(own) >= FEWEST}
    kept = named or {"": list(range(len(markers.names)))}
    out = {}
    for person, own in kept.items():
        labels = tuple(bare(markers.names[i]) for i in own)
        twice = sorted({n for n in labels if labels.count(n) > 1})
        if twice:
            raise ObservationError(
                f"labels appear twice{f' for {person}' if person else ''}: {', '.join(twice)}",
                file=markers.source or None, remedy="Name every marker of a person once.",
            )
        residual = None if markers.residual is None else markers.residual[:, own]
        out[person] = replace(markers, names=labels, positions=markers.positions[:, own], residual=residual)
    return out
