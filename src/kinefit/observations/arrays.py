"""What records of observations hold, in the types that they say: arrays of numbers, names, a sensor and a time."""

from __future__ import annotations

from collections.abc import Sequence
from mmap import mmap
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape
from kinefit.errors import ObservationError

_SHARE = 0.5  # of an array, of which a part keeps the whole in memory; less is copied


def numbers(values: Any, dtype: type | None = float, what: str = "an observation") -> NDArray:
    """A copy of one type (None: their own); ObservationError where the values are no numbers."""
    try:
        return np.array(values, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        problem = f"{what} holds a {type(values).__name__} that is no array of numbers"
        raise ObservationError(problem, remedy="Give an array, or lists of numbers of one length.") from error


def frozen(
    values: Any, dtype: type = float, what: str = "an observation", shape: Sequence[int | str] | None = None,
    file: str | None = None,
) -> NDArray:  # fmt: skip
    """Numbers that nobody can write: a copy, or the array itself where its owner is read-only already (`sealed`).

    ObservationError where they are no numbers, or of another shape than is asked for: see `check_shape`.
    """
    out = _read_only(values, dtype, what)
    if shape is not None:
        check_shape(out, shape, what, file=file)
    return out


def freeze(record: object, **values: Any) -> None:
    """Set fields of a frozen record that is being made."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def _read_only(values: Any, dtype: type, what: str) -> NDArray:
    if isinstance(values, np.ndarray) and values.dtype == dtype and not values.flags.writeable:
        owner = values.base if type(values.base) is np.ndarray else values
        alone = type(owner) is np.ndarray and (owner.base is None or isinstance(owner.base, mmap))
        if alone and not owner.flags.writeable and values.nbytes > _SHARE * owner.nbytes:
            return values
    return sealed(numbers(values, dtype, what))


def sealed(array: NDArray) -> NDArray:
    """An array of one's own, made read-only: records take it as it is."""
    array.flags.writeable = False
    return array


def is_number(value: object) -> bool:
    """Whether a value is one real number."""
    return isinstance(value, Real)


def check_seen(sensor: Any, time: Any, names: Any = ()) -> None:
    """ObservationError where a sensor's name is no text, a time no number, or names are no sequence of texts."""
    if not isinstance(sensor, str):
        raise ObservationError(f"a sensor called {type(sensor).__name__}", remedy="Give its name, a text.")
    if not is_number(time):
        raise ObservationError(f"a time of '{sensor}' is a {type(time).__name__}", remedy="Give seconds.")
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        problem = f"the names of '{sensor}' are a {type(names).__name__}"
        raise ObservationError(problem, remedy="Give a tuple of texts.")


def typical_depth(depth: NDArray) -> float:
    """Median [m] of what was measured in some 300 pixels of an image, 0 where that is nothing."""
    few = depth[:: depth.shape[0] // 16 + 1, :: depth.shape[1] // 20 + 1].flatten()
    few.sort()
    first = int(few.searchsorted(0.0, "right"))
    return float(few[(first + len(few)) // 2]) if first < len(few) else 0.0
