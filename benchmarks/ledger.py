"""The log of all figures, docs/figures.csv: `figure` writes to it in whole runs, `page` makes docs/figures.md of it."""

from __future__ import annotations

import csv
import fcntl
import os
import platform
import re
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import date
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from benchmarks.figures import ROOT

LOG = ROOT / "docs" / "figures.csv"
BEFORE = "before the log"
"""Reason of a record that no run wrote: value, date and commit are those of the page before there was a log."""


class Record(NamedTuple):
    """One figure of the last whole run that printed it; value and goal as printed."""

    command: str
    name: str
    value: str
    unit: str
    goal: str
    verdict: str
    reason: str
    date: str
    commit: str
    machine: str


def read(log: Path) -> dict[str, Record]:
    """The records by the figure's name."""
    if not log.exists():
        return {}
    with log.open(encoding="utf-8", newline="") as file:
        return {row["name"]: Record(**row) for row in csv.DictReader(file)}


def write(records: Mapping[str, Record], log: Path) -> None:
    """Replace the log in one step, sorted by area and name: a reader sees the old one or the new one."""
    part = log.with_suffix(".part")
    with part.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(Record._fields)
        table.writerows(sorted(records.values()))
    os.replace(part, log)


def record(name: str, value: str, unit: str, goal: str, verdict: str, reason: str, *, command: str) -> None:
    """Log a figure in place of its last record; a figure that was not measured replaces none that was."""
    if not commit():
        print("# not logged: no commit, as this is no checkout of git", flush=True)
        return
    new = Record(command, name, value, unit, goal, verdict, reason, date.today().isoformat(), commit(), machine())
    with _locked(LOG.parent):
        records = read(LOG)
        if new.value or name not in records or not records[name].value:
            write(records | {name: new}, LOG)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One process at a time; the lock ends with the process."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@cache
def commit() -> str:
    """Short hash of the commit, with "+changes" where `src` or `benchmarks` differ from it; empty without git."""
    found = _git("rev-parse", "--short=7", "HEAD").strip()
    return found + ("+changes" if found and _git("status", "--porcelain", "--", "src", "benchmarks") else "")


def _git(*words: str) -> str:
    try:
        return subprocess.run(["git", "-C", ROOT, *words], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return ""


@cache
def machine() -> str:
    """Processor, cores, and versions of Python, numpy and numba."""
    try:
        model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    except OSError:
        model = None
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba"))
    processor = model[1] if model else platform.processor() or platform.machine()
    return f"{processor}, {os.cpu_count()} cores, Python {platform.python_version()}, {packages}"
