"""The take file: one TOML that names the sensors of a recording, parsed once into typed records."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec

from kinefit._arguments import checked
from kinefit._files import BACKSLASHES, parse_toml, regular
from kinefit.errors import FileError, TakeError, check_choice, choices, located, printable, shortened
from kinefit.readers.ros.recordings import inside
from kinefit.readers.take.checks import check_take
from kinefit.readers.take.entries import (
    ATTRIBUTES,
    RENAMED,
    SINGLE_TABLES,
    TABLES,
    Take,
    keys_of,
)
from kinefit.readers.take.find import find_take
from kinefit.readers.take.values import wrong_value
from kinefit.readers.units import LENGTHS, TIMES, worth

__all__ = ["Take", "read_take"]


@checked
def read_take(path: str | PathLike[str]) -> Take:
    """Read a take file, or the one in a folder; relative paths in it start at its own folder.

    Raises
    ------
    FileError
        The take file, or a file that it names, is missing; or it is not TOML.
    TakeError
        Unknown sensors, keys or values (the message lists what exists), no sensor at all, names that do not agree.
    """
    path = find_take(path).absolute()
    try:
        raw = parse_toml(regular(path).read_text(encoding="utf-8"), path)
    except FileNotFoundError as error:
        raise FileError("no such take file", file=path, remedy="Check the path.") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"cannot be read ({error})", file=path, remedy="Give a text file in UTF-8.") from error
    digest = hashlib.sha256(json.dumps(raw, sort_keys=True, default=str).encode()).hexdigest()
    _tidy(raw, path)
    head = raw.pop("take", {}) | {"path": path, "digest": digest}
    head["name"] = head.get("name") or printable(path.stem)
    if isinstance(body := head.get("body"), str) and body.endswith((".toml", ".npz")):
        head["body"] = str(path.parent / body)
    content = head | {ATTRIBUTES.get(table, table): rows for table, rows in raw.items()}
    try:
        take = msgspec.convert(content, Take, dec_hook=_path_in(path.parent))
    except msgspec.ValidationError as error:
        raise wrong_value(error, content, path) from error
    check_take(take)
    return take


_MAX_PATH_BYTES = 2048  # bytes of a path within a take: systems allow 4096 in all


def _path_in(folder: Path) -> Callable[[type, Any], Path]:
    """Maker of absolute paths from the texts of a take file."""

    def make(_: type, value: Any) -> Path:
        if isinstance(value, Path):
            return value
        if not isinstance(value, str) or not value:
            raise ValueError("a file or folder must be a text in quotes")
        if len(value.encode()) > _MAX_PATH_BYTES or any(len(part.encode()) > 255 for part in Path(value).parts):
            raise ValueError(f"{shortened(value, 60)!r} is no path: it is too long")
        if any(ord(character) < 32 for character in value):
            raise ValueError(f"{value!r} is no path: {BACKSLASHES}")
        return folder / value

    return make


def _tidy(raw: dict[str, Any], path: Path) -> None:
    """Name an unknown table or key, and what exists; put new names of keys, metres and topics in place."""
    for table, content in raw.items():
        check_choice("sensor or table", table, TABLES, TakeError, file=path, place=f"[{table}]")
        many = table not in SINGLE_TABLES
        if many != isinstance(content, list):
            wanted = f"[[{table}]]" if many else f"[{table}]"
            raise TakeError(f"'{table}' is not a table {wanted}", file=path, place=table, remedy=f"Write {wanted}.")
        for number, row in enumerate(content if many else [content], 1):
            with located(path, f"[[{table}]] {number}" if many else f"[{table}]"):
                if not isinstance(row, dict):
                    raise TakeError("not a table", remedy=f"Write [[{table}]] and its keys below.")
                _rename(table, row, path, f"[[{table}]] {number}" if many else f"[{table}]")
                for key, units in (("unit", LENGTHS), ("time_unit", TIMES)) if table == "depth" else ():
                    if (value := worth(row.get(key), units)) is not None:
                        row[key] = value
                if isinstance(topic := row.get("topic"), str):
                    _name_topic(topic, row, "video" if table == "camera" else "file", path)


def _rename(table: str, row: dict[str, Any], path: Path, place: str) -> None:
    """Put the new name of a key in place of its old one, and say so; refuse one that there is not."""
    known, old_names = keys_of(table), RENAMED.get(table, {})
    for old in [key for key in row if key not in known]:
        if old not in old_names:
            tables = [name for name in TABLES if old in keys_of(name)]
            holding = ", ".join(f"[{name}]" if name in SINGLE_TABLES else f"[[{name}]]" for name in tables)
            raise TakeError(choices("key", old, known), remedy=f"'{old}' belongs to {holding}." if holding else None)
        new = old_names[old]
        if new in row:
            raise TakeError(f"'{old}' and '{new}' are one key", remedy=f"Keep '{new}'.")
        row[new] = row.pop(old)
        text = f"{path}, {place}: '{old}' is now called '{new}'; the next version does not read '{old}'"
        warnings.warn(text, FutureWarning, stacklevel=4)


def _name_topic(topic: str, row: dict[str, Any], key: str, path: Path) -> None:
    """Make a topic a part of its file's path, as recordings of ROS 2 are read."""
    file = row.get(key)
    if not isinstance(file, str) or not topic.strip("/"):
        remedy = f'Write {key} = "recording.mcap" and topic = "/front/image_raw".'
        raise TakeError(f"a topic without {key}, or without a name", remedy=remedy)
    recording = path.parent / file
    if recording.exists() and inside(recording) is None:
        raise TakeError(f"'topic' has no use with {file}", remedy="It is for MCAP recordings of ROS 2.")
    row[key] = f"{file}/{topic.strip('/')}"
