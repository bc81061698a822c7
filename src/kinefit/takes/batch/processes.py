"""Run jobs in processes of one machine; a process that dies is replaced, and its job is retried."""

from __future__ import annotations

import math
import multiprocessing as mp
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from kinefit._processes import starting

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
