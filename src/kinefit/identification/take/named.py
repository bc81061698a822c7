"""Markers without names in a take: named by the subject's model before they are tracked (`[[markers]] model = ...`)."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike

import numpy as np

from kinefit.errors import KinefitError
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
    """Markers with the labels of a subject's model, whatever their columns are called and wherever they break.

    Only what was measured and is named for certain is kept: gaps are not filled, and ghosts are left out.

    Parameters
    ----------
    model : of the subject, or a file of it: see `learn_model`, `kinefit markers learn`
    settings : TakeSettings, of which `certain` is the least confidence of a name that counts
    progress : (what, done, total) -> None

    Returns
    -------
    Markers of the model's M labels, with rate, unit, events of those given; NaN where a label is not known.

    Raises
    ------
    ObservationError
        No frame shows three points, or the model is of another subject.
    FileError
        No file of a model.
    """
    model = model if isinstance(model, MarkerModel) else load_model(model)
    settings = replace(settings or TakeSettings(), fill=0.0, fill_alone=0.0)
    found = identify_take(model, markers, settings=settings, progress=progress)
    out = found.markers(markers)
    sure = found.confidence >= settings.certain
    return replace(out, positions=np.where(sure[..., None], out.positions, np.nan))


def with_names(take: Take, seen: Observations, *, progress: Step | None = None) -> Observations:
    """What a take's sensors saw, with names for the markers of every `[[markers]]` that has a `model`.

    Raises
    ------
    ObservationError, FileError
        As `named_markers`, with the entry.
    """
    if not any(entry.model for entry in take.markers):
        return seen
    out = []
    for entry, markers in zip(take.markers, seen.markers):
        try:
            out.append(named_markers(markers, entry.model, progress=progress) if entry.model else markers)
        except KinefitError as error:
            place = f"markers {entry.file.name}"
            raise type(error)(error.problem, file=error.file or take.path, place=place, remedy=error.remedy) from error
    return replace(seen, markers=tuple(out))
