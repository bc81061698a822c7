"""Summary of a study: tables of takes and of ranges of motion, and one page over subjects and sessions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean, stdev

import msgspec

from kinefit._files import write_rows, write_text
from kinefit._pictures import read_picture
from kinefit.errors import ExportError
from kinefit.exporters.report import page as p
from kinefit.exporters.report.angles import with_error
from kinefit.exporters.tables import spoken
from kinefit.findings import Finding

RECORD = "batch.json"
"""File in every folder of results of a batch: the take, its key, the files and the summary rows."""

DONE, FAILED = "done", "failed"

_ID_COLUMNS = ("take", "person", "subject", "visit", "date", "movement")
_TAKE_COLUMNS = (*_ID_COLUMNS, "frames", "seconds", "quality", "lost share", "status", "error", "faults", "folder")
_RANGE_COLUMNS = (
    *_ID_COLUMNS, "coordinate", "side", "lowest [deg]", "highest [deg]", "range [deg]", "range 2 std [deg]",
    "observed share",
)  # fmt: skip
_RANGES_NOTE = (
    "In degrees, as in the report of each take: highest minus lowest angle, ± two standard deviations. Subjects and "
    "sessions: mean over takes, and the standard deviation between takes (not of the measurement) if there are two or "
    "more. * marks takes in which the angle was unobserved in some frames."
)
_GROUPED = "Subjects and sessions"
OUTCOME = "status", "frames", "seconds", "quality", "lost"


class Range(msgspec.Struct, frozen=True):
    """Range of motion of one angle [deg], as in the report.

    Parameters
    ----------
    coordinate : name without its side
    side : "left", "right" or "" for a midline angle
    lowest, highest, span : float [deg]; None if the angle is observed in fewer than two frames
    twice : float [deg], two standard deviations of the span
    share : of the frames in which it is observed
    """

    coordinate: str
    side: str
    lowest: float | None = None
    highest: float | None = None
    span: float | None = None
    twice: float | None = None
    share: float = 0.0


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One person of one take in the summary.

    Parameters
    ----------
    take : path of the take file relative to the folder of all takes
    person : int, number of the person; 0 if the take has one
    subject, visit, date, movement : from the take's `[session]`
    folder : of the results, relative to the summary; "" if there are none
    frames : int
    seconds, quality, lost : float [s], mean quality, and share of lost segments over all frames; None if failed
    status : "done" or "failed"
    error : message of the error
    notes : sentences for the user
    findings : faults of the inputs
    ranges : tuple of Range
    """

    take: str
    person: int = 0
    subject: str = ""
    visit: str = ""
    date: str = ""
    movement: str = ""
    folder: str = ""
    frames: int = 0
    seconds: float | None = None
    quality: float | None = None
    lost: float | None = None
    status: str = DONE
    error: str = ""
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    ranges: tuple[Range, ...] = ()


def failed(row: Row, error: str) -> Row:
    """The row with the status "failed" and an error."""
    return msgspec.structs.replace(row, status=FAILED, error=error)


def write_summary(rows: Sequence[Row], folder: Path) -> None:
    """Write summary.csv (a row for each take and person), ranges.csv (for each angle of them) and summary.html.

    Raises
    ------
    ExportError
        There are no rows, or they cannot be written.
    """
    if not rows:
        raise ExportError("there are no takes to summarise", file=folder, remedy="Give a pattern that matches takes.")
    table = [(*_ids(row), row.frames or "", *map(_number, (row.seconds, row.quality, row.lost)), row.status, row.error,
              " ".join(found.text for found in row.findings), row.folder) for row in rows]  # fmt: skip
    ranges = [
        (*_ids(row), r.coordinate, r.side, *map(_number, (r.lowest, r.highest, r.span, r.twice, r.share)))
        for row in rows for r in row.ranges
    ]  # fmt: skip
    write_rows(folder / "summary.csv", [_TAKE_COLUMNS, *table])
    write_rows(folder / "ranges.csv", [_RANGE_COLUMNS, *ranges])
    write_text(folder / "summary.html", summary_page(rows, folder))


def summary_page(rows: Sequence[Row], folder: Path) -> str:
    """HTML of summary.html, with links to the reports below `folder`."""
    done = [row for row in rows if row.status == DONE]
    takes, bad = len({row.take for row in rows}), len({row.take for row in rows if row.status != DONE})
    named = len({row.subject for row in rows if row.subject})
    text = f"{takes - bad} of {takes} takes are done. {named} subjects are named."
    parts: list[p.Section | str] = [
        *fault_boxes(rows),
        p.callout("bad" if not done else "warning" if bad else "good", text),
        p.section("Takes", _takes(rows, folder)),
    ]
    if done:
        parts += [p.section("Range of motion", p.paragraph(_RANGES_NOTE, small=True), by_joint(done))]
    notes = [(row.take, _person(row), note) for row in rows for note in row.notes]
    if notes:
        parts.append(p.section("Notes", p.table(("take", "person", "note"), notes, first_left=3)))
    return p.page("Summary of takes", parts)


def fault_boxes(rows: Iterable[Row]) -> list[p.Html]:
    """A callout for each fault of the inputs, with its take and person."""
    return [
        p.finding_callout(found, f"{row.take}{f', person {row.person}' if row.person else ''}")
        for row in rows for found in row.findings
    ]  # fmt: skip


def _takes(rows: Sequence[Row], folder: Path) -> p.Html:

    cells = [
        (_linked(row, folder, row.take), _person(row), row.subject, row.visit, row.date, row.movement, *outcome(row),
         row.error) for row in rows
    ]  # fmt: skip
    return p.table(("take", "person", *_ID_COLUMNS[2:], *OUTCOME, "error"), cells, first_left=7)


def outcome(row: Row) -> tuple[str, ...]:
    """The cells of the columns `OUTCOME`; apart from the status empty for a failed row."""
    quality = "" if row.quality is None else p.shaded(f"{row.quality:.2f}", 1.0 - row.quality)
    lost = "" if row.lost is None else f"{100 * row.lost:.1f} %"
    return row.status, str(row.frames or ""), "" if row.seconds is None else f"{row.seconds:.2f}", quality, lost


def by_joint(rows: Sequence[Row]) -> p.Html:
    """A menu of coordinates, each with tables of ranges by take, and by subject and session."""
    names = list(dict.fromkeys(r.coordinate for row in rows for r in row.ranges))
    pages = {}
    for name in names:
        by_row = [(row, {r.side: r for r in row.ranges if r.coordinate == name}) for row in rows]
        sides = ("",) if any("" in ranges for _, ranges in by_row) else ("left", "right")
        head = ["range"] if sides == ("",) else ["left range", "right range", "left less right"]
        takes = [(row.take, _person(row), row.subject, row.visit, *_cells(ranges, sides)) for row, ranges in by_row]
        groups = _groups(by_row, sides)
        pages[spoken(name).capitalize()] = p.joined(
            p.table(("take", "person", "subject", "visit", *head), takes, first_left=4),
            p.table(("subject", "visit", "date", "takes", *head), groups, first_left=3, caption=_GROUPED),
        )
    return p.chooser("Angle", pages)


def _cells(ranges: dict[str, Range], sides: Sequence[str]) -> list[str]:
    """Range of each side, and their difference."""

    def cell(r: Range | None) -> str:
        if r is None or r.span is None or r.twice is None:
            return "not observed"
        return with_error(r.span, r.twice) + ("" if r.share > 0.995 else "*")

    out = [cell(ranges.get(side)) for side in sides]
    if len(sides) == 2:
        difference = _difference(ranges)
        out.append("–" if difference is None else with_error(*difference))
    return out


def _difference(ranges: dict[str, Range]) -> tuple[float, float] | None:
    """Left less right, with two standard deviations; None if a side was not observed."""
    left, right = ranges.get("left"), ranges.get("right")
    if left is None or right is None or left.span is None or right.span is None:
        return None
    return left.span - right.span, math.hypot(left.twice or 0.0, right.twice or 0.0)


def _groups(by_row: Iterable[tuple[Row, dict[str, Range]]], sides: Sequence[str]) -> list[tuple[str, ...]]:
    """A table row for each subject and session."""
    groups: dict[tuple[str, str, str], list[dict[str, Range]]] = {}
    for row, ranges in by_row:
        groups.setdefault((row.subject, row.visit, row.date), []).append(ranges)
    out = []
    for (subject, visit, date), members in sorted(groups.items()):
        spans = [[r.span for ranges in members if (r := ranges.get(side)) and r.span is not None] for side in sides]
        if len(sides) == 2:
            spans.append([difference[0] for ranges in members if (difference := _difference(ranges))])
        out.append((subject or "–", visit or "–", date or "–", str(len(members)), *map(_average, spans)))
    return out


def _average(values: Sequence[float]) -> str:
    if not values:
        return "not observed"
    return f"{mean(values):.0f}".replace("-", "−") + (f" ± {stdev(values):.0f}" if len(values) > 1 else "")


def _ids(row: Row) -> tuple[str, ...]:
    return row.take, _person(row), row.subject, row.visit, row.date, row.movement


def _person(row: Row) -> str:
    return str(row.person or "")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def write_people_report(rows: Sequence[Row], folder: Path, *, pictures: bool) -> Path:
    """Write report.html into the folder of a take with several people, whose results are in its folders `person-K`.

    Parameters
    ----------
    rows : one for each person, failed ones included
    folder : of the take's results
    pictures : bool, whether each person's montage is shown

    Raises
    ------
    ExportError
        The page cannot be written.
    """
    done = [row for row in rows if row.status == DONE]
    text = f"{len(done)} of {len(rows)} people in view were tracked. Each of them has its own results and report."
    cells = [(_linked(row, folder, f"person {row.person}"), *outcome(row)) for row in rows]
    parts: list[p.Section | str] = [
        *fault_boxes(rows), p.callout("good" if len(done) == len(rows) else "warning" if done else "bad", text),
        p.table(("person", *OUTCOME), cells, first_left=2),
    ]  # fmt: skip
    parts += [p.section(f"Person {row.person}", *_parts_of_person(row, folder, pictures)) for row in rows]
    if done:
        parts.append(p.section("Range of motion", by_joint(done)))
    path = folder / "report.html"
    write_text(path, p.page(rows[0].take, parts, subtitle=f"{len(rows)} people"))
    return path


def _parts_of_person(row: Row, folder: Path, pictures: bool) -> list[str]:
    """The montage of all cameras, the error and the notes of one person, and a link to the report."""
    montage = folder / row.folder / "montage.png"
    has_montage = pictures and row.folder and montage.is_file()
    parts: list[str] = [p.picture(read_picture(montage), width=1400)] if has_montage else []
    parts += [p.callout("bad", row.error)] if row.error else []
    parts += [p.bullets(row.notes)] if row.notes else []
    linked = _linked(row, folder, f"Report of person {row.person}")
    return [*parts, p.paragraph(linked)] if row.status == DONE else parts


def _linked(row: Row, folder: Path, text: str) -> str:
    """A link to the row's report below a folder; the text alone where there is none."""
    report = f"{row.folder}/report.html"
    return p.file_link(report, text) if row.folder and (folder / report).is_file() else text
