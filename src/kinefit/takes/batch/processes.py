"""Run jobs in processes of one machine; a process that dies is replaced, and its job is retried.

Or on the workers of a Dask cluster (extra `cluster`).
"""

from __future__ import annotations

import math
import multiprocessing as mp
import os
import signal
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from kinefit._processes import starting
from kinefit.errors import ExportError, extra
from kinefit.fitting.tracking.checkpoints.checkpoint import code_digest

T = TypeVar("T")
R = TypeVar("R")

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Set to 1 in every worker, unless the user set another number: workers share the cores."""


_BEAT_INTERVAL_S = 1.0  # between two reports of progress, and between two looks at the time of the last one
_SENDING = threading.Lock()
_PIPES: list[Connection] = []  # of a worker process, to the process that waits for it; elsewhere empty


class _Beat:
    """Message of a worker whose job is running."""

    last = 0.0  # time.monotonic() of the worker


def progress(*_: object) -> None:
    """Report progress of this worker's job, in place of a `Step`; outside of a worker nothing happens."""
    with _SENDING:
        if _PIPES and time.monotonic() - _Beat.last > _BEAT_INTERVAL_S:
            _Beat.last = time.monotonic()
            _PIPES[0].send(_Beat())


class Failure(str):
    """Error message of a job's last trial, in place of its result."""


def run_here(
    do: Callable[[T], R], jobs: Sequence[T], *, workers: int, retries: int, limit: float = math.inf
) -> Iterator[tuple[int, R | Failure]]:
    """Run jobs in worker processes; yields the number and result of each as it ends.

    Parameters
    ----------
    do : function of a module, which workers import
    jobs : arguments of the function, which are pickled
    workers : int, number of processes, each with one job at a time
    retries : int, number of further trials of a job that raised an error or whose process died
    limit : float [s] without `progress` after which a job is stopped, and not tried again
    """
    waiting, tries = deque(range(len(jobs))), [0] * len(jobs)
    idle: list[_Worker] = []
    busy: dict[Any, tuple[_Worker, int]] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                worker = idle.pop() if idle else _Worker(do)
                job = waiting.popleft()
                tries[job] += 1
                busy[worker.pipe] = worker, job
                worker.give(jobs[job])
            for pipe in wait(list(busy), _BEAT_INTERVAL_S):
                worker, job = busy.pop(pipe)
                result, alive = worker.result()
                if isinstance(result, _Beat):
                    busy[pipe] = worker, job
                    continue
                (idle.append if alive else _Worker.end)(worker)
                if isinstance(result, Failure) and tries[job] <= retries:
                    waiting.append(job)
                else:
                    yield job, result
            for worker, job in [of for of in busy.values() if time.monotonic() - of[0].last_beat > limit]:
                del busy[worker.pipe]
                worker.end()
                yield job, Failure(f"stopped after {limit / 60:g} min without progress; the limit is --time-limit")
    finally:
        for worker in [*idle, *(worker for worker, _ in busy.values())]:
            worker.end()


class _Worker:
    def __init__(self, do: Callable[[Any], Any]) -> None:
        context = mp.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, do), daemon=True)
        with starting(**{name: "1" for name in _THREADS if name not in os.environ}):
            self.process.start()
        theirs.close()

    def give(self, job: Any) -> None:
        self.last_beat = time.monotonic()
        try:
            self.pipe.send(job)
        except OSError:  # the process died; `result` reports it
            pass

    def result(self) -> tuple[Any, bool]:
        """Result of the worker's job, and whether the worker is alive."""
        try:
            found = self.pipe.recv()
            self.last_beat = time.monotonic()
            return found, True
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode or 0
            how = signal.Signals(-code).name if -code in {*signal.Signals} else f"exit code {code}"
            return Failure(f"the worker process died ({how})"), False

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Connection, do: Callable[[Any], Any]) -> None:
    """Run jobs until there are no more; exits at once if the parent process dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _PIPES.append(pipe)
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        try:
            result = do(job)
        except Exception as error:
            result = Failure(f"{type(error).__name__}: {error}")
        with _SENDING:
            pipe.send(result)


def _end_with_parent() -> None:
    parent = mp.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)



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
