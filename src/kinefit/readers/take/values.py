"""What is wrong with a value of a take file: in words, with the place as the file has it, and what to write instead."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec

from kinefit.errors import TakeError
from kinefit.readers.take.entries import ATTRIBUTES, SINGLE_TABLES, TABLES, WrongEntryError

_WORDS = {
    "float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false", "array": "a list",
    "object": "a table", "null": "nothing", "date": "a date",
}  # fmt: skip


def wrong_value(error: msgspec.ValidationError, content: Mapping[str, Any], path: Path) -> TakeError:
    """The error of a value that a table of a take file cannot have; `content` is what could not become a `Take`."""
    message, _, at = str(error).partition(" - at `$.")
    attribute, *inner = re.findall(r"\w+", at) or [""]
    table = {ATTRIBUTES.get(name, name): name for name in TABLES if name != "take"}.get(attribute, "take")
    if table in SINGLE_TABLES:
        row, keys = (content, [attribute]) if table == "take" else (content[attribute], inner)
        key, where = next(iter(keys), ""), f"[{table}]"
        place = f"{where} {key}".strip()
    else:
        number, key = int(inner[0]), next(iter(inner[1:]), "")
        row = content[attribute][number]
        whose = f"camera {row['camera']}" if "camera" in row and table != "depth" else row.get("name")
        whose = f"{row.get('left')}-{row.get('right')}" if table == "stereo" else whose
        where = ", ".join([f"[[{table}]] {number + 1}", *([str(whose)] if whose else [])])
        place = f"{where}, {key}" if key else where
    if isinstance(cause := error.__cause__, WrongEntryError):
        return TakeError(cause.problem, file=path, place=where, remedy=cause.remedy)
    hints = list(_parts(get_type_hints(TABLES[table], include_extras=True).get(key)))
    listed = next((", ".join(map(repr, get_args(hint))) for hint in hints if get_origin(hint) is Literal), "")
    if re.match(r"Expected `\w+` [<>]", message):
        remedy = next(m.description for hint in hints for m in getattr(hint, "__metadata__", ()))
        if key == "height" and 30.0 < row[key] < 300.0:
            remedy = f"Give the stature in metres: height = {row[key] / 100:g}."
        return TakeError(f"{key} = {row[key]}", file=path, place=where, remedy=remedy)
    known = listed and ("enum" in message or "Invalid" in message)
    remedy = f"There are: {listed}." if known else _form(message, key)
    return TakeError(_plain(message), file=path, place=place if at else None, remedy=remedy)


def _parts(hint: Any) -> Iterator[Any]:
    """A type, and all types that it is made of."""
    yield hint
    for part in () if get_origin(hint) is Literal else get_args(hint):
        yield from _parts(part)


def _plain(message: str) -> str:
    """What msgspec says, in words."""
    message = message.replace("Object missing required field", "there is no").replace("enum ", "")
    wanted, _, given = message.partition(", got ")
    if not wanted.startswith("Expected ") or not given:
        return message
    kinds = [word for kind in re.findall(r"\w+", wanted.partition("`")[2].partition("`")[0]) if kind != "null"
             for word in [_WORDS.get(kind, kind)]]  # fmt: skip
    length = re.search(r"of length (.*)", wanted)
    if length:
        return f"a list of {length[1]} is expected, not of {given}"
    return f"{' or '.join(kinds)} is expected, not {_WORDS.get(given.strip('`'), given)}"


def _form(message: str, key: str) -> str | None:
    """How a value is written, of which msgspec says that it is of another type."""
    wanted, _, given = message.partition(", got ")
    if key == "unit" and "str" in wanted:
        return 'Write it in quotes: unit = "mm", "cm" or "m".'
    if key in ("unit", "time_unit") and "str" in given:
        return "Write mm, cm or m in quotes, or a number of metres." if key == "unit" else 'Write "s", "ms" or "us".'
    if key.startswith(("excluded", "swapped")):
        return f"Write a list of ranges: {key.partition('[')[0]} = [[0, 100], [150, 200]]."
    if key == "frames":
        return "Write the first and the one after the last: frames = [0, 100]."
    if "str" in given and ("float" in wanted or "int" in wanted):
        return "Write a number, without quotes and without its unit: 1.75."
    forms = {"str": "Write it in quotes.", "bool": "Write true or false.", "array": "Write a list: [1, 2].",
             "object": "Write a table: { key = value }."}  # fmt: skip
    return next((form for kind, form in forms.items() if kind in wanted), None)
