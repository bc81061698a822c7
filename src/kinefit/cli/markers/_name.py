"""What `kinefit markers learn` and `identify` do with files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kinefit.bodies import load_body
from kinefit.bodies.marker_sets import bare, find_marker_set, load_marker_set
from kinefit.cli._results import check_file
from kinefit.cli._screen import Step, note
from kinefit.errors import KinefitError, ObservationError
from kinefit.findings import Finding
from kinefit.identification.model.from_frame import model_from_frame
from kinefit.identification.model.gate import TrainingFinding, training_gate
from kinefit.identification.model.learn import learn_model
from kinefit.identification.model.model import MarkerModel, load_model
from kinefit.identification.take.takes import TakeIdentification, TakeSettings, identify_people, one_after_the_other
from kinefit.observations import Markers

if TYPE_CHECKING:
    from kinefit.markers.first_set import FirstSet


def read_file(path: str | PathLike[str], unit: str | None) -> Markers:
    """Read markers of a C3D or TRC file, and print what the reader notes on it."""
    from kinefit.readers.markers import read_markers

    markers = read_markers(path, unit=unit)
    for text in markers.notes:
        note(f"{text}.")
    return markers


def learn_files(
    paths: Sequence[str | PathLike[str]], *, name: str | None = None, marker_set: str | None = None,
    frame: int | None = None, unit: str | None = None,
) -> tuple[MarkerModel, list[TrainingFinding]]:
    """A subject's model from labelled files, or from one frame of the first; and what the training leaves open.

    Parameters
    ----------
    name : of the subject, default: the first file's
    marker_set : of the catalogue, or a file of one; "" for none; default: the one that knows most labels
    frame : number of a frame counted from 0; -1: the one that shows most markers

    Raises
    ------
    KinefitError
        A file cannot be read, its labels do not fit the marker set, or no frame shows enough.
    """
    markers = one_after_the_other([read_file(path, unit) for path in paths])
    name = name or Path(paths[0]).stem
    if frame is None:
        model = learn_model(markers, name=name, template=marker_set)
        return model, training_gate(markers, model, marker_set=load_marker_set(marker_set) if marker_set else None)
    known = load_marker_set(marker_set) if marker_set else find_marker_set(markers.names)
    if known is None:
        raise ObservationError(
            "no marker set of the catalogue has these labels", file=str(paths[0]),
            remedy="Give one with --set (`kinefit markers set` writes one), or learn without --frame, from a take in "
            "which all joints move.",
        )
    if not -1 <= frame < len(markers):
        problem = f"--frame {frame} does not exist; the take has the frames 0 to {len(markers) - 1}"
        raise ObservationError(problem, file=str(paths[0]), remedy="Give one of these, or -1.")
    chosen = int(np.argmax(np.isfinite(markers.positions[..., 0]).sum(1))) if frame < 0 else frame
    model = model_from_frame(markers.positions[chosen], markers.names, known, name=name)
    shown = replace(markers, positions=markers.positions[chosen : chosen + 1], residual=None)
    return model, training_gate(shown, model, marker_set=known)


def write_first_set(
    paths: Sequence[str | PathLike[str]], out: str | PathLike[str], *, name: str | None = None, unit: str | None = None
) -> FirstSet:
    """A first marker set of labelled takes of one subject, written to a file (.toml): see `first_set`.

    Raises
    ------
    KinefitError
        A file cannot be read or written, or shows too little.
    """
    from kinefit._files import write_text
    from kinefit.markers.first_set import first_set

    markers = one_after_the_other([read_file(path, unit) for path in paths])
    found = first_set(markers, body=load_body("humanoid"), name=name or Path(out).stem.upper())
    write_text(Path(out), found.text)
    return found


def identify_file(
    path: str | PathLike[str],
    model: MarkerModel | str | PathLike[str] | Sequence[MarkerModel | str | PathLike[str]],
    out: str | PathLike[str] | None = None,
    *,
    settings: TakeSettings | None = None,
    unit: str | None = None,
    rest: bool = False,
    step: Step | None = None,
) -> tuple[Markers, dict[str, TakeIdentification], dict[str, Path]]:
    """Name the markers of a file and write it with labels, with a table of doubtful frames beside it.

    Parameters
    ----------
    path : C3D or TRC file; its labels, if it has any, are not looked at
    model : of the subject, or a file of it
        Several for several subjects, whose labels then bear their names ("Anna:C7").
    out : .c3d or .trc, default beside the file: NAME-named with the same ending. A C3D of a C3D keeps its analog
        channels and parameters.
    unit : of files that state none or a wrong one
    rest : whether points that are unassigned are kept, as "*1", "*2" ...

    Returns
    -------
    the labelled markers, name of the subject -> TakeIdentification, "markers" and "doubts" -> file

    Raises
    ------
    KinefitError
        A file cannot be read or written, or no subject is found.
    """
    from kinefit._files import write_rows
    from kinefit.exporters import write_markers

    source = Path(path)
    target = Path(out) if out is not None else source.with_name(f"{source.stem}-named{source.suffix}")
    check_file(target)
    given = [model] if isinstance(model, MarkerModel | str | PathLike) else list(model)
    models = [m if isinstance(m, MarkerModel) else load_model(m) for m in given]
    markers = read_file(source, unit)
    found = identify_people(models, markers, settings=settings, progress=step)
    labelled = _together(models, found, markers, rest)
    both_c3d = source.suffix.lower() == target.suffix.lower() == ".c3d"
    write_markers(labelled, target, like=source if both_c3d else None)
    doubts = target.with_name(f"{target.stem}-doubts.csv")
    named = {m.name: f for m, f in zip(models, found, strict=True)}
    write_rows(doubts, _doubts(named, markers, len(models) > 1))
    return labelled, named, {"markers": target, "doubts": doubts}


def _together(models: list[MarkerModel], found: list[TakeIdentification], markers: Markers, rest: bool) -> Markers:
    """One take of all subjects; with `rest` the points of nobody."""
    parts = [f.markers(markers) for f in found]
    if len(models) > 1:
        for i, model in enumerate(models):
            parts[i] = replace(parts[i], names=tuple(_prefixed(model.name, n) for n in parts[i].names))
    names = tuple(n for p in parts for n in p.names)
    positions = np.concatenate([p.positions for p in parts], axis=1)
    residual = None
    if markers.residual is not None:
        residual = np.concatenate([np.asarray(p.residual) for p in parts], axis=1)
    if rest:
        left = np.array(markers.positions)
        for f in found:
            frame, m = np.nonzero(f.column >= 0)
            left[frame, f.column[frame, m]] = np.nan
        keep = np.flatnonzero(np.isfinite(left[..., 0]).any(0))
        names += tuple(f"*{i + 1}" for i in range(len(keep)))
        positions = np.concatenate([positions, left[:, keep]], axis=1)
        if residual is not None and markers.residual is not None:
            residual = np.concatenate([residual, markers.residual[:, keep]], axis=1)
    return replace(markers, names=names, positions=positions, residual=residual)


def _prefixed(name: str, label: str) -> str:
    return f"{name}:{bare(label)}"


def _doubts(found: dict[str, TakeIdentification], markers: Markers, many: bool) -> Iterator[Sequence[object]]:
    """Rows of doubtful frames, worst first; frames as the file counts them."""
    rows = sorted((d.confidence, d.first, name, d) for name, f in found.items() for d in f.doubts)
    yield "first_frame", "last_frame", "first_time", "last_time", "label", "kind", "confidence"
    for _, _, name, d in rows:
        label = _prefixed(name, d.label) if many else d.label
        ends = (d.first, d.last)
        times = (f"{markers.times[frame]:.3f}" for frame in ends)
        yield *(frame + markers.first_frame for frame in ends), *times, label, d.kind, f"{d.confidence:.3f}"


def check_labels(markers: Markers, marker_set: str | None) -> list[Finding]:
    """Check sides and labels of every person of a take on the humanoid, where it has the labels (`label_findings`)."""
    from kinefit.markers.people import split_people
    from kinefit.markers.sides import label_findings

    found: list[Finding] = []
    for person in split_people(markers).values():
        with suppress(KinefitError):  # labels of a model or of a set without places on a body
            found += label_findings(load_body("humanoid"), person, marker_set)
    return found
