"""Label several subjects in one take; concatenate takes."""

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
    """Label several subjects in one take, one after the other, the one with most markers first.

    Each subject is searched among the points that are not certainly labelled yet. Columns refer to `markers`.

    Parameters
    ----------
    models : of the subjects, with different names
    markers : (F, N, 3) [m], unlabelled or wrongly labelled
    settings : default: `TakeSettings()`
    progress : (what, done, total) -> None

    Returns
    -------
    one result per model, in the order of `models`

    Raises
    ------
    ObservationError
        There is no model, two have the same name, or a subject is not found.
    """
    names = [m.name for m in models]
    if not models or len(set(names)) < len(names):
        problem = f"subjects called {', '.join(names)}" if names else "no subject"
        raise ObservationError(problem, remedy="Give every subject a name of its own: kinefit markers learn --name.")
    settings = settings or TakeSettings()
    remaining = np.array(markers.positions)
    out: dict[int, TakeIdentification] = {}
    for i in sorted(range(len(models)), key=lambda i: -len(models[i])):
        out[i] = identify_take(models[i], replace(markers, positions=remaining), settings=settings, progress=progress)
        column, is_certain = out[i].column, out[i].confidence >= settings.certain
        rows = np.broadcast_to(np.arange(len(column))[:, None], column.shape)
        remaining[rows[is_certain], column[is_certain]] = np.nan
    return [out[i] for i in range(len(models))]


def one_after_the_other(takes: Sequence[Markers]) -> Markers:
    """Concatenate takes; a label is NaN in takes without it.

    Raises
    ------
    ObservationError
        There is no take.
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
