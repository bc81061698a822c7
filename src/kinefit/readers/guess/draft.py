"""A draft of a take file: its values with their confidence, and its text with a comment on every guess."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from kinefit.errors import FileError, KinefitError, printable
from kinefit.readers.guess.files import CalibrationFile

CONFIDENCE_LEVELS = ("sure", "likely", "guess", "open")
"""From "stated by the files" to "the user decides"."""

_TABLES = ("keypoints", "depth", "markers", "plate")  # in the order in which they are written
_COMMENT_COLUMN = 40
_HEAD = """\
# A first take file, made by kinefit init from what lies in the folder.
# A comment begins with the confidence of its line: sure, likely, guess, or open (you decide). Then:
#   kinefit check THIS_FILE      checks whether cameras, keypoints and calibration agree
#   kinefit track THIS_FILE      fits the body
"""


@dataclass(frozen=True)
class Value:
    """A value of a take file with its confidence (of `CONFIDENCE_LEVELS`) and reason; None: the user decides."""

    value: object
    sure: str = "sure"
    why: str = ""


@dataclass(frozen=True)
class Note:
    """A remark on one guess.

    Parameters
    ----------
    about : "calibration", "camera cam01", "up" ...
    sure : one of `CONFIDENCE_LEVELS`
    text : what was guessed, and why.
    """

    about: str
    sure: str
    text: str


Entry = Mapping[str, Value]


@dataclass
class Draft:
    """The content of a take file.

    Parameters
    ----------
    folder, beside : folder of the recording; folder of the take file.
    head : keys of [take]
    calibration : the file, and keys of [calibration]
    others : calibrations that were not chosen.
    cameras : name -> keys of its [[camera]]
    tables : {"keypoints", "depth" ...: (True if in use, False if a comment; keys) of each entry}
    kinds : {table: what it is} of tables of a `SensorKind`
    """

    folder: Path
    beside: Path
    notes: list[Note] = field(default_factory=list)
    head: dict[str, Value] = field(default_factory=dict)
    calibration: tuple[CalibrationFile, dict[str, Value]] | None = None
    others: list[Path] = field(default_factory=list)
    cameras: dict[str, dict[str, Value]] = field(default_factory=dict)
    tables: dict[str, list[tuple[bool, Entry]]] = field(default_factory=lambda: {table: [] for table in _TABLES})
    kinds: dict[str, str] = field(default_factory=dict)
    comments: list[str] = field(default_factory=list)

    def note(self, about: str, sure: str, text: str) -> None:
        """Add a remark for the screen."""
        self.notes.append(Note(about, sure, text))

    def note_error(self, about: str, error: KinefitError) -> None:
        """Add a remark on what is wrong, once."""
        note = Note(about, "open", f"{error.problem}. {error.remedy or ''}".strip())
        self.notes += [] if note in self.notes else [note]

    def note_value(self, about: str, value: Value, key: str) -> Value:
        """Add a remark on a value for the screen; returns the value."""
        self.note(about, value.sure, f"{key} = {_value(value.value, self)}: {value.why}" if value.value else value.why)
        return value

    def name(self, path: Path) -> str:
        """A path relative to the recording's folder, for messages."""
        return _relative(path, self.folder)

    def text(self) -> str:
        """The text of the take file."""
        head = {"name": Value(self.folder.name or "take"), **self.head}
        head.setdefault("body", Value("humanoid", "sure", 'a whole person; "humanoid_hands" has fingers, too'))
        first = _table("[take]", head, self) + "".join(f"# {comment}\n" for comment in self.comments)
        parts = [_HEAD, first]
        if self.calibration:
            others = "".join(f"# file = {_value(path, self)}\n" for path in self.others)
            parts.append(_table("[calibration]", self.calibration[1], self) + others)
        parts += [_table("[[camera]]", {"name": Value(name), **keys}, self) for name, keys in self.cameras.items()]
        for table, rows in self.tables.items():
            title = f"[[{table}]]"
            if table in self.kinds:
                title = f"{title:<{_COMMENT_COLUMN - 2}}  # {self.kinds[table]}"
            parts += [_table(title, keys, self, active) for active, keys in rows]
        return "\n".join(parts)


def _table(title: str, keys: Entry, draft: Draft, active: bool = True) -> str:
    lines = [title]
    for key, entry in keys.items():
        line = f"# {key} = " if entry.value is None else f"{key} = {_value(entry.value, draft)}"
        lines.append(f"{line:<{_COMMENT_COLUMN - 2}}  # {entry.sure}: {entry.why}" if entry.why else line)
    return "".join(f"{'' if active else '# '}{line}\n" for line in lines)


def _value(value: object, draft: Draft) -> str:
    if isinstance(value, Path):
        value = _relative(named := value, draft.beside)
        if value != printable(value):
            problem = "its name is not UTF-8, as names in a take file are"
            raise FileError(problem, file=named, remedy="Rename the file or folder.")
    if isinstance(value, float):
        return f"{value:.9g}" if value != int(value) else f"{value:.1f}"
    return json.dumps(value, ensure_ascii=False)


def _relative(path: Path, start: Path) -> str:
    """Path relative to a folder, with slashes; absolute if the two have no folder in common."""
    try:
        shared = os.path.commonpath([path, start])
    except ValueError:  # another drive
        return path.as_posix()
    return path.as_posix() if shared == path.anchor else Path(os.path.relpath(path, start)).as_posix()
