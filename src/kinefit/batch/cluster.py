"""Jobs on the workers of a Dask cluster (extra `cluster`)."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from kinefit.batch.processes import Failure
from kinefit.errors import ExportError
from kinefit.tracking.checkpoint import code_digest

T = TypeVar("T")
R = TypeVar("R")

_PATIENCE = 15.0  # [s] until a scheduler must have answered


def run_there(
    do: Callable[[T], R], jobs: Sequence[T], *, address: str, retries: int
) -> Iterator[tuple[int, R | Failure]]:
    """Do jobs on a cluster; yields the number of each with its result, as they end.

    Parameters
    ----------
    do : function of a module, which workers import
    jobs : anything that can be pickled
    address : of the scheduler, such as "tcp://host:8786"
    retries : int, how often a job is tried again that raised an error; of one whose worker died, the scheduler decides
        (`distributed.scheduler.allowed-failures`, 3 unless configured).

    Raises
    ------
    ExportError
        The extra "cluster" is not installed, no scheduler answers, or a worker has another kinefit.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        remedy = "Install it: pip install 'kinefit[cluster]'."
        raise ExportError("a cluster needs the package distributed", place="--cluster", remedy=remedy) from error
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        remedy = "Start one with `dask scheduler`, workers with `dask worker ADDRESS --nthreads 1`."
        raise ExportError(f"no scheduler answers at {address}", place="--cluster", remedy=remedy) from error
    with client:
        _check_workers(client, address)
        run = uuid.uuid4().hex
        keys = [f"kinefit-{run}-{k}" for k in range(len(jobs))]
        futures = client.map(do, jobs, key=keys, retries=retries, pure=False)
        numbers = {future.key: k for k, future in enumerate(futures)}
        ended = as_completed(futures, loop=client.loop, with_results=True, raise_errors=False)
        for future, result in ended:
            number = numbers[future.key]
            yield number, result if future.status == "finished" else _failure(result)
            future.release()


def _check_workers(client: Any, address: str) -> None:
    """Refuse workers that would compute something else."""
    try:
        codes = client.run(code_digest)
    except Exception as error:
        remedy = "Install the same kinefit on all of them."
        raise ExportError(f"a worker cannot import kinefit ({error})", place=address, remedy=remedy) from error
    other = [worker for worker, code in codes.items() if code != code_digest()]
    if other:
        remedy = "Install the same kinefit on all of them, and start them anew."
        raise ExportError(f"another kinefit on {len(other)} of the workers ({other[0]})", place=address, remedy=remedy)


def _failure(result: Any) -> Failure:
    error = result[1] if isinstance(result, tuple) and len(result) == 3 else result
    if type(error).__name__ == "KilledWorker":
        return Failure("the worker died, again and again")
    return Failure(f"{type(error).__name__}: {error}")
