"""The one rule for labels of markers: which name of a set, or of a body, a label of a recording stands for."""

from __future__ import annotations

from collections.abc import Iterable


def bare(label: str) -> str:
    """A label without its subject's prefix: "Anna:LASI" -> "LASI"."""
    return label.rpartition(":")[2].strip()


def subject_of(label: str) -> str:
    """A label's prefix, the subject's name: "Anna:LASI" -> "Anna"; "" where there is none."""
    return label.rpartition(":")[0].strip()


def plain(label: str) -> str:
    """What a label is compared by: without its prefix, letter case, and the marks . _ - and blank."""
    return "".join(c for c in bare(label).lower() if c not in "._- ")


def matched(labels: Iterable[str], names: Iterable[str]) -> tuple[str | None, ...]:
    """The name that each label stands for; None where there is none.

    A name that is the label without its prefix comes first. Else prefix, letter case, and the marks . _ - and blank do
    not count, unless two names differ by them alone.
    """
    names = tuple(names)
    exact, loose = set(names), dict[str, str | None]()
    for name in names:
        loose[plain(name)] = name if loose.get(plain(name), name) == name else None
    return tuple(bare(n) if bare(n) in exact else loose.get(plain(n)) for n in labels)
