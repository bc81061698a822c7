"""Label the unlabelled markers of a take by the subject's model before tracking (`[[markers]] model = ...`)."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike

import numpy as np

from kinefit.errors import located
from kinefit.identification.model.files import load_model
from kinefit.identification.model.model import MarkerModel
from kinefit.identification.take.naming import Step
from kinefit.identification.take.takes import TakeSettings, identify_take
from kinefit.observations import Markers
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations


def named_markers(
    markers: Markers, model: MarkerModel | str | PathLike[str], *, settings: TakeSettings | None = None,
    progress: Step | None = None,
) -> Markers:
    """Label markers by a subject's model, whatever the names of their columns and wherever trajectories break.

    Only measured points with a certain label are kept: gaps are not filled, and unassigned points are excluded.

    Parameters
    ----------
    model : of the subject, or its file: see `learn_model`, `kinefit markers learn`
    settings : TakeSettings; `certain` is the least confidence (0 to 1) of a label that is kept
    progress : (what, done, total) -> None

    Returns
    -------
    Markers of the model's M labels with the rate, unit and events of `markers`; NaN where a label is unknown.

    Raises
    ------
    ObservationError
        No frame shows three points, or the model is of another subject.
    FileError
        The file is no marker model.
    """
    model = model if isinstance(model, MarkerModel) else load_model(model)
    settings = replace(settings or TakeSettings(), fill=0.0, fill_alone=0.0)
    found = identify_take(model, markers, settings=settings, progress=progress)
    out = found.markers(markers)
    is_certain = found.confidence >= settings.certain
    return replace(out, positions=np.where(is_certain[..., None], out.positions, np.nan))


def with_names(take: Take, seen: Observations, *, progress: Step | None = None) -> Observations:
    """Label the markers of every `[[markers]]` entry of a take that has a `model`.

    Raises
    ------
    ObservationError, FileError
        As `named_markers`, with the entry.
    """
    if not any(entry.model for entry in take.markers):
        return seen
    out = []
    for entry, markers in zip(take.markers, seen.markers):
        with located(take.path, f"markers {entry.file.name}"):
            out.append(named_markers(markers, entry.model, progress=progress) if entry.model else markers)
    return replace(seen, markers=tuple(out))
