"""What a whole study shows: tables of takes and of ranges of motion, and one page over subjects and sessions."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING

from kinefit.batch.outcome import DONE, Row
from kinefit.errors import ExportError

if TYPE_CHECKING:
    from kinefit.batch.outcome import Range
    from kinefit.exporters.report.page import Html

_WHO = ("take", "person", "subject", "visit", "date", "movement")
_ROW = (*_WHO, "frames", "seconds", "quality", "lost share", "status", "error", "faults", "folder")
_RANGE = (
    *_WHO, "coordinate", "side", "lowest [deg]", "highest [deg]", "range [deg]", "range 2 std [deg]", "observed share",
)  # fmt: skip


def write_summary(rows: Sequence[Row], folder: Path) -> None:
    """Write summary.csv (a row for each take and person), ranges.csv (for each angle of them) and summary.html.

    Raises
    ------
    ExportError
        There are no rows, or they cannot be written.
    """
    from kinefit.exporters.atomic import write_text

    if not rows:
        raise ExportError("no take to summarise", file=folder, remedy="Name takes by a pattern that matches some.")
    table = [(*_who(row), row.frames or "", *map(_number, (row.seconds, row.quality, row.lost)), row.status, row.error,
              " ".join(found.text for found in row.findings), row.folder) for row in rows]  # fmt: skip
    ranges = [
        (*_who(row), one.coordinate, one.side, *map(_number, (one.lowest, one.highest, one.span, one.twice, one.share)))
        for row in rows for one in row.ranges
    ]  # fmt: skip
    write_text(folder / "summary.csv", _csv(_ROW, table))
    write_text(folder / "ranges.csv", _csv(_RANGE, ranges))
    write_text(folder / "summary.html", summary_page(rows, folder))


def summary_page(rows: Sequence[Row], folder: Path) -> str:
    """The text of summary.html, whose links lead to the reports below `folder`."""
    from kinefit.exporters.report import page as p

    done = [row for row in rows if row.status == DONE]
    takes, bad = len({row.take for row in rows}), len({row.take for row in rows if row.status != DONE})
    named = len({row.subject for row in rows if row.subject})
    told = f"{takes - bad} of {takes} takes are done; {named} subjects are named."
    parts: list[p.Section | str] = [
        *fault_boxes(rows),
        p.callout("bad" if not done else "warning" if bad else "good", told),
        p.section("Takes", _takes(rows, folder)),
    ]
    if done:
        parts += [p.section("Range of motion", p.paragraph(_ABOUT, small=True), by_joint(done))]
    notes = [(row.take, _person(row), note) for row in rows for note in row.notes]
    if notes:
        parts.append(p.section("Notes", p.table(("take", "person", "note"), notes, first_left=3)))
    return p.page("Summary of takes", parts)


def fault_boxes(rows: Iterable[Row]) -> list[Html]:
    """A box for each fault of the inputs, with the take and the person that it is about."""
    from kinefit.exporters.report.findings import finding_callout

    return [
        finding_callout(found, f"{row.take}{f', person {row.person}' if row.person else ''}")
        for row in rows for found in row.findings
    ]  # fmt: skip


_ABOUT = (
    "Degrees, as the report of each take has them: highest less lowest angle, ± two standard deviations. Subjects and "
    "sessions: mean over takes, and the standard deviation between them (of the takes, not of the measurement) where "
    "there are two or more. * marks takes in which the angle was not observed all the time."
)


_GROUPED = "Subjects and sessions"


def _takes(rows: Sequence[Row], folder: Path) -> Html:
    from kinefit.exporters.report import page as p

    cells = []
    for row in rows:
        report = f"{row.folder}/report.html"
        linked = p.file_link(report, row.take) if row.folder and (folder / report).is_file() else row.take
        cells.append((linked, _person(row), row.subject, row.visit, row.date, row.movement, *outcome(row), row.error))
    columns = ("take", "person", *_WHO[2:], *OUTCOME, "error")
    return p.table(columns, cells, first_left=7)


OUTCOME = "status", "frames", "seconds", "quality", "lost"


def outcome(row: Row) -> tuple[str, ...]:
    """The cells of `OUTCOME`, empty where a row failed."""
    from kinefit.exporters.report import page as p

    quality = "" if row.quality is None else p.shaded(f"{row.quality:.2f}", 1.0 - row.quality)
    lost = "" if row.lost is None else f"{100 * row.lost:.1f} %"
    return row.status, str(row.frames or ""), "" if row.seconds is None else f"{row.seconds:.2f}", quality, lost


def by_joint(rows: Sequence[Row]) -> Html:
    """A menu of coordinates: each over takes, and over subjects and sessions."""
    from kinefit.exporters.report import page as p
    from kinefit.exporters.report.names import spoken

    names = list(dict.fromkeys(one.coordinate for row in rows for one in row.ranges))
    pages = {}
    for name in names:
        of = [(row, {one.side: one for one in row.ranges if one.coordinate == name}) for row in rows]
        sides = ("",) if any("" in found for _, found in of) else ("left", "right")
        head = ["range"] if sides == ("",) else ["left range", "right range", "left less right"]
        takes = [(row.take, _person(row), row.subject, row.visit, *_cells(found, sides)) for row, found in of]
        groups = _groups(of, sides)
        pages[spoken(name).capitalize()] = p.joined(
            p.table(("take", "person", "subject", "visit", *head), takes, first_left=4),
            p.table(("subject", "visit", "date", "takes", *head), groups, first_left=3, caption=_GROUPED),
        )
    return p.chooser("Angle", pages)


def _cells(found: dict[str, Range], sides: Sequence[str]) -> list[str]:
    """Range of each side, and their difference."""
    from kinefit.exporters.report.ranges import told

    def cell(one: Range | None) -> str:
        if one is None or one.span is None or one.twice is None:
            return "not observed"
        return told(one.span, one.twice) + ("" if one.share > 0.995 else "*")

    out = [cell(found.get(side)) for side in sides]
    if len(sides) == 2:
        less = _difference(found)
        out.append("–" if less is None else told(*less))
    return out


def _difference(found: dict[str, Range]) -> tuple[float, float] | None:
    """Left less right, with two standard deviations; None where one was not observed."""
    left, right = found.get("left"), found.get("right")
    if left is None or right is None or left.span is None or right.span is None:
        return None
    return left.span - right.span, math.hypot(left.twice or 0.0, right.twice or 0.0)


def _groups(of: Iterable[tuple[Row, dict[str, Range]]], sides: Sequence[str]) -> list[tuple[str, ...]]:
    """A row for each subject and session."""
    groups: dict[tuple[str, str, str], list[dict[str, Range]]] = {}
    for row, found in of:
        groups.setdefault((row.subject, row.visit, row.date), []).append(found)
    out = []
    for (subject, visit, date), members in sorted(groups.items()):
        spans = [[one.span for found in members if (one := found.get(side)) and one.span is not None] for side in sides]
        if len(sides) == 2:
            spans.append([less[0] for found in members if (less := _difference(found))])
        out.append((subject or "–", visit or "–", date or "–", str(len(members)), *map(_average, spans)))
    return out


def _average(values: Sequence[float]) -> str:
    if not values:
        return "not observed"
    return f"{mean(values):.0f}".replace("-", "−") + (f" ± {stdev(values):.0f}" if len(values) > 1 else "")


def _who(row: Row) -> tuple[str, ...]:
    return row.take, _person(row), row.subject, row.visit, row.date, row.movement


def _person(row: Row) -> str:
    return str(row.person or "")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return out.getvalue()
