"""Every error that kinefit raises for a user's input: what is wrong, where, and what would work."""

from __future__ import annotations

import difflib
import os
import shlex
import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])


class KinefitError(Exception):
    """Base of all errors raised for a user's input.

    Parameters
    ----------
    problem : str
        What is wrong, in one sentence.
    file : path, optional
        The file at fault.
    place : str, optional
        Where in it: a line, a key, a frame, a camera.
    remedy : str, optional
        What would work.
    """

    exit_code = 2

    def __init__(
        self,
        problem: str,
        *,
        file: str | PathLike[str] | None = None,
        place: str | None = None,
        remedy: str | None = None,
    ) -> None:
        problem, remedy = printable(problem), printable(remedy) if remedy else remedy
        self.file, self.problem = file, shortened(problem)
        self.place = shortened(printable(place), 120) if place else place
        file_text = shortened(printable(file), _MAX_PATH_CHARACTERS) if file else ""
        extra = max(len(file_text) - _TYPICAL_PATH_CHARACTERS, 0)
        room = _MAX_ERROR_CHARACTERS - len(self.problem) - len(self.place or "") - extra
        self.remedy = shortened(remedy, max(room, _MIN_REMEDY_CHARACTERS)) if remedy else remedy
        where = ", ".join(part for part in (file_text, self.place) if part)
        text = f"{where}: {self.problem}" if where else self.problem
        super().__init__(f"{text.rstrip('.')}. {self.remedy}" if remedy else text)


@contextmanager
def located(file: str | PathLike[str] | None = None, place: str | None = None) -> Iterator[None]:
    """Context in which every error names this file, unless it names one, and this place before its own.

    Raises
    ------
    KinefitError
        What is raised inside, of the same class.
    """
    try:
        yield
    except KinefitError as error:
        where = ", ".join(part for part in (place, error.place) if part)
        again = type(error)(error.problem, file=error.file or file, place=where or None, remedy=error.remedy)
        raise again from error.__cause__ or error


def names_file(read: F) -> F:
    """The same reader, whose errors name the file that is its first argument, unless they name one."""
    name = read.__code__.co_varnames[0]

    @wraps(read)
    def call(*args: Any, **more: Any) -> Any:
        with located(args[0] if args else more.get(name)):
            return read(*args, **more)

    return cast(F, call)


@contextmanager
def extra(name: str, problem: str, error: type[KinefitError], **more: Any) -> Iterator[None]:
    """Context that imports packages of an extra of kinefit: where they are missing, an error says how to install it.

    Parameters
    ----------
    name : of the extra
    problem, more : what needs which package, and the error's file or place
    """
    try:
        yield
    except ImportError as missing:
        raise error(problem, remedy=f"Install it: pip install 'kinefit[{name}]'.", **more) from missing


_MAX_LIST_CHARACTERS = 240  # characters of a list of names
_MAX_PROBLEM_CHARACTERS = 300  # values of a file, which a problem may quote, have any length
_MAX_ERROR_CHARACTERS = 570  # of all parts together
_MAX_PATH_CHARACTERS = 260  # also of a path that a file names
_TYPICAL_PATH_CHARACTERS = 150
_MIN_REMEDY_CHARACTERS = 60


def printable(text: object) -> str:
    """The text of something for people: "?" for what is no character, as in a file's name that is not UTF-8.

    Every file, page and terminal can hold it.
    """
    return str(text).encode("utf-8", "replace").decode("utf-8")


def shortened(text: str, longest: int = _MAX_PROBLEM_CHARACTERS) -> str:
    """A text of a message, its middle left out where a file gave it more than `longest` characters."""
    half = longest // 2 - 3
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"


class FileError(KinefitError):
    """A file is missing, truncated, or not what it claims to be."""


class CalibrationError(KinefitError):
    """A camera or calibration cannot be used as it is."""


class TakeError(KinefitError):
    """A take file names something that is not there or contradicts itself."""


class PluginError(KinefitError):
    """A plug-in of another distribution cannot be imported, raises an error, or returns what it must not."""


class BodyError(KinefitError):
    """A body file, or a name asked of a body, is wrong."""


class ObservationError(KinefitError):
    """Measurements have the wrong shape, unit, rate or content."""


class TrackingError(KinefitError):
    """A motion cannot be found in the measurements given."""


class ExportError(KinefitError):
    """A result cannot be written (full disk, no permission, missing extra)."""


class AssetError(KinefitError):
    """A pinned package with sample data cannot be fetched or is not the one expected."""


def choices(kind: str, name: str, valid: object) -> str:
    """Sentence that names an unknown thing and lists what exists, of many the nearest: for messages."""
    names = [str(v) for v in valid]  # type: ignore[attr-defined]
    listed = ", ".join(names) or "none"
    if len(listed) > _MAX_LIST_CHARACTERS:
        near = difflib.get_close_matches(str(name), names, 5, 0.3) or names[:5]
        listed = f"{', '.join(near)} and {len(names) - len(near)} more"
    return f"no {kind} '{name}'; there are: {listed}"


def check_choice(kind: str, name: str, valid: Iterable[str], error: type[KinefitError], **more: Any) -> None:
    """Raise an error that lists the valid names where a name is none of them; `more`: its file, place and remedy."""
    if name not in valid:
        raise error(choices(kind, name, valid), **more)


def spelled(text: str, valid: Iterable[str]) -> str:
    """The one of `valid` that a text spells with other capitals, blanks or hyphens; the text where none is."""
    plain = text.lower().translate(dict.fromkeys(map(ord, " -_.")))
    return next((name for name in valid if name.lower() == plain), text)


def command(*words: str | PathLike[str]) -> str:
    """A line that works when it is pasted where the user is: `kinefit`, then words and paths, quoted for the shell.

    A path counts from the current folder on, where it lies below it.
    """
    command = ["kinefit", *(nearest(word) if isinstance(word, PathLike) else word for word in words)]
    return subprocess.list2cmdline(command) if os.name == "nt" else shlex.join(command)


def nearest(path: str | PathLike[str]) -> str:
    """A path from the current folder on, where it lies in it or one folder above it; else as it was given."""
    path = Path(path)
    try:
        relative = os.path.relpath(path)
    except (ValueError, OSError):  # another drive; a current folder that is gone
        return str(path)
    up = relative.split(os.sep).count(os.pardir)
    return relative if up <= 1 else str(path)
