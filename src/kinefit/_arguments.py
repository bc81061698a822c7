"""Arguments of public functions, held against their annotations: a wrong type is reported by name before any work."""

from __future__ import annotations

import inspect
import os
import sys
import types
import typing
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial, wraps
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import KinefitError, ObservationError

F = TypeVar("F", bound=Callable[..., Any])
Test = Callable[[Any], bool]


def checked(function: F) -> F:
    """The same function, which refuses arguments of other types than it states.

    Held are classes, numbers, texts, paths, lists and mappings of these, arrays of numbers and functions.

    Raises
    ------
    ObservationError
        When it is called: the argument's name, its type and what is wanted.
    """
    parameters = inspect.signature(function).parameters.values()
    placed = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]

    @wraps(function)
    def call(*args: Any, **more: Any) -> Any:
        tests = _tests(function)
        for name, value in (*zip(placed, args), *more.items()):
            if name in tests and not tests[name](value):
                problem = f"{function.__name__}: {name} is a {type(value).__name__}"
                if isinstance(value, Sequence | Mapping) and not isinstance(value, str):
                    problem += " of the wrong content or type"
                raise ObservationError(problem, remedy=f"Give {_hint_text(_hints(function)[name])}.")
        return function(*args, **more)

    return typing.cast(F, call)


def renamed(**new_names: str) -> Callable[[F], F]:
    """Accept keyword arguments under their old names for one version, with a warning that names the new one.

    Parameters
    ----------
    new_names : old="new"

    Raises
    ------
    ObservationError
        Both names are given.
    """

    def decorate(function: F) -> F:
        @wraps(function)
        def call(*args: Any, **more: Any) -> Any:
            for old in new_names.keys() & more.keys():
                new = new_names[old]
                if new in more:
                    problem = f"{function.__name__}: {old} and {new} are the same argument"
                    raise ObservationError(problem, remedy=f"Give {new} alone.")
                text = f"{function.__name__}: the argument {old} is called {new} now"
                warnings.warn(text, FutureWarning, stacklevel=2)
                more[new] = more.pop(old)
            return function(*args, **more)

        return typing.cast(F, call)

    return decorate


def check_shape(
    array: NDArray, shape: Sequence[int | str], what: str, *, finite: bool = False,
    error: type[KinefitError] = ObservationError, file: str | None = None, remedy: str = "",
) -> None:  # fmt: skip
    """Raise an error that names an array of another shape than this one, in which a text stands for any length."""
    fits = len(shape) == array.ndim and all(isinstance(m, str) or m == n for m, n in zip(shape, array.shape))
    if not fits or (finite and not np.isfinite(array).all()):
        wanted = f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
        problem = f"{what} of shape {array.shape}" + ", with numbers that are not finite" * fits
        raise error(problem, file=file or None, remedy=remedy or f"Give {wanted}{', finite' * finite}.")


def shaped(values: ArrayLike, shape: Sequence[int | str], what: str, **options: Any) -> NDArray:
    """Contiguous floats of a shape; `options` and errors as of `check_shape`."""
    array = np.ascontiguousarray(values, float)
    check_shape(array, shape, what, **options)
    return array


def rgb_image(image: ArrayLike, what: str = "an image") -> NDArray:
    """(H, W, 3) uint8; ObservationError for an image of another shape or type, or without pixels."""
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size or pixels.dtype != np.uint8:
        problem = f"{what} of shape {pixels.shape} and type {pixels.dtype}"
        raise ObservationError(problem, remedy="Give (height, width, 3), RGB of uint8.")
    return pixels


@cache
def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    try:
        return typing.get_type_hints(function)
    except NameError:  # some are imported for type checkers alone
        known, out = vars(sys.modules[function.__module__]), dict[str, Any]()
        for one in function.__annotations__.items():
            with suppress(NameError):
                out |= typing.get_type_hints(types.SimpleNamespace(__annotations__=dict([one])), known)
        return out


@cache
def _tests(function: Callable[..., Any]) -> dict[str, Test]:
    """Of each argument with an annotation, whether a value is of it."""
    parameters, hints = inspect.signature(function).parameters.values(), _hints(function)
    one = [p.name for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return {name: _test(hints[name]) for name in one if name in hints}


def _test(hint: Any) -> Test:
    """Whether a value is of an annotation: made once, as calls are many."""
    origin, of = typing.get_origin(hint), typing.get_args(hint)
    if hint is None or hint is type(None):
        return lambda value: value is None
    if hint == ArrayLike or origin is np.ndarray or hint is np.ndarray:
        return _is_array
    if origin in (typing.Union, types.UnionType):
        tests = [_test(one) for one in of]
        return lambda value: any(test(value) for test in tests)
    kind = origin or hint
    if not isinstance(kind, type) or kind in (object, type):
        return lambda value: True
    numbers: dict[type, type] = {float: Real, int: Integral, complex: complex}
    if kind in numbers:
        number = numbers[kind]
        return lambda value: isinstance(value, number)
    if issubclass(kind, os.PathLike):
        return lambda value: isinstance(value, os.PathLike)
    inside = [_test(one) for one in of if one is not Ellipsis]
    return partial(_held, kind=kind, inside=inside)


def _held(value: Any, kind: type, inside: Sequence[Test]) -> bool:
    """Whether a value is of a type, and what a list or a mapping holds, too."""
    try:
        fits = isinstance(value, kind)
    except TypeError:  # a protocol
        return True
    if not fits or (isinstance(value, str) and kind not in (str, object)):
        return fits and kind is str
    if len(inside) == 1 and issubclass(kind, Sequence) and isinstance(value, Sequence):
        return all(map(inside[0], value))
    if len(inside) == 2 and issubclass(kind, Mapping) and isinstance(value, Mapping):
        return all(inside[0](key) and inside[1](one) for key, one in value.items())
    return True


def _is_array(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "fiub"
    except (TypeError, ValueError):
        return False


def _hint_text(hint: Any) -> str:
    """An annotation in short."""
    if hint == ArrayLike or typing.get_origin(hint) is np.ndarray:
        return "an array of numbers"
    of = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(_hint_text(one) for one in of))
    if hint is type(None):
        return "None"
    name = getattr(typing.get_origin(hint) or hint, "__name__", str(hint))
    inside = ", ".join(_hint_text(one) for one in of if one is not Ellipsis)
    return f"{name} of {inside}" if inside and name not in ("Callable", "PathLike") else name
