"""Arguments of public functions, held against their annotations: a wrong type is told by name before any work."""

from __future__ import annotations

import inspect
import os
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from kinefit.errors import ObservationError

F = TypeVar("F", bound=Callable[..., Any])


def checked(function: F) -> F:
    """The same function, which refuses arguments of other types than it states.

    Held are classes, numbers, texts, paths, lists and mappings of these, arrays of numbers and functions.

    Raises
    ------
    ObservationError
        When it is called: the argument's name, its type and what is wanted.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def call(*args: Any, **more: Any) -> Any:
        given = signature.bind(*args, **more).arguments
        hints = _hints(function)
        for name, value in given.items():
            kind = signature.parameters[name].kind
            several = kind in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
            if name in hints and not several and not _fits(value, hints[name]):
                problem = f"{function.__name__}: {name} is a {type(value).__name__}"
                if isinstance(value, Sequence | Mapping) and not isinstance(value, str):
                    problem += " that does not hold what it should, or none is wanted"
                raise ObservationError(problem, remedy=f"It takes {_told(hints[name])}.")
        return function(*args, **more)

    return typing.cast(F, call)


@cache
def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    try:
        return typing.get_type_hints(function)
    except NameError:  # imported for type checkers alone
        return {}


def _fits(value: Any, hint: Any) -> bool:
    origin, of = typing.get_origin(hint), typing.get_args(hint)
    if hint is None or hint is type(None):
        return value is None
    if hint == ArrayLike or origin is np.ndarray or hint is np.ndarray:
        return _is_array(value)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, one) for one in of)
    kind = origin or hint
    if not isinstance(kind, type) or kind in (object, type):
        return True
    numbers = {float: Real, int: Integral, complex: complex}
    if kind in numbers:
        return isinstance(value, numbers[kind])
    if issubclass(kind, os.PathLike):
        return isinstance(value, os.PathLike)
    try:
        fits = isinstance(value, kind)
    except TypeError:  # a protocol
        return True
    if not fits or (isinstance(value, str) and kind not in (str, object)):
        return fits and kind is str
    if of and issubclass(kind, Sequence) and isinstance(value, Sequence) and len(of) == 1:
        return all(_fits(one, of[0]) for one in value)
    if of and issubclass(kind, Mapping) and isinstance(value, Mapping) and len(of) == 2:
        return all(_fits(key, of[0]) and _fits(one, of[1]) for key, one in value.items())
    return True


def _is_array(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "fiub"
    except (TypeError, ValueError):
        return False


def _told(hint: Any) -> str:
    """An annotation in short."""
    if hint == ArrayLike or typing.get_origin(hint) is np.ndarray:
        return "an array of numbers"
    of = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_told(one) for one in of))
    if hint is type(None):
        return "None"
    name = getattr(typing.get_origin(hint) or hint, "__name__", str(hint))
    inside = ", ".join(_told(one) for one in of if one is not Ellipsis)
    return f"{name} of {inside}" if inside and name not in ("Callable", "PathLike") else name
