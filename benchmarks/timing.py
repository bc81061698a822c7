"""What a piece of work takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

Result = TypeVar("Result")


@contextmanager
def timed(
    spent: list[float], scale: float = 1.0, *, clock: Callable[[], float] = time.process_time
) -> Iterator[None]:
    """Append to a list what a block takes of the processor [s], times `scale`; `clock`: or by another one."""
    began = clock()
    yield
    spent.append(scale * (clock() - began))


def took(work: Callable[[], Result], *, clock: Callable[[], float] = time.process_time) -> tuple[Result, float]:
    """What a call gave, and what it took of the processor [s]."""
    began = clock()
    return work(), clock() - began


def fastest(
    work: Callable[[], Result], times: int, *, clock: Callable[[], float] = time.process_time
) -> tuple[Result, float]:
    """What a call gave the first time, and the least that it took of the processor [s] in so many times."""
    result, least = took(work, clock=clock)
    return result, min([least, *(took(work, clock=clock)[1] for _ in range(times - 1))])
