"""Find take files by patterns, and the folder of results of each."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from kinefit._files import parse_toml, regular
from kinefit.errors import FileError, KinefitError, command
from kinefit.readers.take.file import is_take, takes_in

RECORD = "batch.json"
"""File in every folder of results of a batch: the take, its key, the files and the summary rows."""


@dataclass(frozen=True)
class Found:
    """Takes found by patterns.

    Parameters
    ----------
    base : Path, folder that contains all of them
    takes : absolute paths, each once, ordered by name
    left_out : TOML files that match too but are no takes, such as calibrations
    """

    base: Path
    takes: tuple[Path, ...]
    left_out: tuple[Path, ...]

    def label(self, take: Path) -> str:
        """A take's path relative to the base, unique for each take."""
        return take.relative_to(self.base).as_posix()

    def folder(self, take: Path, out: Path) -> Path:
        """Folder of a take's results, one for each take."""
        return out / take.relative_to(self.base).with_name(f"{take.stem}-kinefit")


def find_takes(patterns: Sequence[str | os.PathLike[str]]) -> Found:
    """Find the take files of patterns such as "sessions/**/take.toml".

    A file stands for itself, a folder for every take.toml in it and below, a folder matched by a wildcard for its own
    take file. TOML files that are no takes are excluded. Unreadable ones are included, so that their error is reported.
    Files in results of an earlier batch are ignored.

    Raises
    ------
    FileError
        A pattern matches nothing, or no take file.
    """
    bases: list[Path] = []
    files: dict[Path, Path] = {}
    excluded: dict[Path, Path] = {}
    for pattern in patterns:
        base, hits = _matched(os.fspath(pattern))
        takes = [take for hit in hits for take in _takes_at(hit) if not _is_result(take, base)]
        good = [take for take in takes if _may_be_take(take)]
        if not good:
            problem = f"no take file among the {len(hits)} matches" if hits else "nothing matches"
            remedy = f"Give take files, such as 'sessions/**/take.toml'; {command('init')} FOLDER writes one."
            raise FileError(problem, file=pattern, remedy=remedy)
        bases.append(base)
        files |= {take.resolve(): take for take in good}
        excluded |= {take.resolve(): take for take in takes if take not in good}
    base = Path(os.path.commonpath(bases))
    return Found(base, tuple(sorted(files.values())), tuple(sorted(excluded.values())))


def _matched(pattern: str) -> tuple[Path, list[Path]]:
    """The folder before the first wildcard, and the matching paths, all absolute."""
    path = Path(os.path.abspath(os.path.expanduser(pattern)))
    if path.is_dir():
        return path, sorted(path.glob("**/take.toml"))
    if path.exists() or not glob.has_magic(pattern):
        return path.parent, [path] if path.exists() else []
    base = path
    while glob.has_magic(str(base)):
        base = base.parent
    return base, sorted(map(Path, glob.glob(str(path), recursive=True)))


def _takes_at(hit: Path) -> Iterable[Path]:
    if not hit.is_dir():
        return [hit] if hit.suffix.lower() == ".toml" else []
    takes = takes_in(hit)
    return takes[:1] if takes and takes[0].name == "take.toml" else takes


def _is_result(take: Path, base: Path) -> bool:
    """Whether a file is in the results of a batch, below the base."""
    above = [folder for folder in take.parents if folder.is_relative_to(base)]
    return any((folder / RECORD).is_file() for folder in above)


def _may_be_take(file: Path) -> bool:
    try:
        parse_toml(regular(file).read_text("utf-8"), file)
    except (OSError, UnicodeDecodeError, KinefitError):
        return True
    return is_take(file)
