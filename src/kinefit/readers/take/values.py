"""What is wrong with a value of a take file: in words, with the place as the file has it, and what to write instead."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

import msgspec

from kinefit.errors import TakeError

if TYPE_CHECKING:
    from kinefit.readers.take.file import Take

_MAX_STEPS = 10**9  # steps of a take
_WORDS = {
    "float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false", "array": "a list",
    "object": "a table", "null": "nothing", "date": "a date",
}  # fmt: skip


def wrong_value(error: msgspec.ValidationError, tables: Mapping[str, type[msgspec.Struct]], path: Path) -> TakeError:
    """The error of a value that a table of a take file cannot have; `tables` are the records of all of them."""
    message, _, at = str(error).partition(" - at `$.")
    at = at.rstrip("`")
    table, _, key = at.partition(".")
    name, _, number = table.rstrip("]").partition("[")
    place = f"[[{name}]] {int(number) + 1}, {key}" if number.isdigit() else f"[{name}] {key}"
    listed = ", ".join(map(repr, _options(tables, name, key)))
    known = listed and ("enum" in message or "Invalid" in message)
    remedy = f"There are: {listed}." if known else _form(message, key)
    return TakeError(_plain(message), file=path, place=place.rstrip(", ") if at else None, remedy=remedy)


def wrong_ranges(take: Take) -> Iterator[tuple[str, str, str]]:
    """Ranges of steps that cannot be: problem, place, remedy."""
    form = "Give [first, one after the last]"
    if take.frames is not None and not _is_range(take.frames):
        yield f"frames {list(take.frames)}", "[take] frames", f"{form}."
    for source in (*take.keypoints, *take.skin):
        place = f"keypoints of camera {source.camera}"
        if source.frames is not None and not _is_range(source.frames):
            yield f"frames {list(source.frames)}", place, f"{form}."
        for key in ("excluded", "swapped"):
            if source.stream is not None and getattr(source, key):
                yield f"'{key}' has no use with a stream", place, "Leave it out."
            for steps in getattr(source, key):
                if steps[0] < 0 or not _is_range(steps):
                    yield f"{key} has {list(steps)}", place, f"{form}, counted from 0, for every range."


def _is_range(steps: tuple[int, int]) -> bool:
    return -_MAX_STEPS < steps[0] < steps[1] < _MAX_STEPS


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


def _options(tables: Mapping[str, type[msgspec.Struct]], name: str, key: str) -> tuple[Any, ...]:
    """What may be written for a key, where it is one of a few."""
    entry = tables.get(name)
    if entry is None or key not in entry.__struct_fields__:
        return ()
    hint = get_type_hints(entry)[key]
    return next((get_args(literal) for literal in (hint, *get_args(hint)) if get_origin(literal) is Literal), ())


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
