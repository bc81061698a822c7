"""The take file that is meant where a folder, a video or another file is given for it."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from kinefit._files import parse_toml, regular
from kinefit.errors import FileError, KinefitError, TakeError, command
from kinefit.readers.guess.files import MARKERS, VIDEOS
from kinefit.readers.take.entries import TABLES


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
            raise FileError("no take file in this folder", file=path, remedy=f"Write one: {command('init', path)}")
        if len(found) > 1 and found[0].name != "take.toml":
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
    if kind in MARKERS:
        raise FileError("a marker file, not a take file", file=path, remedy=f"Run: {command('markers', 'fit', path)}")
    if kind == ".npz":
        raise FileError("a motion, not a take file", file=path, remedy=f"Look at it: {command('view', path)}")
    return path


def takes_in(folder: Path) -> list[Path]:
    """The take files that lie in a folder, take.toml first."""
    return sorted((file for file in folder.glob("*.toml") if is_take(file)), key=lambda f: (f.name != "take.toml", f))


def is_take(file: Path) -> bool:
    """Whether a TOML file is a take file; one that cannot be read is, where it is called take.toml."""
    if file.name == "take.toml":
        return True
    try:
        tables = parse_toml(regular(file).read_text("utf-8"), file)
    except (OSError, UnicodeDecodeError, KinefitError):
        return False
    return bool(set(tables) - {"calibration"}) and not set(tables) - set(TABLES)  # which calibrations have, too
