"""What a check finds: one fault, doubt, note or good news, in plain words, with what would mend it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["fault", "doubt", "note", "good"]
SEVERITIES: tuple[Severity, ...] = ("fault", "doubt", "note", "good")
"""Worst first: a fault spoils results; a doubt may; a note is worth knowing; good was looked at and is in order."""


@dataclass(frozen=True)
class Finding:
    """One thing that a check has to say.

    Parameters
    ----------
    severity : "fault", "doubt", "note" or "good"
    kind : str
        What it is about, for programs: "bias", "time", "sides", "picture", "lens", "up", "scale" ...
    text : str
        What is the matter, in plain words with numbers.
    cameras : tuple of str
        Cameras that it is about; empty for the whole recording.
    confidence : str
        How sure that is, and why; empty where the text is a plain fact.
    remedy : str
        What would fix it: the line to write, the command to run; empty where nothing need be done.
    """

    severity: Severity
    kind: str
    text: str
    cameras: tuple[str, ...] = ()
    confidence: str = ""
    remedy: str = ""


def ranked(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Faults first, good news last; otherwise in the order given."""
    return tuple(sorted(findings, key=lambda found: SEVERITIES.index(found.severity)))


def listed(names: Iterable[str]) -> str:
    """Names as "a", "a and b" or "a, b and c"."""
    names = list(names)
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1] if names else "none"
