"""The outcome of each person of each take, as the summary's tables list it."""

from __future__ import annotations

import msgspec

from kinefit.findings import Finding

DONE, FAILED = "done", "failed"


class Range(msgspec.Struct, frozen=True):
    """How far one angle moved [deg], as the report tells it.

    Parameters
    ----------
    coordinate : name without its side
    side : "left", "right" or "" for the body's middle
    lowest, highest, span : float; None where it was observed in no two frames
    twice : float, two standard deviations of the span
    share : of the frames in which it was observed
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
    take : path of the take file from the folder of all takes on
    person : int, which of several; 0 where the take was not parted by people
    subject, visit, date, movement : as `[session]` states them
    folder : of the results, from the summary on; "" where there are none
    frames : int
    seconds, quality, lost : float; mean quality, and the share of segments and frames that are lost; None if failed
    status : "done" or "failed"
    error : what went wrong
    notes : what the command says besides
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
    """A row of what went wrong."""
    return msgspec.structs.replace(row, status=FAILED, error=error)
