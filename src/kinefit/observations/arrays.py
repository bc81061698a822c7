"""Checks and conversions of the fields of records: arrays of numbers, names, sensor and time."""

from __future__ import annotations

from collections.abc import Sequence
from mmap import mmap
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape
from kinefit.errors import ObservationError

_MIN_VIEW_SHARE = 0.5  # of the array that a view keeps in memory; a smaller view is copied


def numbers(values: Any, dtype: type | None = float, what: str = "an observation") -> NDArray:
    """Copy of values as an array of numbers of any shape, of one type; None: their own type.

    Raises
    ------
    ObservationError
        The values are no array of numbers.
    """
    try:
        return np.array(values, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        problem = f"{what} holds a {type(values).__name__} that is not an array of numbers"
        raise ObservationError(problem, remedy="Give an array, or lists of numbers of one length.") from error


def frozen(
    values: Any, dtype: type = float, what: str = "an observation", shape: Sequence[int | str] | None = None,
    file: str | None = None,
) -> NDArray:  # fmt: skip
    """Read-only array of numbers: a copy, or the array itself if its owner is already read-only (`sealed`).

    Parameters
    ----------
    shape : expected shape, see `check_shape`; None: any

    Raises
    ------
    ObservationError
        The values are no array of numbers, or of another shape.
    """
    out = _read_only(values, dtype, what)
    if shape is not None:
        check_shape(out, shape, what, file=file)
    return out


def freeze(record: object, **values: Any) -> None:
    """Set fields of a frozen record, in its `__post_init__`."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def _read_only(values: Any, dtype: type, what: str) -> NDArray:
    if isinstance(values, np.ndarray) and values.dtype == dtype and not values.flags.writeable:
        owner = values.base if type(values.base) is np.ndarray else values
        alone = type(owner) is np.ndarray and (owner.base is None or isinstance(owner.base, mmap))
        if alone and not owner.flags.writeable and values.nbytes > _MIN_VIEW_SHARE * owner.nbytes:
            return values
    return sealed(numbers(values, dtype, what))


def sealed(array: NDArray) -> NDArray:
    """The array (any shape) itself, made read-only: records then do not copy it."""
    array.flags.writeable = False
    return array


def is_number(value: object) -> bool:
    """Whether a value is one real number."""
    return isinstance(value, Real)


def check_seen(sensor: Any, time: Any, names: Any = ()) -> None:
    """Check the types of a record's sensor, time and names.

    Raises
    ------
    ObservationError
        The sensor is no text, the time no number, or the names are no sequence of texts.
    """
    if not isinstance(sensor, str):
        raise ObservationError(f"a sensor called {type(sensor).__name__}", remedy="Give its name, a text.")
    if not is_number(time):
        raise ObservationError(f"a time of '{sensor}' is a {type(time).__name__}", remedy="Give seconds.")
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        problem = f"the names of '{sensor}' are a {type(names).__name__}"
        raise ObservationError(problem, remedy="Give a tuple of texts.")


def typical_depth(depth: NDArray) -> float:
    """Median depth [m] of some 300 pixels of a depth image (H, W) [m], 0 if none of them has a depth."""
    sample = depth[:: depth.shape[0] // 16 + 1, :: depth.shape[1] // 20 + 1].flatten()
    sample.sort()
    first = int(sample.searchsorted(0.0, "right"))
    return float(sample[(first + len(sample)) // 2]) if first < len(sample) else 0.0
