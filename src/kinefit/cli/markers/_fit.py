"""What `kinefit markers learn`, `identify` and `fit` do with files: names, a body on them, all formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from kinefit._files import write_rows, write_text
from kinefit.bodies import Body, PointSet, load_body
from kinefit.bodies.marker_sets import bare, find_marker_set, load_marker_set, matched
from kinefit.bodies.motion import Motion, rotation_between_up
from kinefit.cli import _screen
from kinefit.errors import KinefitError, ObservationError, located
from kinefit.exporters import write_markers, write_osim, write_trc
from kinefit.exporters.gait.plates import standing_mass, stood_on
from kinefit.exporters.report.feet import foot_findings
from kinefit.exporters.report.report import write_report
from kinefit.exporters.skeletons.common import plain_names
from kinefit.findings import FINDINGS, Finding, as_records, faults_of
from kinefit.fitting.markers.first_set import FirstSet, first_set
from kinefit.fitting.markers.sides import label_findings, refuse_wrong_sides
from kinefit.fitting.markers.subject import MarkerSubject, fit_marker_subject, split_people
from kinefit.fitting.tracking.video import fit_markers
from kinefit.markers.model.from_frame import model_from_frame
from kinefit.markers.model.learn import TrainingFinding, learn_model, training_gate
from kinefit.markers.model.model import MarkerModel, load_model
from kinefit.markers.take import takes
from kinefit.observations import Markers
from kinefit.readers.markers import read_markers
from kinefit.rigs.diagnostics.quick import motion_findings
from kinefit.takes.batch.results import FORMATS, check_formats, description, write_results


def read_file(path: str | PathLike[str], unit: str | None) -> Markers:
    """Read markers of a C3D or TRC file, and print what the reader notes on it."""
    markers = read_markers(path, unit=unit)
    for text in markers.notes:
        _screen.note(f"{text}.")
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
    markers = takes.one_after_the_other([read_file(path, unit) for path in paths])
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
    markers = takes.one_after_the_other([read_file(path, unit) for path in paths])
    found = first_set(markers, body=load_body("humanoid"), name=name or Path(out).stem.upper())
    write_text(Path(out), found.text)
    return found


def identify_file(
    path: str | PathLike[str],
    model: MarkerModel | str | PathLike[str] | Sequence[MarkerModel | str | PathLike[str]],
    out: str | PathLike[str] | None = None,
    *,
    settings: takes.TakeSettings | None = None,
    unit: str | None = None,
    rest: bool = False,
    step: _screen.Step | None = None,
    method: Callable[..., takes.TakeIdentification] = takes.identify_take,
) -> tuple[Markers, dict[str, takes.TakeIdentification], dict[str, Path]]:
    """Name the markers of a file and write it with labels, with a table of doubtful frames next to it.

    Parameters
    ----------
    path : C3D or TRC file; its labels, if it has any, are not looked at
    model : of the subject, or a file of it
        Several for several subjects, whose labels then bear their names ("Anna:C7").
    out : .c3d or .trc, default next to the file: NAME-named with the same ending. A C3D of a C3D keeps its analog
        channels and parameters.
    unit : of files that state none or a wrong one
    rest : whether points that are unassigned are kept, as "*1", "*2" ...
    method : labels one subject; called as `identify_take`

    Returns
    -------
    the labelled markers, name of the subject -> TakeIdentification, "markers" and "doubts" -> file

    Raises
    ------
    KinefitError
        A file cannot be read or written, or no subject is found.
    """
    source = Path(path)
    target = Path(out) if out is not None else source.with_name(f"{source.stem}-named{source.suffix}")
    _screen.check_file(target)
    given = [model] if isinstance(model, MarkerModel | str | PathLike) else list(model)
    models = [m if isinstance(m, MarkerModel) else load_model(m) for m in given]
    markers = read_file(source, unit)
    found = takes.identify_people(models, markers, settings=settings, progress=step, method=method)
    labelled = _together(models, found, markers, rest)
    both_c3d = source.suffix.lower() == target.suffix.lower() == ".c3d"
    write_markers(labelled, target, like=source if both_c3d else None)
    doubts = target.with_name(f"{target.stem}-doubts.csv")
    named = {m.name: f for m, f in zip(models, found, strict=True)}
    write_rows(doubts, _doubts(named, markers, len(models) > 1))
    return labelled, named, {"markers": target, "doubts": doubts}


def _together(
    models: list[MarkerModel], found: list[takes.TakeIdentification], markers: Markers, rest: bool
) -> Markers:
    """One take of all subjects; with `rest` unassigned points, too."""
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


def _doubts(found: dict[str, takes.TakeIdentification], markers: Markers, many: bool) -> Iterator[Sequence[object]]:
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
    found: list[Finding] = []
    for person in split_people(markers).values():
        with suppress(KinefitError):  # labels of a model or of a set without places on a body
            found += label_findings(load_body("humanoid"), person, marker_set)
    return found


WRITTEN = ("motion", "csv", "bvh", "glb", "trc", "mot", "osim", "markers", "report")
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
    smooth : bool, whether all frames are fitted together, see `fit_markers`.
    mass : float [kg], optional, of the subject; default: about that of people of the height.
    """

    body: str | Path = "humanoid"
    static: Path | None = None
    marker_set: str | None = None
    height: float | None = None
    up: str | None = None
    limits: bool = True
    sides: str | None = None
    smooth: bool = True
    mass: float | None = None


def fit_file(
    path: Path, out: Path | None = None, options: MarkerFitOptions | None = None, *, unit: str | None = None,
    formats: Iterable[str] = WRITTEN, step: _screen.Step | None = None, notes: list[Finding] | None = None,
) -> dict[str, tuple[Motion, dict[str, Path]]]:  # fmt: skip
    """Fit a file of labelled markers and write what was found.

    Parameters
    ----------
    path : C3D or TRC file with labels; several people bear their names as prefixes ("Anna:LASI").
    out : folder, default next to the file: NAME-kinefit; with several people one folder for each in it.
    unit : str, optional, of files that state none or a wrong one.
    formats : names of `FORMATS`, "markers" for the measured ones as OpenSim takes them, and "report".
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
    step, formats, options = step or (lambda what, done, total: None), tuple(formats), options or MarkerFitOptions()
    folder = out if out is not None else path.with_name(f"{path.stem}-kinefit")
    check_formats(name for name in formats if name not in ("markers", "report"))
    _screen.check_folder(folder)
    generic = load_body(options.body)
    people = read_people(path, unit, options.sides)
    if options.mass is not None:
        if len(people) > 1:
            problem = f"one mass for {len(people)} people: {', '.join(people)}"
            raise ObservationError(problem, file=path, remedy="Leave out the mass, or fit one person's file at a time.")
        generic = replace(generic, mass=options.mass)
    trials = read_people(options.static, unit, options.sides) if options.static else {}
    found: dict[str, tuple[Motion, dict[str, Path]]] = {}
    for person, whole in people.items():
        markers = whole.trimmed()
        left_out = markers.notes[len(whole.notes) :]
        for text in left_out:
            _screen.note(f"{text}.")
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
            subject, markers, limits=options.limits, up=options.up, smooth=options.smooth, progress=step
        )
        others = [one for name, one in people.items() if name != person]
        plates, shared = stood_on(motion, others) if others else (motion.plates, [])
        motion = replace(motion, plates=plates)
        if options.mass is None and not others:
            motion = motion.with_mass(standing_mass([trial.plates if trial else (), markers.plates], motion.body))
        findings = [*faults_of(found_labels), *motion_findings(motion, options.height), *shared, *foot_findings(motion)]
        wrong = (found for found in findings if found.severity != "note")
        motion = replace(motion, provenance={**motion.provenance, FINDINGS: as_records(wrong)})
        if notes is not None:
            notes += [*findings, *(f for f in found_labels if f.severity == "note")]
        files: dict[str, Path] = {}
        own = folder / person if len(people) > 1 else folder
        worn = replace(worn_body(subject, markers.names), mass=motion.body.mass)
        plain = [name for name in formats if name not in ("markers", "osim", "report", "trc")]
        write_results(motion, own, plain, step, files)
        if "trc" in formats:
            write_trc(motion, own / FORMATS.get("trc").file, worn.landmarks)  # the points of body.osim
            files["trc"] = own / FORMATS.get("trc").file
        if "osim" in formats:
            write_osim(worn, own / FORMATS.get("osim").file)
            files["osim"] = own / FORMATS.get("osim").file
        if "markers" in formats:
            R = rotation_between_up(motion.up, "y")
            names, x = tuple(plain_names(markers.names)), markers.positions @ R.T  # the names that body.osim has
            seen = replace(markers, names=names, positions=x, up="y")
            write_markers(seen, own / _MARKERS, unit="m")
            files["markers"] = own / _MARKERS
        if "report" in formats:
            links = {file.relative_to(own).as_posix(): description(name) for name, file in files.items()}
            trimmed = [("warning", f"{text}.", "") for text in left_out]
            files["report"] = write_report(motion, own / "report.html", files=links, findings=trimmed)
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
    markers = read_file(file, unit)
    if sides:
        with located(file):
            markers = markers.sided(sides)
    return split_people(markers)
