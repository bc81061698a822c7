"""Edit the text of a take file: set and remove keys, and keep its comments and everything else as it is."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate
from typing import Any

from kinefit.errors import TakeError, check_choice
from kinefit.findings import Edit

_DOUBLED = str.maketrans({"\\": "\\\\", '"': '\\"'})


def quoted(text: str) -> str:
    """A text without line breaks as a TOML string in double quotes."""
    return f'"{text.translate(_DOUBLED)}"'


def edited(text: str, edits: Iterable[Edit]) -> str:
    """The text of a take file with edits.

    Those of [[keypoints]] of a camera which has none are left out: the built-in detector's are as their camera is.

    Raises
    ------
    TakeError
        Two edits contradict each other; a camera or sensor that is not in the take.
    """
    made: dict[tuple[str, int | None, str], Edit] = {}
    tables = tomllib.loads(text)
    for edit in edits:
        for number in _numbers(tables, edit):
            other = made.setdefault((edit.table, number, edit.key), edit)
            if other.value != edit.value:
                problem = f"two edits contradict each other: {other} and {edit}"
                raise TakeError(problem, place=edit.place, remedy="Write the right one yourself.")
    for (table, number, key), edit in made.items():
        text = with_keys(text, table, number, {key: edit.value})
    return text


def _numbers(tables: Mapping[str, Any], edit: Edit) -> Sequence[int | None]:
    """Which of its tables an edit is about, from 0; (None,) for a single table."""
    if isinstance(edit.entry, int):
        return (edit.entry,)
    if not edit.entry:
        return (None,)
    key = "name" if edit.table in ("camera", "depth", "stereo") else "camera"
    names = [entry.get(key) for entry in tables.get(edit.table, ())]
    if edit.table != "keypoints":
        check_choice("camera" if edit.table == "camera" else f"[[{edit.table}]]", edit.entry, names, TakeError)
    return [n for n, name in enumerate(names) if name == edit.entry]


def with_keys(text: str, table: str, number: int | None, keys: Mapping[str, str | None]) -> str:
    """Set keys of one table in the text of a take file.

    Parameters
    ----------
    text : str, TOML
    table : "take", "start", "camera", "keypoints", ...
    number : int or None
        Which `[[table]]`, from 0. None: the single `[table]`. A table that is missing is added at the end.
    keys : {key: value}
        Values as TOML has them. None removes the key. A comment behind a replaced value stays.

    Returns
    -------
    str
        The edited text. Statements that are not named stay as they are, byte for byte.
    """
    newline = "\r\n" if "\r\n" in text else "\n"
    statements = _statements(text)
    single: Any = {table: {}}
    wanted = single if number is None else {table: [{}]}
    heads = [i for i, s in enumerate(statements) if s.lstrip().startswith("[")]
    own = [i for i in heads if _parsed(statements[i]) == wanted]
    if len(own) <= (number or 0):
        blank = newline * (bool(text) + (bool(text) and not text.endswith("\n")))
        statements += [*([blank] if blank else []), (f"[{table}]" if number is None else f"[[{table}]]") + newline]
        heads, own = [*heads, len(statements) - 1], [*own, len(statements) - 1]
    first = own[min(number or 0, len(own) - 1)] + 1
    stop = next((i for i in heads if i >= first), len(statements))
    lines, last = statements[first:stop], 0
    for key, value in keys.items():
        at = next((i for i, line in enumerate(lines) if key in (_parsed(line) or {})), None)
        if at is not None:
            lines[at] = "" if value is None else f"{key} = {value}{_comment(lines[at])}{newline}"
        elif value is not None:
            last = max((i + 1 for i, line in enumerate(lines) if _parsed(line)), default=0)
            lines.insert(last, f"{key} = {value}{newline}")
    head = statements[first - 1]
    statements[first - 1] = head if head.endswith("\n") else head + newline
    for i, line in enumerate(lines[:-1]):
        lines[i] = line if line.endswith("\n") or not line else line + newline
    return "".join([*statements[:first], *lines, *statements[stop:]])


def _statements(text: str) -> list[str]:
    """Split a TOML text into lines, and values of several lines with the lines that they span."""
    lines = text.splitlines(keepends=True)
    out: list[str] = []
    while lines:
        count = next((k for k, part in enumerate(accumulate(lines), 1) if _parsed(part) is not None), 1)
        out.append("".join(lines[:count]))
        del lines[:count]
    return out


def _parsed(statement: str) -> dict[str, Any] | None:
    """What a statement says on its own; None where it is no TOML."""
    try:
        return tomllib.loads(statement)
    except tomllib.TOMLDecodeError:
        return None


def _comment(statement: str) -> str:
    """The comment behind the value of a statement, with the blanks before it."""
    for at, character in enumerate(statement):
        if character == "#" and _parsed(statement[:at]) == _parsed(statement):
            bare = statement[:at].rstrip()
            return statement[len(bare) :].rstrip()
    return ""
