"""What lies in the folders of a session: takes, their results, and how far each is."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from kinefit._files import read_npz
from kinefit.batch.viewed import is_outdated
from kinefit.errors import FileError, KinefitError, printable
from kinefit.readers.depth.images import natural
from kinefit.readers.guess.files import VIDEOS
from kinefit.readers.take.file import takes_in

NEW = "new"
UNFINISHED = "unfinished"
COMPLETE = "tracked"
OUTDATED = "outdated"
"""States of a take: not tracked yet, stopped before its end, tracked, changed since it was tracked."""

_MAX_DEPTH = 3  # of folders below the session's in which takes are looked for
_MAX_FOLDERS = 2000  # that are looked into, so that a whole disk ends in a moment


@dataclass(frozen=True)
class TakeFolder:
    """A take file with its folder of results.

    Parameters
    ----------
    file : Path, absolute
    """

    file: Path

    @property
    def out(self) -> Path:
        """Folder of the results, as `kinefit track` names it."""
        return self.file.with_name(f"{self.file.stem}-kinefit")

    @property
    def check_page(self) -> Path:
        """Page that `kinefit check` writes."""
        return self.file.with_name(f"{self.file.stem}-check.html")

    @property
    def people(self) -> tuple[Path, ...]:
        """Folders of results, one a person, that hold a motion."""
        many = sorted(self.out.glob("person-*/motion.npz"), key=lambda p: natural(p.parent.name))
        alone = self.out / "motion.npz"
        return (self.out,) if alone.is_file() and not many else tuple(motion.parent for motion in many)

    @property
    def state(self) -> str:
        """NEW, UNFINISHED, COMPLETE or OUTDATED."""
        if (self.out / "unfinished").exists() or any(self.out.glob("person-*/unfinished")):
            return UNFINISHED
        if not (people := self.people):
            return NEW
        return OUTDATED if any(is_outdated(_made_from(folder), self.file) for folder in people) else COMPLETE


def _made_from(folder: Path) -> Mapping[str, Any]:
    """What the motion in a folder of results was computed from; empty where it cannot be read."""
    motion = folder / "motion.npz"
    try:
        return _provenance(motion, motion.stat().st_mtime_ns)
    except (KinefitError, OSError, KeyError, ValueError):
        return {}


@lru_cache(4096)
def _provenance(motion: Path, changed: int) -> Mapping[str, Any]:
    return dict(json.loads(str(read_npz(motion, "provenance", remedy="")["provenance"])))


def subfolders(folder: Path) -> list[Path]:
    """Folders in a folder that may hold recordings, by name, without hidden ones and results.

    Raises
    ------
    FileError
        The folder is missing, or may not be read.
    """
    try:
        with os.scandir(folder) as entries:
            found = [Path(entry.path) for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
    except OSError as error:
        remedy = "Choose a folder that is there: it was moved, or its drive is not connected."
        raise FileError(f"this folder cannot be opened ({error.strerror})", file=folder, remedy=remedy) from error
    return sorted((path for path in found if not is_result(path)), key=lambda path: path.name.lower())


def is_result(folder: Path) -> bool:
    """Whether kinefit made a folder: results, detections, former take files, session of `kinefit live`."""
    return folder.name.endswith(("-kinefit", "-detect", "-before"))


def video_files(folder: Path) -> list[Path]:
    """Video files directly in a folder, by name; empty if it cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEOS and path.is_file())
    except OSError:
        return []


def takes_below(root: Path, *, addressable: bool = True) -> list[TakeFolder]:
    """Takes in a folder and the folders below it, by path.

    `addressable`: those whose path a page's address can hold; False: the others, in folders whose names are not UTF-8.
    """
    found: list[TakeFolder] = []
    at, looked = [(root, 0)], 0
    while at and looked < _MAX_FOLDERS:
        folder, depth = at.pop(0)
        looked += 1
        try:
            found += [TakeFolder(take.absolute()) for take in takes_in(folder)]
            at += [(sub, depth + 1) for sub in subfolders(folder)] if depth < _MAX_DEPTH else []
        except (KinefitError, OSError):
            continue
    found = [take for take in found if (printable(take.file) == str(take.file)) is addressable]
    return sorted(found, key=lambda take: take.file)
