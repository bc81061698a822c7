"""Match the marker labels of a recording to the names of a set or a body."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError, choices

PREFIXES = (("Right", "Left"), ("right", "left"), ("R", "L"), ("r", "l"), ("r", "L"), ("R", "l"))
SUFFIXES = (("_R", "_L"), ("_r", "_l"), (".R", ".L"), (".r", ".l"), ("_Right", "_Left"), ("R", "L"))

SIDES = ("labelled", "exchanged", "mirrored-x", "mirrored-y", "mirrored-z")
"""How a recording's sides are read: as labelled, with left and right labels exchanged, or with one axis negated."""


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


def side_pairs(labels: Sequence[str]) -> dict[str, str]:
    """Pairs of right and left labels that differ by their side only: a dictionary from right to left."""
    known, out = set(labels), dict[str, str]()
    for label in labels:
        for right, left in PREFIXES:
            image = left + label[len(right) :]
            if label.startswith(right) and label not in out and image in known and image != label:
                out[label] = image
        for right, left in SUFFIXES:
            image = label[: len(label) - len(right)] + left
            if label.endswith(right) and label not in out and image in known and image != label:
                out[label] = image
    return out


def read_sides(labels: Sequence[str], positions: NDArray, sides: str) -> tuple[tuple[str, ...], NDArray]:
    """Labels and positions (F, K, 3) of a recording whose sides are read as one of `SIDES` says.

    Raises
    ------
    ObservationError
        Another word, or no pairs of left and right labels to exchange.
    """
    if sides not in SIDES:
        raise ObservationError(choices("value of sides", sides, SIDES))
    if sides.startswith("mirrored"):
        return tuple(labels), positions * np.where(np.arange(3) == "xyz".index(sides[-1]), -1.0, 1.0)
    names = {(subject_of(n), bare(n)): n for n in labels}
    pairs = side_pairs([bare(n) for n in labels]) if sides == "exchanged" else {}
    if sides == "exchanged" and not pairs:
        raise ObservationError("no pairs of left and right labels to exchange", remedy="Remove sides.")
    image = pairs | {left: right for right, left in pairs.items()}
    return tuple(names.get((subject_of(n), image.get(bare(n), "")), n) for n in labels), positions
