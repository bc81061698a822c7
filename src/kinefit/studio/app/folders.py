"""What lies in the folders of a session: takes, results, and all numbers of the session at a glance."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from kinefit._files import read_npz
from kinefit.errors import FileError, KinefitError, printable
from kinefit.readers.depth.images import PICTURES, natural
from kinefit.readers.guess.files import VIDEOS
from kinefit.readers.take.file import read_take, takes_in
from kinefit.readers.videos.video import ENDINGS
from kinefit.takes.batch.corrections import is_outdated

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
    return _files_of(folder, VIDEOS)


def openable_files(folder: Path) -> list[Path]:
    """Files directly in a folder of which a take can be made, and takes, by name; empty if it cannot be read."""
    return _files_of(folder, {*VIDEOS, *ENDINGS, *PICTURES, ".c3d", ".trc", ".mcap", ".npy", ".toml"})


def _files_of(folder: Path, kinds: set[str]) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.suffix.lower() in kinds and path.is_file())
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


@dataclass(frozen=True)
class SessionRow:
    """One person of one take; a take without results has one, too.

    Parameters
    ----------
    take : TakeFolder
    person : int, number of the person; 0 if the take has one
    folder : Path of the person's results; None if there are none
    session : {"subject": ..., "date": ..., "movement": ...}, what the take's `[session]` states
    problem : what is wrong with the take file; "" if nothing is
    state : of the take, as `TakeFolder.state` has it
    seconds, agreement : float [s], and mean quality, 0 to 1; None without results
    """

    take: TakeFolder
    person: int
    folder: Path | None
    session: Mapping[str, str]
    problem: str
    state: str
    seconds: float | None = None
    agreement: float | None = None


def recordings(root: Path) -> list[SessionRow]:
    """Everybody in all takes below a folder, by path."""
    found = []
    for take in takes_below(root):
        try:
            session, problem = _session(take.file, take.file.stat().st_mtime_ns), ""
        except (KinefitError, OSError) as error:
            session, problem = {}, str(error)
        people, state = take.people, take.state
        for k, folder in enumerate(people, start=1):
            number = k if len(people) > 1 else 0
            found.append(SessionRow(take, number, folder, session, problem, state, *measures(folder / "motion.npz")))
        if not people:
            found.append(SessionRow(take, 0, None, session, problem, state))
    return found


def measures(motion: Path) -> tuple[float | None, float | None]:
    """Length [s] and mean quality of a motion file; (None, None) if it cannot be read."""
    try:
        return _measures(motion, motion.stat().st_mtime_ns)
    except (KinefitError, OSError, KeyError):
        return None, None


@lru_cache(4096)
def _session(take: Path, changed: int) -> dict[str, str]:
    return read_take(take).session.stated


@lru_cache(4096)
def _measures(motion: Path, changed: int) -> tuple[float, float]:
    arrays = read_npz(motion, "rate", "quality", remedy="")
    return len(arrays["quality"]) / float(arrays["rate"]), float(arrays["quality"].mean())
