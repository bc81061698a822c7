"""What a check finds: one fault, doubt, note or good news, in plain words, with what would mend it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

Severity = Literal["fault", "doubt", "note", "good"]
SEVERITIES: tuple[Severity, ...] = ("fault", "doubt", "note", "good")
"""Worst first: a fault spoils results; a doubt may; a note is worth knowing; good was looked at and is in order."""

_GUESSES = ("Guess", "A guess", "Uncertain")  # how the confidence of a guess begins

FINDINGS = "findings"
"""Key of `Motion.provenance`: the faults that `track` found in its inputs, as mappings of a `Finding`'s parts."""

NOTES = "notes"
"""Key of `Motion.provenance`: sentences on what to do about clocks that are off, marker labels that are ignored or do
not decide left and right, and a person who is as tall as few adults are."""

INVERTED = "upside down"
"""Key of `Motion.provenance`: the depth camera in which people are explained better upside down."""


@dataclass(frozen=True)
class Edit:
    """One line of a take file: a key of one of its tables.

    Parameters
    ----------
    table, key : str
        "take" and "up", "camera" and "time_offset" ...
    value : str or None
        As TOML has it; None takes the key away.
    entry : str or int
        Which `[[table]]`: the name of its camera or sensor, or its number from 0. "" for a single `[table]`.
    """

    table: str
    key: str
    value: str | None
    entry: str | int = ""

    @property
    def place(self) -> str:
        """The table in words: [take], [[camera]] cam02, [[markers]] 2."""
        if self.entry == "":
            return f"[{self.table}]"
        return f"[[{self.table}]] {self.entry + 1 if isinstance(self.entry, int) else self.entry}"

    def __str__(self) -> str:
        return f"no {self.key}" if self.value is None else f"{self.key} = {self.value}"


def in_words(edits: Sequence[Edit], into: str = " into ") -> str:
    """Edits as "a = 1 and b = 2 into [[camera]] cam02; c = 3 into [take]"."""
    places = {edit.place: [str(e) for e in edits if e.place == edit.place] for edit in edits}
    return "; ".join(f"{' and '.join(lines)}{into}{place}" for place, lines in places.items())


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
    edits : tuple of Edit
        The lines of the take that mend it; without a remedy in words, they are the remedy.
    alike : str
        What else would look the same.
    """

    severity: Severity
    kind: str
    text: str
    cameras: tuple[str, ...] = ()
    confidence: str = ""
    remedy: str = ""
    edits: tuple[Edit, ...] = ()
    alike: str = ""

    def __post_init__(self) -> None:
        if self.edits and not self.remedy:
            object.__setattr__(self, "remedy", f"Write {in_words(self.edits)}.")

    def __str__(self) -> str:
        return " ".join(part for part in (self.text, self.confidence, self.remedy) if part)


def faults_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings that spoil results, without repetitions."""
    return tuple(dict.fromkeys(found for found in findings if found.severity == "fault"))


def fixes(findings: Iterable[Finding], written: Iterable[Edit] = ()) -> tuple[Edit, ...]:
    """What `kinefit check --fix` writes: the edits of faults that are no guess, of keys not written before."""
    known = {(edit.table, edit.entry, edit.key) for edit in written}
    sure = [f for f in findings if f.severity == "fault" and not f.confidence.startswith(_GUESSES)]
    edits = dict.fromkeys(edit for found in sure for edit in found.edits)
    return tuple(edit for edit in edits if (edit.table, edit.entry, edit.key) not in known)


def ranked(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Faults first, good news last; otherwise in the order given."""
    return tuple(sorted(findings, key=lambda found: SEVERITIES.index(found.severity)))


def as_records(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Findings as `Motion.provenance` holds them."""
    return [{**asdict(found), "cameras": list(found.cameras)} for found in findings]


def of_provenance(provenance: Mapping[str, Any]) -> tuple[Finding, ...]:
    """The findings that a motion's `provenance` holds; none where nothing was looked at, or where they are damaged."""
    try:
        return msgspec.convert(provenance.get(FINDINGS, ()), tuple[Finding, ...])
    except msgspec.ValidationError:
        return ()


def listed(names: Iterable[str], most: int = 99) -> str:
    """Names as "a", "a and b" or "a, b and c"; those beyond `most` are counted."""
    names = list(names)
    if len(names) > most + 1:
        names = [*names[:most], f"{len(names) - most} more"]
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1] if names else "none"


def runs_of(flags: NDArray, gap: int = 1) -> list[tuple[int, int]]:
    """(start, stop) of the runs of true flags (F,); runs with fewer than `gap` frames between them are one."""
    return joined(np.flatnonzero(flags), gap)


def joined(at: NDArray, gap: int = 1) -> list[tuple[int, int]]:
    """(start, stop) of the runs of ascending numbers."""
    parts = np.split(at, np.flatnonzero(np.diff(at) > max(gap, 1)) + 1) if len(at) else []
    return [(int(part[0]), int(part[-1]) + 1) for part in parts]


def frame_ranges(frames: Iterable[int], most: int = 12) -> str:
    """Frames in ascending order as "3, 7-9"; at most so many stretches."""
    texts = [f"{a}" if a + 1 == b else f"{a}-{b - 1}" for a, b in joined(np.array(list(frames), int))]
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more stretches" if len(texts) > most else "")
