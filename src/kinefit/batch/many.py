"""Many takes: each tracked into a folder of its own, and one summary of all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from pathlib import Path

from kinefit._arguments import checked
from kinefit.batch.find import Found, find_takes
from kinefit.batch.one import Choices
from kinefit.batch.outcome import Row, failed
from kinefit.batch.processes import Failure, run_here
from kinefit.batch.summary import write_summary
from kinefit.batch.work import TakeJob, work
from kinefit.errors import ExportError

Told = Callable[[int, int, tuple[Row, ...]], None]
"""Called with how many takes are done, how many there are, and the rows of the one that ended."""


@checked
def track_takes(
    patterns: str | PathLike[str] | Found | Sequence[str | PathLike[str]], out: str | PathLike[str], *,
    choices: Choices | None = None, workers: int = 1, cluster: str | None = None, retries: int = 2,
    progress: Told | None = None,
) -> tuple[Row, ...]:  # fmt: skip
    """Track takes that are independent of each other, in processes of this machine or on a cluster.

    A take that fails stops no other: its error stands in its row. One that an earlier run has done, of the same files
    and with the same choices, is not done again; one that was stopped goes on. How takes are split over workers
    changes no bit of the results. In a script, call it below `if __name__ == "__main__":`, as workers import it.

    Parameters
    ----------
    patterns : such as "sessions/**/take.toml", see `find_takes`; or what that found
    out : folder of all results and of the summary
    choices : Choices, what is made of each take
    workers : int, processes of this machine; each has one thread for linear algebra
    cluster : address of a Dask scheduler instead, such as "tcp://host:8786"; takes and `out` must be on a file system
        that its workers share, under the same paths
    retries : int, how often a take is tried again whose worker died or met a fault that is not the take's
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
        No workers, or a cluster that cannot be used; the summary cannot be written.
    """
    if workers < 1 or retries < 0:
        problem = f"{workers} workers, {retries} retries"
        raise ExportError(problem, remedy="Give one worker or more, and no negative number.")
    if isinstance(patterns, str | PathLike):
        patterns = [patterns]
    found = patterns if isinstance(patterns, Found) else find_takes(patterns)
    out, choices = Path(out).absolute(), choices or Choices()
    jobs = [_job(found, take, out, choices) for take in found.takes]
    rows: dict[int, tuple[Row, ...]] = {}
    for number, result in _results(jobs, workers, cluster, retries):
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
    return TakeJob(take, found.label(take), folder, folder.relative_to(out).as_posix(), choices)


def _results(
    jobs: Sequence[TakeJob], workers: int, cluster: str | None, retries: int
) -> Iterator[tuple[int, tuple[Row, ...] | Failure]]:
    if cluster is None:
        return run_here(work, jobs, workers=min(workers, len(jobs)), retries=retries)
    from kinefit.batch.cluster import run_there

    return run_there(work, jobs, address=cluster, retries=retries)
