"""What a worker does with one take: track it into its folder, unless that is done already; rows of the summary."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from kinefit.batch.find import RECORD
from kinefit.batch.one import Choices, asked_take, people_of, track_person
from kinefit.batch.outcome import DONE, Range, Row, failed
from kinefit.batch.people_report import write_people_report
from kinefit.errors import KinefitError
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
    label : what the summary calls it
    out : Path, folder of its results
    folder : the same, from the summary on
    choices : Choices
    """

    take: Path
    label: str
    out: Path
    folder: str
    choices: Choices


def work(job: TakeJob) -> tuple[Row, ...]:
    """Track a take and everybody in it, or take over what an earlier run made of the same; a row for each person.

    What is wrong with the take stands in its rows. Other errors are raised, as they may not come again.
    """
    from kinefit.tracking.checkpoints.checkpoint import key_of

    start, said = Row(take=job.label), list[str]()
    try:
        with _warnings_in(said):
            take = asked_take(job.take, job.choices)
        start = _of_session(start, take)
        key = key_of(take, **asdict(replace(job.choices, restart=False)))
    except KinefitError as error:
        return (failed(start, str(error)),)
    known = None if job.choices.restart else _read(job.out / RECORD)
    if known is not None and known.take != str(job.take):
        told = f"the results of another take lie in {job.folder} ({known.take})"
        return (failed(start, f"{told}. Name another folder by --out, or write over them by --restart."),)
    if known is not None and known.key == key and all((job.out / name).exists() for name in known.files):
        return known.rows
    rows, made = _tracked(job, take, start, said)
    if all(row.status == DONE for row in rows):
        _write(job.out / RECORD, _TakeRecord(str(job.take), key, tuple(made), rows))
    return rows


@contextmanager
def _warnings_in(said: list[str]) -> Iterator[None]:
    """Enter what is warned of in between: old keys of a take."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", FutureWarning)
        try:
            yield
        finally:
            said += [str(one.message) for one in warned if issubclass(one.category, FutureWarning)]


def _tracked(job: TakeJob, take: Take, start: Row, said: list[str]) -> tuple[tuple[Row, ...], list[str]]:
    """A row for each person, and the files that were made, from the folder of results on."""
    try:
        view, people = people_of(take, job.out, _silent, said.append)
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
            done = track_person(person, folder, job.choices, view=view, step=_silent, tell=_silent, files=files)
        except KinefitError as error:  # of one person: the others are tracked all the same
            rows.append(failed(msgspec.structs.replace(row, folder=""), str(error)))
            continue
        made += [path.relative_to(job.out).as_posix() for path in files.values()]
        rows.append(of_motion(row, done.motion, (*said, *done.notes)))
    if len(rows) > 1 and job.choices.report:
        own = [msgspec.structs.replace(r, take=take.name, folder=r.folder and f"person-{r.person}") for r in rows]
        made.append(write_people_report(own, job.out, pictures=job.choices.draws).name)
    return tuple(rows), made


def _silent(*told: object) -> None:
    pass


def _of_session(row: Row, take: Take) -> Row:
    told = take.session.told
    return msgspec.structs.replace(row, **{key: told.get(key, "") for key in ("subject", "visit", "date", "movement")})


def of_motion(row: Row, motion: Motion, notes: tuple[str, ...]) -> Row:
    """A row with what a motion shows."""
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
    """What an earlier run noted; None where there is nothing that can be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=_TakeRecord)
    except (OSError, msgspec.MsgspecError):
        return None


def _write(path: Path, record: _TakeRecord) -> None:
    from kinefit.exporters.atomic import write_bytes

    write_bytes(path, msgspec.json.encode(record))
