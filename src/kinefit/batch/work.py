"""The job of a worker: track one take into its folder, unless it is done already; returns rows of the summary."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from kinefit._files import regular
from kinefit.batch.find import RECORD
from kinefit.batch.one import Choices, asked_take, people_of, track_person
from kinefit.batch.outcome import DONE, Range, Row, failed
from kinefit.batch.people_report import write_people_report
from kinefit.batch.processes import progress
from kinefit.errors import KinefitError, printable
from kinefit.findings import of_provenance

if TYPE_CHECKING:
    from kinefit.motion import Motion
    from kinefit.readers.take.file import Take

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
    from kinefit.readers.take.cameras import is_uncalibrated
    from kinefit.takes.missing import last_found
    from kinefit.tracking.checkpoints.checkpoint import key_of

    start, said = Row(take=job.label), list[str]()
    try:
        with _warnings_in(said):
            take = asked_take(job.take, job.choices)
        start = _of_session(start, take)
        key = key_of(take, **asdict(replace(job.choices, restart=False)))
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


def _of_session(row: Row, take: Take) -> Row:
    entries = take.session.stated
    keys = ("subject", "visit", "date", "movement")
    return msgspec.structs.replace(row, **{key: entries.get(key, "") for key in keys})


def of_motion(row: Row, motion: Motion, notes: tuple[str, ...]) -> Row:
    """The row with a motion's length, quality, ranges of motion and findings."""
    from kinefit.exporters.report.ranges import ranges_of

    ranges = []
    for coordinate, sides in ranges_of(motion).items():
        for side, found in sides.items():
            if found is None:
                ranges.append(Range(coordinate, side))
                continue
            ends = found.lowest[0], found.highest[0]
            ranges.append(Range(coordinate, side, *ends, *found.span, found.share))
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
    from kinefit._files import write_bytes

    write_bytes(path, msgspec.json.encode(record))
