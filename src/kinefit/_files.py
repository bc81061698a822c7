"""Files that may hold anything: TOML and numpy archives are read here, within bounds of time and memory."""

from __future__ import annotations

import os
import re
import tomllib
from typing import Any

from kinefit.errors import FileError, KinefitError

_LARGEST = 4_000_000  # characters of a TOML file, which tomllib reads in about 2 s; kinefit's own have some thousands
_DOTTED = re.compile(r"(?<![\w.-])(?:(?:[\w-]++|\"[^\"\n]*+\"|'[^'\n]*+')[ \t]*+\.[ \t]*+){50}")
BACKSLASHES = "A backslash in double quotes begins a special character: use forward slashes, or single quotes."
"""What to do about C:\\Users in a TOML file."""


def parse_toml(text: str, file: str | os.PathLike[str], error: type[KinefitError] = FileError) -> dict[str, Any]:
    """The tables of a TOML text.

    Parameters
    ----------
    file : of the text, for messages.
    error : what is raised.

    Raises
    ------
    `error`
        No TOML, with line and column; or tables so deep, keys or numbers so long that nobody wrote them.
    """
    if len(text) > _LARGEST:
        raise error(f"a TOML file of {len(text) / 1e6:.0f} MB", file=file, remedy="Is it another file?")
    if (dotted := _DOTTED.search(text)) is not None:  # tomllib's time grows with the square of their number
        place = f"line {text.count(chr(10), 0, dotted.start()) + 1}"
        raise error("not TOML: a key of more than 50 parts", file=file, place=place, remedy="Correct it there.")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        raise error(f"not TOML: {problem}", file=file, remedy=_remedy(text, str(problem))) from problem
    except (RecursionError, ValueError) as problem:
        told = "not TOML: nested too deep, or a number too long"
        raise error(told, file=file, remedy="Correct it there.") from problem


def _remedy(text: str, problem: str) -> str:
    """What would work, by the line at fault."""
    at = re.search(r"at line (\d+)", problem)
    line = text.splitlines()[int(at[1]) - 1] if at and int(at[1]) <= len(text.splitlines()) else ""
    value = line.partition("=")[2].partition("#")[0].strip()
    if ("hex value" in problem or "Unescaped" in problem) and "\\" in line:
        path = re.search(r"\"([^\"]*)\"?", line)
        return f"{BACKSLASHES} Write '{path[1]}'." if path and len(path[1]) < 120 else BACKSLASHES
    if value in ("True", "False", "yes", "no", "Yes", "No"):
        return f"Write {'true' if value in ('True', 'yes', 'Yes') else 'false'}."
    return "Put texts in quotes and numbers not, and give numbers a point, not a comma: 1.5."
