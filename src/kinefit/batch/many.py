"""Track many takes, each into its own folder of results, and write one summary."""

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
from kinefit.errors import ExportError, printable

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
    from kinefit.batch.cluster import run_there

    return run_there(work, jobs, address=cluster, retries=retries)
