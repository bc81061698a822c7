"""The take file: one TOML that names the sensors of a recording, found, parsed once into records, and explained."""

from __future__ import annotations

import hashlib
import json
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec

from kinefit._arguments import checked
from kinefit._files import BACKSLASHES, LENGTHS, TIMES, parse_toml, read_text, with_slashes, worth
from kinefit.errors import (
    FileError,
    KinefitError,
    TakeError,
    check_choice,
    choices,
    command,
    located,
    printable,
    shortened,
)
from kinefit.readers.depth.images import listed
from kinefit.readers.guess.files import VIDEOS, stand_in
from kinefit.readers.plugins import KEYPOINTS, MARKERS, install
from kinefit.readers.ros.recordings import inside
from kinefit.readers.take import entries
from kinefit.readers.take.checks import check_take
from kinefit.readers.take.entries import ATTRIBUTES, NO_FILES, SINGLE_TABLES, TABLES, Take
from kinefit.readers.take.kinds import BUILT_IN, KINDS, WrongEntryError

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
    if not path.exists():
        raise FileError("no such take file", file=path, remedy="Check the path.")
    text = read_text(path, "the take file", remedy="Give a text file in UTF-8.")
    raw = parse_toml(text, path)
    digest = hashlib.sha256(json.dumps(raw, sort_keys=True, default=str).encode()).hexdigest()
    _tidy(raw, path, text)
    head = raw.pop("take", {}) | {"path": path, "digest": digest}
    head["name"] = head.get("name") or printable(path.stem)
    if isinstance(body := head.get("body"), str) and body.endswith((".toml", ".npz")):
        head["body"] = str(_there(path.parent, body))
    marked = raw.get("markers")
    for row in marked if isinstance(marked, list) else ():
        if isinstance(row, dict) and str(row.get("set", "")).endswith(".toml"):
            row["set"] = str(_there(path.parent, row["set"]))
    of_kinds = {table: entries.entry_class(table) for table in KINDS.names() if table in raw}
    head["sensors"] = {t: _converted({t: raw.pop(t)}, tuple[of_kinds[t], ...], path, t) for t in of_kinds}  # type: ignore
    take: Take = _converted(head | {ATTRIBUTES.get(table, table): rows for table, rows in raw.items()}, Take, path)
    check_take(take)
    return take


def _converted(content: Mapping[str, Any], kind: Any, path: Path, table: str = "") -> Any:
    """Content of a take file, or of one of its tables, as records of a kind; raises what `wrong_value` makes."""
    try:
        return msgspec.convert(content[table] if table else content, kind, dec_hook=_path_in(path.parent))
    except msgspec.ValidationError as error:
        raise wrong_value(error, content, path, table) from error


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
        return _there(folder, value)

    return make


def _there(folder: Path, value: str) -> Path:
    """The path in a folder, or the one that a path of Windows means where only that exists."""
    path = folder / value
    if "\\" in value and not path.exists():
        other = folder / with_slashes(value)
        return other if other.exists() or ("*" in other.name and listed(other)) else path
    return path


def _tidy(raw: dict[str, Any], path: Path, text: str) -> None:
    """Name an unknown table or key, and what exists; put new names of keys, metres and topics in place."""
    for table, content in raw.items():
        with located(path, f"[{table}]"):
            remedy = install("table", rf"\[\[{re.escape(table)}\]\]", text)
            check_choice("sensor or table", table, [*TABLES, *KINDS.names()], TakeError, remedy=remedy)
            KINDS.refuse_shadows(table, TABLES)
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
                if table == "keypoints" and isinstance(format := row.get("format"), str) and format not in NO_FILES:
                    remedy = install(KEYPOINTS.what, rf'format *= *"{re.escape(format)}"', text)
                    KEYPOINTS.get(format, TakeError, remedy=remedy)
                if isinstance(topic := row.get("topic"), str):
                    _name_topic(topic, row, "video" if table == "camera" else "file", path)


def _rename(table: str, row: dict[str, Any], path: Path, place: str) -> None:
    """Put the new name of a key in place of its old one, and say so; refuse one that there is not."""
    known, old_names = entries.keys_of(table), entries.RENAMED.get(table, {})
    for old in [key for key in row if key not in known]:
        if old not in old_names:
            tables = [name for name in (*TABLES, *BUILT_IN) if old in entries.keys_of(name)]
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


def find_take(path: str | PathLike[str], *, wanted: Sequence[str] = ("track",)) -> Path:
    """The take file at a path: the file itself, or the take file in a folder.

    `wanted`: words of the command that takes it, for what is advised where a video is given.

    Raises
    ------
    FileError
        A video, a marker file or a motion, for which another command is meant; a folder without a take file.
    TakeError
        A folder with several take files, none of which is called take.toml.
    """
    path = Path(path)
    if path.is_dir():
        found = takes_in(path)
        if not found:
            hidden = next(path.glob("*.toml.txt"), None)  # as Windows names it, which shows no endings
            remedy = f"Rename {hidden.name} to {hidden.stem}." if hidden else f"Write one: {command('init', path)}"
            raise FileError("no take file in this folder", file=path, remedy=remedy)
        if len(found) > 1 and not is_default_take(found[0]):
            names = ", ".join(file.name for file in found[:10])
            raise TakeError(f"{len(found)} take files in this folder: {names}", file=path, remedy="Name one of them.")
        return found[0]
    kind = path.suffix.lower()
    if kind in VIDEOS:
        there = next(iter(takes_in(path.parent)), None)
        first = f"Run {command('init', path.parent)}, which writes the take file of all videos and their calibration."
        what = first if there is None else f"Use the take file next to it: {command(*wanted, there)}."
        remedy = f"{what} For keypoints of this video alone: {command('detect', path)}"
        raise FileError("a video, not a take file", file=path, remedy=remedy)
    if any(kind in MARKERS.get(name).suffixes for name in MARKERS.built_in):
        raise FileError("a marker file, not a take file", file=path, remedy=f"Run: {command('markers', 'fit', path)}")
    if problem := stand_in(path):
        what, _, remedy = problem.partition(": ")
        raise FileError(f"{what}, not a take file", file=path, remedy=f"{remedy[:1].upper()}{remedy[1:]}.")
    if kind == ".npz":
        raise FileError("a motion, not a take file", file=path, remedy=f"Look at it: {command('view', path)}")
    return path


def takes_in(folder: Path) -> list[Path]:
    """The take files that lie in a folder, take.toml first."""
    takes = (file for file in folder.glob("*") if file.suffix.lower() == ".toml" and file.is_file() and is_take(file))
    return sorted(takes, key=lambda file: (not is_default_take(file), file))


def is_default_take(file: Path) -> bool:
    """Whether a file is called take.toml, in any case: some systems take Take.toml for the same name."""
    return file.name.lower() == "take.toml"


def is_take(file: Path) -> bool:
    """Whether a TOML file is a take file; one that cannot be read is, where it is called take.toml."""
    if is_default_take(file):
        return True
    try:
        tables = parse_toml(read_text(file, "it", remedy=""), file)
    except KinefitError:
        return False
    known = {*TABLES, *KINDS.names()}
    return bool(set(tables) - {"calibration"}) and not set(tables) - known  # which calibrations have, too


_WORDS = {
    "float": "a number", "int": "a whole number", "str": "a text", "bool": "true or false", "array": "a list",
    "object": "a table", "null": "nothing", "date": "a date",
}  # fmt: skip


def wrong_value(error: msgspec.ValidationError, content: Mapping[str, Any], path: Path, of: str = "") -> TakeError:
    """The error of a value that a table of a take file cannot have; `content` is what could not become a `Take`.

    `of`: the table of a kind, if its rows alone were converted.
    """
    message, _, at = str(error).partition(" - at `$")
    attribute, *inner = [*([of] if of else []), *re.findall(r"\w+", at)] or [""]
    table = of or {ATTRIBUTES.get(name, name): name for name in TABLES if name != "take"}.get(attribute, "take")
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
    hints = list(_parts(get_type_hints(entries.entry_class(table), include_extras=True).get(key)))
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
