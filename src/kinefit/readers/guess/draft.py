"""A take file in the making: what is known so far, how sure it is, and its text with a comment on every guess."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from kinefit.readers.guess.files import CalibrationFile

SURETIES = ("sure", "likely", "guess", "open")
"""From "told by the files themselves" to "to be decided by the user"."""

_WIDTH = 40  # columns before a comment
_HEAD = """\
# A first take file, made by kinefit init from what lies in the folder.
# A comment begins with how sure its line is: sure, likely, guess, or open (for you to decide). Then:
#   kinefit check THIS_FILE      tells whether cameras, keypoints and calibration agree
#   kinefit track THIS_FILE      fits the body
"""


@dataclass(frozen=True)
class Told:
    """A value, how sure it is (of `SURETIES`), and why; no value: to be decided by the user."""

    value: object
    sure: str = "sure"
    why: str = ""


@dataclass(frozen=True)
class Note:
    """One thing that was guessed.

    Parameters
    ----------
    about : "calibration", "camera cam01", "up" ...
    sure : one of `SURETIES`
    told : what, and why.
    """

    about: str
    sure: str
    told: str


Entry = Mapping[str, Told]


@dataclass
class Draft:
    """What a take file shall say.

    Parameters
    ----------
    folder, beside : of the recording; of the take file.
    head : keys of [take]
    calibration : the file, and keys of [calibration]
    others : calibrations that were not taken.
    cameras : name -> keys of its [[camera]]
    keypoints, depth, markers, surface_points : (whether in use or a comment, keys) of each table
    """

    folder: Path
    beside: Path
    notes: list[Note] = field(default_factory=list)
    head: dict[str, Told] = field(default_factory=dict)
    calibration: tuple[CalibrationFile, dict[str, Told]] | None = None
    others: list[Path] = field(default_factory=list)
    cameras: dict[str, dict[str, Told]] = field(default_factory=dict)
    keypoints: list[tuple[bool, Entry]] = field(default_factory=list)
    depth: list[tuple[bool, Entry]] = field(default_factory=list)
    markers: list[tuple[bool, Entry]] = field(default_factory=list)
    surface_points: list[tuple[bool, Entry]] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)

    def note(self, about: str, sure: str, told: str) -> None:
        """Remember something for the screen."""
        self.notes.append(Note(about, sure, told))

    def tell(self, about: str, told: Told, key: str) -> Told:
        """Remember a value for the screen too."""
        self.note(about, told.sure, f"{key} = {_value(told.value, self)}: {told.why}" if told.value else told.why)
        return told

    def name(self, path: Path) -> str:
        """A path as the user knows it: from the folder on."""
        return _relative(path, self.folder)

    def text(self) -> str:
        """The take file."""
        head = {"name": Told(self.folder.name or "take"), **self.head}
        head.setdefault("body", Told("humanoid", "sure", 'a whole person; "humanoid_hands" has fingers, too'))
        first = _table("[take]", head, self) + "".join(f"# {comment}\n" for comment in self.comments)
        parts = [_HEAD, first]
        if self.calibration:
            others = "".join(f"# file = {_value(path, self)}\n" for path in self.others)
            parts.append(_table("[calibration]", self.calibration[1], self) + others)
        parts += [_table("[[camera]]", {"name": Told(name), **keys}, self) for name, keys in self.cameras.items()]
        parts += [_table("[[keypoints]]", keys, self, active) for active, keys in self.keypoints]
        parts += [_table("[[depth]]", keys, self, active) for active, keys in self.depth]
        parts += [_table("[[markers]]", keys, self, active) for active, keys in self.markers]
        parts += [_table("[[surface_points]]", keys, self, active) for active, keys in self.surface_points]
        return "\n".join(parts)


def _table(title: str, keys: Entry, draft: Draft, active: bool = True) -> str:
    lines = [title]
    for key, told in keys.items():
        line = f"# {key} = " if told.value is None else f"{key} = {_value(told.value, draft)}"
        lines.append(f"{line:<{_WIDTH - 2}}  # {told.sure}: {told.why}" if told.why else line)
    return "".join(f"{'' if active else '# '}{line}\n" for line in lines)


def _value(value: object, draft: Draft) -> str:
    if isinstance(value, Path):
        value = _relative(value, draft.beside)
    if isinstance(value, float):
        return f"{value:.9g}" if value != int(value) else f"{value:.1f}"
    return json.dumps(value, ensure_ascii=False)


def _relative(path: Path, start: Path) -> str:
    """Path from a folder on, with slashes; whole where the two have nothing in common."""
    try:
        shared = os.path.commonpath([path, start])
    except ValueError:  # another drive
        return path.as_posix()
    return path.as_posix() if shared == path.anchor else Path(os.path.relpath(path, start)).as_posix()
