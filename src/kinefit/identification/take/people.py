"""Several subjects in one take, and takes put one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kinefit._arguments import checked
from kinefit.errors import ObservationError
from kinefit.identification.model.model import MarkerModel
from kinefit.identification.take.naming import Step
from kinefit.identification.take.takes import TakeIdentification, TakeSettings, identify_take
from kinefit.observations import Markers


@checked
def identify_people(
    models: Sequence[MarkerModel], markers: Markers, *, settings: TakeSettings | None = None,
    progress: Step | None = None,
) -> list[TakeIdentification]:
    """Names for several subjects in one take: each among the points that those before did not take for certain.

    The subject with most markers comes first. Columns of a result are those of `markers`.

    Raises
    ------
    ObservationError
        No model, two of one name, or a subject of whom nothing is found.
    """
    names = [m.name for m in models]
    if not models or len(set(names)) < len(names):
        told = f"subjects called {', '.join(names)}" if names else "no subject"
        raise ObservationError(told, remedy="Give every subject a name of its own: kinefit markers learn --name.")
    settings = settings or TakeSettings()
    rest = np.array(markers.positions)
    out: dict[int, TakeIdentification] = {}
    for i in sorted(range(len(models)), key=lambda i: -len(models[i])):
        out[i] = identify_take(models[i], replace(markers, positions=rest), settings=settings, progress=progress)
        column, sure = out[i].column, out[i].confidence >= settings.certain
        rows = np.broadcast_to(np.arange(len(column))[:, None], column.shape)
        rest[rows[sure], column[sure]] = np.nan
    return [out[i] for i in range(len(models))]


def one_after_the_other(takes: Sequence[Markers]) -> Markers:
    """Takes as one; labels that not all of them have are not seen in the others.

    Raises
    ------
    ObservationError
        No take.
    """
    if not takes:
        raise ObservationError("no take", remedy="Name at least one.")
    names = tuple(dict.fromkeys(n for t in takes for n in t.names))
    positions = np.full((sum(map(len, takes)), len(names), 3), np.nan)
    at = 0
    for t in takes:
        positions[at : at + len(t), [names.index(n) for n in t.names]] = t.positions
        at += len(t)
    return Markers(names, takes[0].rate, positions, up=takes[0].up, source=takes[0].source, unit=takes[0].unit)
