"""Records of the summary's tables: one row for each person of each take, with ranges of motion."""

from __future__ import annotations

import msgspec

from kinefit.findings import Finding

DONE, FAILED = "done", "failed"


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
