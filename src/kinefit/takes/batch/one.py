"""Track one take into a folder of results: find its people, track each, and write the results."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from kinefit._files import regular, write_bytes
from kinefit.bodies.motion import Motion
from kinefit.errors import KinefitError, TakeError, printable
from kinefit.exporters.report.angles import ranges_of
from kinefit.findings import NOTES, of_provenance
from kinefit.fitting.multiview import followed
from kinefit.fitting.tracking import cameras
from kinefit.fitting.tracking.checkpoints.checkpoint import Checkpoint, key_of
from kinefit.fitting.tracking.take_recording import floor_sentences
from kinefit.fitting.tracking.video import TrackingInterrupted
from kinefit.readers.take.cameras import is_uncalibrated
from kinefit.readers.take.checks import check_enough, check_take
from kinefit.readers.take.file import Take, read_take
from kinefit.readers.take.kinds import kinds_of
from kinefit.takes.batch import results
from kinefit.takes.batch.corrections import OUTDATED, inputs_entry, is_outdated
from kinefit.takes.batch.processes import progress
from kinefit.takes.batch.summary import DONE, RECORD, Range, Row, failed, write_people_report
from kinefit.takes.in_view import InView, people_in_view
from kinefit.takes.missing import last_found, prepared
from kinefit.takes.preparing.detecting import Tell
from kinefit.takes.track import settings_of, track_take


@dataclass(frozen=True)
class Choices:
    """Choices of results for a take.

    Parameters
    ----------
    formats : names of `FORMATS`
    overlays : bool, whether overlay videos are written
    overlay_skin : bool, whether they show the person's skin, too
    report : bool, whether report.html is written
    pictures : images in report and overlays: "full" or "none"
    smooth : bool, whether the whole take is smoothed
    contacts : bool, whether soles on a level floor are constrained to rest
    lag : float [s], see `track`
    person : target person; None: the one that the take names, else every person in view
    restart : bool, whether an unfinished earlier run is discarded
    hide_faces : bool, whether all faces are hidden in images; a take may set it too
    """

    formats: tuple[str, ...] = results.DEFAULT_FORMATS
    overlays: bool = True
    overlay_skin: bool = False
    report: bool = True
    pictures: str = "full"
    smooth: bool = True
    contacts: bool = False
    lag: float | None = None
    person: str | None = None
    restart: bool = False
    hide_faces: bool = False

    @property
    def draws(self) -> bool:
        """Whether overlays are written."""
        return self.overlays and self.pictures != "none"


@dataclass(frozen=True, eq=False)
class TrackedPerson:
    """The tracked motion of one person of a take.

    Parameters
    ----------
    motion : Motion
    notes : sentences for the user
    total : int, number of frames of the take if Ctrl-C stopped the run before the last; else 0
    """

    motion: Motion
    notes: tuple[str, ...]
    total: int = 0


def asked_take(path: Path, choices: Choices) -> Take:
    """Read a take file, with the choices' person and hidden faces.

    Raises
    ------
    KinefitError
        The take or the named person is invalid, or a format cannot be written.
    """
    results.check_formats(choices.formats)
    take = read_take(path)
    take = replace(take, hide_faces=take.hide_faces or choices.hide_faces)
    if choices.person is not None:
        take = replace(take, person=choices.person)
        try:
            check_take(take)
        except KinefitError as error:  # the option's fault: the take alone is valid
            raise type(error)(error.problem, place="--person", remedy=error.remedy) from None
    check_enough(take)
    return take


def check_drawable(take: Take, *, skin: bool = False) -> None:
    """Check that a take has images for overlays, or for overlays with a skin.

    Raises
    ------
    TakeError
        It has neither videos nor depth; for a skin, no videos.
    """
    videos = any(camera.video for camera in take.cameras)
    if skin and not videos:
        problem = "the take has no video for a skin on overlays"
        raise TakeError(problem, file=take.path, remedy="Leave out --overlay-skin.")
    if not (take.depth or videos):
        raise TakeError("the take has no video or depth for overlays", file=take.path, remedy="Leave out --overlays.")


def people_of(take: Take, out: Path, step: results.Step, tell: Tell) -> tuple[InView | None, list[tuple[Take, Path]]]:
    """Find the people to track: the people in view (None if the take names one), and a take and a folder for each.

    What the take lacks is found first, as by `prepared`.
    """
    take = prepared(take, step, tell)
    view = people_in_view(take) if take.person is None else None
    people = len(view.people) if view else 0
    if people < 2:
        return view, [(take, out)]
    assert view is not None
    numbers = [k for k, one in enumerate(view.people, start=1) if one.image_of is None]
    return view, [(replace(take, person=k, name=f"{take.name}-person-{k}"), out / f"person-{k}") for k in numbers]


def track_person(
    take: Take, out: Path, choices: Choices, *, view: InView | None, step: results.Step, tell: Tell,
    files: dict[str, Path],
) -> TrackedPerson:  # fmt: skip
    """Track one person of a take and write the results; written files are added to `files`.

    An interrupted run (`out/unfinished`) is continued, unless the choices restart it.

    Raises
    ------
    KinefitError
        Tracking or writing fails.
    """
    notes: list[str] = []
    how: dict[str, Any] = {"smooth": choices.smooth, "contacts": choices.contacts, "lag": choices.lag}
    total, inputs = 0, inputs_entry(take)
    with ExitStack() as work:
        key, kinds = key_of(take, **how), kinds_of(take)
        unfinished = work.enter_context(Checkpoint(out / "unfinished", key, restart=choices.restart, kinds=kinds))
        for sentence in unfinished.said():
            tell(sentence)
        step("reading", 0, 0)

        def read(what: str, done: int, count: int) -> None:
            step("reading", 1, 1)
            step(what, done, count)

        try:
            motion, seen = track_take(
                take, **how, checkpoint=unfinished, view=view, progress=read
            )
            notes += [*seen.notes, *cameras.contradiction_sentences(motion.provenance["contradictions"])]
            notes += followed.sentences(motion.provenance, asked=take.person is not None)
            notes += cameras.sentences(motion.provenance, settings_of(take).camera_errors)
            notes += [*motion.provenance.get(NOTES, ()), *floor_sentences(motion.provenance)]
        except TrackingInterrupted as stopped:
            motion, total = stopped.motion, stopped.total
        motion = replace(motion, provenance=results.provenance(take, **inputs, **motion.provenance))
        if is_outdated(motion.provenance, take.path):  # changed meanwhile
            notes.append(f"{OUTDATED}.")
        results.write_results(motion, out, choices.formats, step, files)
        if choices.draws and not total:
            results.write_overlays(motion, take, seen, out, step, files, skin=choices.overlay_skin)
        if choices.report and not total:
            results.write_track_report(motion, take, seen, out, step, files, choices.pictures, notes)
        if not total:
            unfinished.remove()
    return TrackedPerson(motion, tuple(notes), total)


class _TakeRecord(msgspec.Struct, frozen=True):
    take: str
    key: str
    files: tuple[str, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class TakeJob:
    """One take to be tracked.

    Parameters
    ----------
    take : Path, absolute
    label : name in the summary
    out : Path, folder of its results
    folder : the same, relative to the summary
    choices : Choices
    """

    take: Path
    label: str
    out: Path
    folder: str
    choices: Choices


def work(job: TakeJob) -> tuple[Row, ...]:
    """Track a take with all its people, or reuse an earlier run's results; returns a row for each person.

    Faults of the take are in its rows. Other errors are raised, since they may not occur again.
    """
    start, said = Row(take=job.label), list[str]()
    try:
        with _warnings_in(said):
            take = asked_take(job.take, job.choices)
        keys = ("subject", "visit", "date", "movement")
        start = msgspec.structs.replace(start, **{key: take.session.stated.get(key, "") for key in keys})
        exporters = [plugin.code_digest for name in job.choices.formats for plugin in results.FORMATS.plugins(name)]
        key = key_of(take, **asdict(replace(job.choices, restart=False)), exporters=exporters)
        complete = not is_uncalibrated(last_found(take))  # whoever deletes found cameras wants others
    except KinefitError as error:
        return (failed(start, str(error)),)
    known = None if job.choices.restart else _read(job.out / RECORD)
    if known is not None and known.take != printable(job.take):
        problem = f"{job.folder} has the results of another take ({known.take})"
        return (failed(start, f"{problem}. Give another folder with --out, or overwrite them with --restart."),)
    if known is not None and known.key == key and complete and all((job.out / name).exists() for name in known.files):
        return known.rows
    rows, made = _tracked(job, take, start, said)
    if all(row.status == DONE for row in rows):
        _write(job.out / RECORD, _TakeRecord(printable(job.take), key, tuple(made), rows))
    return rows


@contextmanager
def _warnings_in(said: list[str]) -> Iterator[None]:
    """Collect warnings about old keys of a take into `said`."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", FutureWarning)
        try:
            yield
        finally:
            said += [str(w.message) for w in warned if issubclass(w.category, FutureWarning)]


def _tracked(job: TakeJob, take: Take, start: Row, said: list[str]) -> tuple[tuple[Row, ...], list[str]]:
    """Track all people of a take; returns a row for each, and the written files relative to the folder of results."""
    try:
        view, people = people_of(take, job.out, progress, said.append)
    except KinefitError as error:
        return (failed(start, str(error)),), []
    rows, made = [], []
    for k, (person, folder) in enumerate(people, 1):
        alone = len(people) == 1
        row = msgspec.structs.replace(
            start, person=0 if alone else k, folder=job.folder if alone else f"{job.folder}/person-{k}"
        )
        if not alone:
            folder.mkdir(parents=True, exist_ok=True)
        files: dict[str, Path] = {}
        try:
            done = track_person(person, folder, job.choices, view=view, step=progress, tell=progress, files=files)
        except KinefitError as error:  # the other people are tracked nevertheless
            rows.append(failed(msgspec.structs.replace(row, folder=""), str(error)))
            continue
        made += [path.relative_to(job.out).as_posix() for path in files.values()]
        rows.append(of_motion(row, done.motion, (*said, *done.notes)))
    if len(rows) > 1 and job.choices.report:
        page_rows = [msgspec.structs.replace(r, take=take.name, folder=r.folder and f"person-{r.person}") for r in rows]
        made.append(write_people_report(page_rows, job.out, pictures=job.choices.draws).name)
    return tuple(rows), made


def of_motion(row: Row, motion: Motion, notes: tuple[str, ...]) -> Row:
    """The row with a motion's length, quality, ranges of motion and findings."""
    ranges = [
        Range(coordinate, side, *((r.lowest[0], r.highest[0], *r.span, r.share) if r else ()))
        for coordinate, sides in ranges_of(motion).items() for side, r in sides.items()
    ]  # fmt: skip
    return msgspec.structs.replace(
        row, frames=len(motion), seconds=len(motion) / motion.rate, quality=float(motion.quality.mean()),
        lost=float(motion.lost.mean()), notes=notes, findings=of_provenance(motion.provenance), ranges=tuple(ranges),
    )  # fmt: skip


def _read(path: Path) -> _TakeRecord | None:
    """The record of an earlier run; None if there is none that can be read."""
    try:
        return msgspec.json.decode(regular(path).read_bytes(), type=_TakeRecord)
    except (OSError, msgspec.MsgspecError):
        return None


def _write(path: Path, record: _TakeRecord) -> None:

    write_bytes(path, msgspec.json.encode(record))
