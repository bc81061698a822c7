"""Jobs on the processes of one machine: one that dies is replaced, and its job tried again."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""One of each in every worker, unless the user set another number: workers share the cores."""


class Failure(str):
    """Why a job has no result: what went wrong in its last trial."""


def run_here(
    do: Callable[[T], R], jobs: Sequence[T], *, workers: int, retries: int
) -> Iterator[tuple[int, R | Failure]]:
    """Do jobs in so many processes; yields the number of each with its result, as they end.

    Parameters
    ----------
    do : function of a module, which workers import
    jobs : anything that can be pickled
    workers : int, processes, each of which does one job at a time
    retries : int, how often a job is tried again that raised an error or whose process died
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
            for pipe in wait(list(busy)):
                worker, job = busy.pop(pipe)
                result, alive = worker.result()
                (idle.append if alive else _Worker.end)(worker)
                if isinstance(result, Failure) and tries[job] <= retries:
                    waiting.append(job)
                else:
                    yield job, result
    finally:
        for worker in [*idle, *(worker for worker, _ in busy.values())]:
            worker.end()


class _Worker:
    def __init__(self, do: Callable[[Any], Any]) -> None:
        context = mp.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, do), daemon=True)
        with _one_thread():
            self.process.start()
        theirs.close()

    def give(self, job: Any) -> None:
        try:
            self.pipe.send(job)
        except OSError:  # it has died: `result` finds that out
            pass

    def result(self) -> tuple[Any, bool]:
        """What came of its job, and whether it can do another."""
        try:
            return self.pipe.recv(), True
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode or 0
            how = signal.Signals(-code).name if -code in {*signal.Signals} else f"exit code {code}"
            return Failure(f"the worker process died ({how})"), False

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


@contextmanager
def _one_thread() -> Iterator[None]:
    """An environment for a process that starts, of which numerical libraries read the number of threads."""
    added = [name for name in _THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _serve(pipe: Connection, do: Callable[[Any], Any]) -> None:
    """Do jobs until there are no more; end at once where the process that gives them has died."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is theirs to stop
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        try:
            result = do(job)
        except Exception as error:
            result = Failure(f"{type(error).__name__}: {error}")
        pipe.send(result)


def _end_with_parent() -> None:
    parent = mp.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
