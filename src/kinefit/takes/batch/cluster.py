"""Run jobs on the workers of a Dask cluster (extra `cluster`)."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from kinefit.errors import ExportError, extra
from kinefit.fitting.tracking.checkpoints.checkpoint import code_digest
from kinefit.takes.batch.processes import Failure

T = TypeVar("T")
R = TypeVar("R")

_CONNECT_TIMEOUT = 15.0  # [s] for the scheduler to answer


def run_there(
    do: Callable[[T], R], jobs: Sequence[T], *, address: str, retries: int
) -> Iterator[tuple[int, R | Failure]]:
    """Run jobs on a cluster; yields the number and result of each as it ends.

    Parameters
    ----------
    do : function of a module, which workers import
    jobs : arguments of the function, which are pickled
    address : of the scheduler, such as "tcp://host:8786"
    retries : int, number of further trials of a job that raised an error. Jobs whose worker died are retried by the
        scheduler (`distributed.scheduler.allowed-failures`, 3 by default). It counts a death against all jobs of the
        worker, so each job that it gives up is run once more without the others.

    Raises
    ------
    ExportError
        The extra "cluster" is not installed, no scheduler answers, or a worker has another version of kinefit.
    """
    with extra("cluster", "a cluster needs the package distributed", ExportError, place="--cluster"):
        from distributed import Client
    try:
        client = Client(address, timeout=_CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        remedy = "Start it with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`."
        raise ExportError(f"no Dask scheduler answers at {address}", place="--cluster", remedy=remedy) from error
    with client:
        _check_workers(client, address)
        run = uuid.uuid4().hex
        keys = [f"kinefit-{run}-{k}" for k in range(len(jobs))]
        futures = client.map(do, jobs, key=keys, retries=retries, pure=False)
        numbers = {future.key: k for k, future in enumerate(futures)}
        blamed = []
        for future, result in _ended(client, futures):
            number = numbers[future.key]
            if future.status != "finished" and _killed(result):
                blamed.append(number)
            else:
                yield number, _result(future, result)
            future.release()
        for number in sorted(blamed):
            future = client.submit(do, jobs[number], key=f"{keys[number]}-alone", retries=retries, pure=False)
            yield from ((number, _result(*ended)) for ended in _ended(client, [future]))


def _check_workers(client: Any, address: str) -> None:
    """Raise an error if a worker runs another version of kinefit."""
    try:
        codes = client.run(code_digest)
    except Exception as error:
        remedy = "Install this version of kinefit on all workers."
        raise ExportError(f"a worker cannot import kinefit ({error})", place=address, remedy=remedy) from error
    other = [worker for worker, code in codes.items() if code != code_digest()]
    if other:
        remedy = "Install this version on all workers, and restart them."
        problem = f"{len(other)} workers have another version of kinefit ({other[0]})"
        raise ExportError(problem, place=address, remedy=remedy)


def _ended(client: Any, futures: list[Any]) -> Iterator[tuple[Any, Any]]:
    """Iterate over futures as they end, each with its result or error."""
    from distributed import as_completed

    return as_completed(futures, loop=client.loop, with_results=True, raise_errors=False)  # type: ignore[no-any-return]


def _result(future: Any, result: Any) -> Any:
    if future.status == "finished":
        return result
    error = _error(result)
    return Failure("the worker died in every attempt" if _killed(error) else f"{type(error).__name__}: {error}")


def _error(result: Any) -> Any:
    return result[1] if isinstance(result, tuple) and len(result) == 3 else result


def _killed(result: Any) -> bool:
    return type(_error(result)).__name__ == "KilledWorker"
