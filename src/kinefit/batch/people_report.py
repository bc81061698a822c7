"""Report page of a take with several people: outcome of each, with a link to each one's report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kinefit.batch.outcome import DONE, Row
from kinefit.batch.summary import OUTCOME, by_joint, fault_boxes, outcome

if TYPE_CHECKING:
    from kinefit.exporters.report.page import Html


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
    from kinefit._files import write_text
    from kinefit.exporters.report import page as p

    done = [row for row in rows if row.status == DONE]
    text = f"{len(done)} of {len(rows)} people in view were tracked. Each of them has its own results and report."
    parts: list[p.Section | str] = [
        *fault_boxes(rows), p.callout("good" if len(done) == len(rows) else "warning" if done else "bad", text),
        _people(rows, folder),
    ]  # fmt: skip
    parts += [p.section(f"Person {row.person}", *_person(row, folder, pictures)) for row in rows]
    if done:
        parts.append(p.section("Range of motion", by_joint(done)))
    path = folder / "report.html"
    write_text(path, p.page(rows[0].take, parts, subtitle=f"{len(rows)} people"))
    return path


def _people(rows: Sequence[Row], folder: Path) -> Html:
    from kinefit.exporters.report import page as p

    return p.table(("person", *OUTCOME), [(_linked(row, folder), *outcome(row)) for row in rows], first_left=2)


def _person(row: Row, folder: Path, pictures: bool) -> list[str]:
    """The montage of all cameras, the error and the notes of one person, and a link to the report."""
    from kinefit._pictures import read_picture
    from kinefit.exporters.report import page as p

    montage = folder / row.folder / "montage.png"
    has_montage = pictures and row.folder and montage.is_file()
    parts: list[str] = [p.picture(read_picture(montage), width=1400)] if has_montage else []
    if row.error:
        parts.append(p.callout("bad", row.error))
    if row.notes:
        parts.append(p.bullets(row.notes))
    return [*parts, p.paragraph(_linked(row, folder, "Report of person"))] if row.status == DONE else parts


def _linked(row: Row, folder: Path, text: str = "person") -> str:
    from kinefit.exporters.report import page as p

    report, text = f"{row.folder}/report.html", f"{text} {row.person}"
    return p.file_link(report, text) if row.folder and (folder / report).is_file() else text
