"""Track many takes, each into its own folder of results, and write one summary."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from kinefit._arguments import checked
from kinefit._files import parse_toml, regular
from kinefit.errors import ExportError, FileError, KinefitError, command, printable
from kinefit.readers.take.file import is_default_take, is_take, takes_in
from kinefit.takes.batch.one import Choices, TakeJob, work
from kinefit.takes.batch.processes import Failure, run_here, run_there
from kinefit.takes.batch.summary import RECORD, Row, failed, write_summary


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
        return path, sorted(path.glob("**/[Tt][Aa][Kk][Ee].[Tt][Oo][Mm][Ll]"))
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
    return takes[:1] if takes and is_default_take(takes[0]) else takes


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


TakesProgress = Callable[[int, int, tuple[Row, ...]], None]
"""Called with the number of takes that ended, the number of all takes, and the rows of the last one."""


@checked
def track_takes(
    patterns: str | PathLike[str] | Found | Sequence[str | PathLike[str]], out: str | PathLike[str], *,
    choices: Choices | None = None, workers: int = 1, cluster: str | None = None, retries: int = 2,
    time_limit: float = 120.0, progress: TakesProgress | None = None,
) -> tuple[Row, ...]:  # fmt: skip
    """Track independent takes, in processes of this machine or on a cluster.

    A take that fails does not stop the others: its error is in its row. Takes that an earlier run finished, with the
    same files and choices, are not tracked again; interrupted ones continue. Results do not depend on the number of
    workers. In a script, call it below `if __name__ == "__main__":`, since workers import the script.

    Parameters
    ----------
    patterns : such as "sessions/**/take.toml", see `find_takes`; or the result of that function
    out : folder of all results and of the summary
    choices : Choices of results for each take
    workers : int, number of processes on this machine; each uses one thread for linear algebra
    cluster : address of a Dask scheduler instead, such as "tcp://host:8786"; takes and `out` must be on a file system
        that its workers share, under the same paths
    retries : int, number of further trials of a take whose worker died or raised an unexpected error
    time_limit : float [min] without progress after which a take on this machine is stopped, and reported as failed
    progress : called as takes end

    Returns
    -------
    tuple of Row
        A row for each take and person, in the order of the takes; also in `summary.csv` and `summary.html`.

    Raises
    ------
    FileError
        Nothing matches.
    ExportError
        `workers` is below 1 or `retries` below 0; the cluster cannot be used; the summary cannot be written.
    """
    if workers < 1 or retries < 0 or not time_limit > 0:
        problem = f"workers = {workers}, retries = {retries} or time_limit = {time_limit:g} is too small"
        raise ExportError(problem, remedy="Give at least one worker, retries of 0 or more, and some minutes.")
    if isinstance(patterns, str | PathLike):
        patterns = [patterns]
    found = patterns if isinstance(patterns, Found) else find_takes(patterns)
    out, choices = Path(out).absolute(), choices or Choices()
    jobs = [_job(found, take, out, choices) for take in found.takes]
    rows: dict[int, tuple[Row, ...]] = {}
    for number, result in _results(jobs, workers, cluster, retries, 60.0 * time_limit):
        if isinstance(result, Failure):
            rows[number] = (failed(Row(take=jobs[number].label), result),)
        else:
            rows[number] = result
        if progress is not None:
            progress(len(rows), len(jobs), rows[number])
    table = tuple(row for number in range(len(jobs)) for row in rows[number])
    write_summary(table, out)
    return table


def _job(found: Found, take: Path, out: Path, choices: Choices) -> TakeJob:
    folder = found.folder(take, out)
    return TakeJob(take, printable(found.label(take)), folder, printable(folder.relative_to(out).as_posix()), choices)


def _results(
    jobs: Sequence[TakeJob], workers: int, cluster: str | None, retries: int, limit: float
) -> Iterator[tuple[int, tuple[Row, ...] | Failure]]:
    if cluster is None:
        return run_here(work, jobs, workers=min(workers, len(jobs)), retries=retries, limit=limit)
    return run_there(work, jobs, address=cluster, retries=retries)
