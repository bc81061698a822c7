"""Work on several cores at once: processes; threads, as compiled kernels, networks and FFmpeg let others run."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

from kinefit._processes import starting

T = TypeVar("T")
R = TypeVar("R")


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """How many threads compute at once: one a core, or as `NUMBA_NUM_THREADS` has it, 1 in workers of a batch."""
    wanted = os.environ.get("NUMBA_NUM_THREADS", "")
    return min(cores(), max(int(wanted), 1)) if wanted.isdecimal() else cores()


def side_by_side(do: Callable[[T], R], things: Iterable[T]) -> Iterator[R]:
    """As `map`, in the same order, `threads()` at a time; as many results at the most wait to be taken.

    The next thing is asked for while others are worked on.
    """
    count, waiting = threads(), deque[Future[R]]()
    if count == 1:
        yield from map(do, things)
        return
    with ThreadPoolExecutor(count) as pool:
        for thing in things:
            waiting.append(pool.submit(do, thing))
            if len(waiting) == count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def ahead(things: Iterable[T]) -> Iterator[T]:
    """The same things, each made while the one before it is used; in one thread where `threads()` is one."""
    if threads() == 1:
        yield from things
        return
    source = iter(things)
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(_next, source)
        while found := following.result():
            following = pool.submit(_next, source)
            yield found[0]


def _next(source: Iterator[T]) -> tuple[T] | tuple[()]:
    """The next thing, alone; nothing at the end."""
    for thing in source:
        return (thing,)
    return ()


class Pool(ProcessPoolExecutor):
    """A `ProcessPoolExecutor` of new processes, each started in the context `starting()`."""

    def __init__(self, workers: int, initializer: Callable[[], object] | None = None) -> None:
        with starting():
            super().__init__(workers, get_context("spawn"), initializer)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **more: Any) -> Future[Any]:
        """Run a function of a module in one of the processes."""
        with starting():  # the executor starts its processes here
            return super().submit(fn, *args, **more)
