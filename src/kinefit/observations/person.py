"""Select the target person among several: the forms that a take, an argument or an option may use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError

FORMS = '"first", "moving", "largest", "nearest X Y Z" [m], or a number from 1'
"""Allowed forms, for messages."""

_MAX_DIGITS = 6  # of a person's number; Python refuses to read some thousand of them


@dataclass(frozen=True, eq=False)
class PersonChoice:
    """Criterion that selects the target person among several.

    Parameters
    ----------
    way : "first" (most detections), "moving" (largest motion of the points), "largest" (in the images), "nearest" (to
        `place`) or "number"
    number : int, from 1, in the list of `kinefit track`
    place : (3,) [m] in the world, for "nearest"
    """

    way: str = "first"
    number: int = 1
    place: NDArray | None = None

    @classmethod
    def of(cls, person: int | str | None) -> PersonChoice:
        """Parse a user's choice; None is "first".

        Raises
        ------
        ObservationError
            The choice is none of `FORMS`.
        """
        if person is None:
            return cls()
        if isinstance(person, bool) or not isinstance(person, int | str):
            raise _wrong(person)
        word, *more = str(person).split() or [""]
        if word.isascii() and word.isdigit() and not more and len(word) <= _MAX_DIGITS and int(word) > 0:
            return cls("number", int(word))
        if word in ("first", "moving", "largest") and not more:
            return cls(word)
        if word == "nearest" and len(more) == 3:
            try:
                place = np.array([float(value) for value in more])
            except ValueError:
                raise _wrong(person) from None
            if np.isfinite(place).all():
                return cls(word, place=place)
        raise _wrong(person)


def _wrong(person: object) -> ObservationError:
    return ObservationError(f"person = {str(person)[:60]!r}", remedy=f"Give {FORMS}.")
