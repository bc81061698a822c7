"""Many takes: how much faster two workers are, what a scheduler costs.

Takes are simulated as those of `long`. Speed is of the whole command, workers' start included; on a machine
that does something else besides, it is not measured. The scheduler of Dask gets takes that take no time, on two workers
of this machine.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.commands import used
from benchmarks.figures import NotMeasured, amount, figure
from benchmarks.speed.long import write_long_take
from kinefit.takes.batch.one import Choices, TakeJob
from kinefit.takes.batch.processes import run_there
from kinefit.takes.batch.summary import Row

TAKES = 10_000
"""Takes that the scheduler of Dask gets."""

BUSY = 0.5
"""Processes that wait for a core already, from which on speeds are not measured."""

_OPTIONS = ("--no-overlays", "--no-report", "--formats", "motion,csv")


def run() -> None:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        for k in range(amount(8, 2)):
            write_long_take(folder / "sessions" / f"s{k:02d}", amount(600, 30), seed=10_000 * k)
        speed(folder)
    overhead(amount(TAKES, 200))


def speed(folder: Path) -> None:
    """Two workers against one."""
    load, cores = _load(), len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    seconds = {}
    for workers in (1, 2):
        began = time.monotonic()
        used(*_words(folder, f"out-{workers}", workers))
        seconds[workers] = time.monotonic() - began
    ratio, reason = seconds[1] / seconds[2], ""
    print(f"  {seconds[1]:.1f} s with one worker, {seconds[2]:.1f} s with two: {ratio:.2f} times; load {load:.1f}")
    if cores < 2 or load > BUSY:
        ratio, reason = None, f"{cores} cores, and {load:.1f} processes ran on them before"
    figure("batch_two_workers", ratio, "times as fast", ">= 1.9", reason)


def overhead(takes: int) -> None:
    """What Dask adds to each of so many takes."""
    goal = ("ms", "<= 50")
    try:
        from distributed import LocalCluster
    except ImportError as error:
        raise NotMeasured("the extra cluster is not installed") from error
    jobs = [TakeJob(Path(f"s{k}/take.toml"), f"s{k}", Path(f"out/s{k}"), f"s{k}", Choices()) for k in range(takes)]
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", protocol="tcp://") as cluster:
        began = time.monotonic()
        rows = dict(run_there(nothing, jobs, address=cluster.scheduler_address, retries=2))
        seconds = time.monotonic() - began
    if rows != {k: nothing(job) for k, job in enumerate(jobs)}:
        raise RuntimeError("rows are missing or of other takes")
    print(f"  {takes} takes in {seconds:.1f} s")
    figure("batch_dask_overhead_ms", 1e3 * seconds / takes, *goal)


def nothing(job: TakeJob) -> tuple[Row, ...]:
    """A take that is done at once."""
    return (Row(take=job.label, folder=job.folder, frames=1, seconds=0.1, quality=1.0, lost=0.0),)


def _words(folder: Path, out: str, workers: int) -> list[object]:
    return ["batch", f"{folder}/sessions/**/take.toml", "--out", folder / out, "--workers", workers, *_OPTIONS]


def _load() -> float:
    """Processes that run or wait for a core, as /proc tells it now; else the mean of the last minute."""
    try:
        return float(np.mean([_running() for _ in range(10)]))
    except (OSError, IndexError, ValueError):
        return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0


def _running() -> int:
    time.sleep(0.1)
    return int(Path("/proc/loadavg").read_text().split()[3].partition("/")[0]) - 1
