"""Findings of a check on a page: each in a box, with how sure it is and what to do."""

from __future__ import annotations

from collections.abc import Iterable

from kinefit.exporters.report import page as p
from kinefit.findings import Finding

_LOOKS = {"fault": "bad", "doubt": "warning", "note": "note", "good": "good"}
_TITLES = {"fault": "Fault", "doubt": "Doubt", "note": "Note", "good": "In order"}


def finding_callout(found: Finding, where: str = "") -> p.Html:
    """One finding; `where` says of what, on a page about several takes."""
    parts = [p.paragraph(found.confidence, small=True)] if found.confidence else []
    if found.remedy:
        parts.append(p.paragraph(p.strong("What to do: "), found.remedy))
    head = p.joined(p.strong(f"{where}{': ' if where else ''}{_TITLES[found.severity]}. "), found.text)
    return p.callout(_LOOKS[found.severity], head, *parts)


def fault_sections(faults: Iterable[Finding]) -> list[p.Section]:
    """The first section of a report on a motion whose inputs have faults; none where they have none."""
    boxes = [finding_callout(found) for found in faults]
    if not boxes:
        return []
    text = "The results below follow from inputs with these faults. Correct them and track again."
    return [p.section("Faults of the inputs", p.paragraph(text), *boxes)]
