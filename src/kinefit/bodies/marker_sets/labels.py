"""Match the marker labels of a recording to the names of a set or a body."""

from __future__ import annotations

from collections.abc import Iterable


def bare(label: str) -> str:
    """A label without its subject's prefix: "Anna:LASI" -> "LASI"."""
    return label.rpartition(":")[2].strip()


def subject_of(label: str) -> str:
    """A label's prefix, the subject's name: "Anna:LASI" -> "Anna"; "" for none."""
    return label.rpartition(":")[0].strip()


def plain(label: str) -> str:
    """Normalise a label for comparison: no prefix, lower case, without . _ - and blanks."""
    return "".join(c for c in bare(label).lower() if c not in "._- ")


def matched(labels: Iterable[str], names: Iterable[str]) -> tuple[str | None, ...]:
    """Match each label to a name; None without a match.

    A name equal to the label without its prefix is preferred. Else prefix, letter case, . _ - and blanks are ignored,
    unless two names differ only by them.
    """
    names = tuple(names)
    exact, loose = set(names), dict[str, str | None]()
    for name in names:
        loose[plain(name)] = name if loose.get(plain(name), name) == name else None
    return tuple(bare(n) if bare(n) in exact else loose.get(plain(n)) for n in labels)
