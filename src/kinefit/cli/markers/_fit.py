"""What `kinefit markers fit` does: a marker file onto a body, and the results in every format."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kinefit.batch import results
from kinefit.bodies import Body, PointSet, load_body
from kinefit.bodies.marker_sets import matched, read_sides
from kinefit.cli import _screen
from kinefit.cli._screen import Step
from kinefit.cli.markers._name import read_file
from kinefit.errors import ExportError, located
from kinefit.exporters.skeletons.common import plain_names
from kinefit.findings import FINDINGS, Finding, as_records, faults_of
from kinefit.markers.subject import MarkerSubject
from kinefit.motion import Motion, rotation_between_up
from kinefit.observations import Markers

FORMATS = ("motion", "mot", "osim", "trc", "bvh", "glb", "markers")
"""Formats that are written where none are named."""

_MARKERS = "markers.trc"  # what was measured, in OpenSim's world: with body.osim and its marker set, IK runs there too


@dataclass(frozen=True)
class MarkerFitOptions:
    """How markers are fitted.

    Parameters
    ----------
    body : a name of the catalogue or a body file: generic, it is brought to the subject's size.
    static : C3D or TRC file, optional
        A static trial of the same subject (or several people), from which size and offsets come together with the file.
    marker_set : str, optional
        Name of a marker set or a file of one; default: the one that shares most labels.
    height : float [m], optional, of the subject, barefoot.
    up : str, optional, vertical axis of the world where the file does not state it; default: found from the markers.
    limits : bool, whether joints stay within their ranges.
    sides : str, optional, one of `bodies.marker_sets.SIDES`: how sides are read; default: as labelled, checked.
    """

    body: str | Path = "humanoid"
    static: Path | None = None
    marker_set: str | None = None
    height: float | None = None
    up: str | None = None
    limits: bool = True
    sides: str | None = None


def fit_file(
    path: Path, out: Path | None = None, options: MarkerFitOptions | None = None, *, unit: str | None = None,
    formats: Iterable[str] = FORMATS, step: Step | None = None, notes: list[Finding] | None = None,
) -> dict[str, tuple[Motion, dict[str, Path]]]:  # fmt: skip
    """Fit a file of labelled markers and write what was found.

    Parameters
    ----------
    path : C3D or TRC file with labels; several people bear their names as prefixes ("Anna:LASI").
    out : folder, default beside the file: NAME-kinefit; with several people one folder for each in it.
    unit : str, optional, of files that state none or a wrong one.
    formats : names of `results.NAMES`, and "markers" for the measured ones as OpenSim takes them.
    step : (what, done, total) -> None, called as the fit advances.
    notes : filled with what is to be said about labels, once for each person.

    Returns
    -------
    person -> (Motion, format -> file); one person without prefix is called "".

    Raises
    ------
    KinefitError
        A file cannot be read or written, too few labels are known, no frame shows enough (see `fit_markers`), or left
        and right are wrong (see `label_findings`).
    """
    from kinefit.diagnostics.quick import motion_findings
    from kinefit.exporters import write_markers, write_osim, write_trc
    from kinefit.markers.fit import fit_markers
    from kinefit.markers.sides import label_findings, refuse_wrong_sides
    from kinefit.markers.subject import fit_marker_subject

    step, formats, options = step or (lambda what, done, total: None), tuple(formats), options or MarkerFitOptions()
    folder = out if out is not None else path.with_name(f"{path.stem}-kinefit")
    unknown = [name for name in formats if name not in (*results.NAMES, "markers")]
    if unknown:
        raise ExportError(_screen.no_format(unknown[0], (*results.NAMES, "markers")), remedy="Correct --formats.")
    _screen.check_folder(folder)
    generic = load_body(options.body)
    people = read_people(path, unit, options.sides)
    trials = read_people(options.static, unit, options.sides) if options.static else {}
    found: dict[str, tuple[Motion, dict[str, Path]]] = {}
    for person, markers in people.items():
        trial = trials.get(person) or (next(iter(trials.values())) if len(trials) == 1 == len(people) else None)
        found_labels: tuple[Finding, ...] = ()
        for file, trial_markers in ((options.static, trial), (path, markers)):
            if trial_markers is not None:
                with located(file, person or None):
                    found_labels = label_findings(generic, trial_markers, options.marker_set, sides=options.sides)
                    refuse_wrong_sides(found_labels)
        subject = fit_marker_subject(
            generic, [markers] if trial is None else [trial, markers], options.marker_set, height=options.height,
            progress=step,
        )  # fmt: skip
        motion = fit_markers(
            subject.body, markers, subject.marker_set, sigma=subject.sigma, limits=options.limits, up=options.up
        )
        findings = [*faults_of(found_labels), *motion_findings(motion, options.height)]
        motion = replace(motion, provenance={**motion.provenance, FINDINGS: as_records(findings)})
        if notes is not None:
            notes += [*findings, *(f for f in found_labels if f.severity == "note")]
        files: dict[str, Path] = {}
        own = folder / person if len(people) > 1 else folder
        worn = worn_body(subject, markers.names)
        plain = [name for name in formats if name not in ("markers", "osim", "trc")]
        results.write_results(motion, own, plain, step, files)
        if "trc" in formats:
            write_trc(motion, own / results.NAMES["trc"], worn.landmarks)  # the points of body.osim
            files["trc"] = own / results.NAMES["trc"]
        if "osim" in formats:
            write_osim(worn, own / results.NAMES["osim"])
            files["osim"] = own / results.NAMES["osim"]
        if "markers" in formats:
            R = rotation_between_up(motion.up, "y")
            names, x = tuple(plain_names(markers.names)), markers.positions @ R.T  # the names that body.osim has
            seen = replace(markers, names=names, positions=x, up="y")
            write_markers(seen, own / _MARKERS, unit="m")
            files["markers"] = own / _MARKERS
        found[person] = motion, files
    return found


def worn_body(subject: MarkerSubject, labels: Iterable[str]) -> Body:
    """The subject's body with its fitted markers among the landmarks, named as in the recording.

    Parameters
    ----------
    subject : MarkerSubject
    labels : of the recording. A landmark of the same name is left out, as OpenSim would take it for the marker.
    """
    labels, body, points = tuple(labels), subject.body, subject.points
    found = {label: name for label, name in zip(labels, matched(labels, points.names)) if name is not None}
    taken = set(plain_names(labels))
    names = body.landmarks.names
    kept = body.landmarks.select(tuple(n for n, plain in zip(names, plain_names(names)) if plain not in taken))
    worn = points.select(tuple(found.values()))
    segments, places = ([getattr(p, key) for p in (worn, kept)] for key in ("segments", "points"))
    return replace(
        body, landmarks=PointSet((*found, *kept.names), np.concatenate(segments), np.concatenate(places))
    )  # fmt: skip


def read_people(file: Path, unit: str | None, sides: str | None = None) -> dict[str, Markers]:
    """The people of a file, by the prefix of their labels, with left and right as `sides` states (see `read_sides`)."""
    from kinefit.markers.people import split_people

    markers = read_file(file, unit)
    if sides:
        with located(file):
            names, positions = read_sides(markers.names, markers.positions, sides)
        markers = replace(markers, names=names, positions=positions)
    return split_people(markers)
