"""The log of all figures, `docs/figures.csv`, and the tables of `docs/figures.md`, whose cells are filled from it.

`figure` writes to the log in whole runs. `python -m benchmarks.ledger` then fills the tables of figures: value, goal,
verdict and run of every row. A test compares the page with the log, so that no value can be edited by hand.
"""

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

ROOT = Path(__file__).resolve().parents[1]
LOG, PAGE = ROOT / "docs" / "figures.csv", ROOT / "docs" / "figures.md"
BEFORE = "before the log"
"""Reason of a record that no run wrote: value, date and commit are those of the page before there was a log."""

NOT_RERUN, NOT_MEASURED, NO_VALUE = "not rerun", "not measured", "–"
_SIGNS = {"<=": "≤", ">=": "≥", ">": ">", "==": ""}
_UNITS = {"x": "×", "deg": "°"}


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


def filled(page: str, records: Mapping[str, Record]) -> str:
    """The page with every row of a table of figures as the log has it; a verdict's remark stays while its value does.

    A table of figures has the columns `figure`, `value`, `goal`, one without a head for the verdict, and `run`. Its
    rows begin with the figure's name in backticks. A row whose figure is not in the log has no value.

    Raises
    ------
    ValueError
        Where a row has no name, or a name has two rows.
    """
    lines, head, seen = page.split("\n"), [], set()
    for number, line in enumerate(lines):
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if not cells or not head:
            head = cells
        elif head[0].startswith("figure") and not re.fullmatch(r"[|\s:-]+", line):
            name = (re.match(r"`([^`]+)`", cells[0]) or [None, None])[1]
            if name is None or name in seen:
                fault = "a second row of" if name else "no name in backticks at the beginning of"
                raise ValueError(f"docs/figures.md:{number + 1}: {fault} {cells[0]}")
            seen.add(name)
            _fill(cells, head, records.get(name))
            lines[number] = f"| {' | '.join(cells)} |".replace("|  |", "| |").replace("|  |", "| |")
    return "\n".join(lines)


def _fill(cells: list[str], head: list[str], record: Record | None) -> None:
    value, goal, run = (head.index(column) for column in ("value", "goal", "run"))
    verdict = head.index("", goal)
    old = cells[value]
    if record is None:
        cells[value], cells[verdict], cells[run] = NO_VALUE, "", NOT_RERUN
        return
    cells[value] = _with_unit(record) if record.value else NO_VALUE
    relation, bound = record.goal.split()
    cells[goal] = f"{_SIGNS[relation]} {_number(bound)}".strip()
    if cells[value] != old or not cells[verdict].strip("*").startswith(record.verdict):
        cells[verdict] = {"met": "met", "missed": "**missed**"}.get(record.verdict, f"{NOT_MEASURED}: {record.reason}")
    cells[run] = f"{NOT_RERUN}, " * (record.reason == BEFORE) + f"{record.date} {record.commit}"


def _with_unit(record: Record) -> str:
    unit = re.sub(r"^(x|deg)(?!\w)", lambda found: _UNITS[found[1]], record.unit)
    return f"{_number(record.value)}{'' if unit.startswith('°') else ' '}{unit}".strip()


def _number(printed: str) -> str:
    """As the page writes it: 12,340 for 1.234e+04, 8e-7 for 8e-07."""
    if abs(float(printed)) >= 1000 and "." not in f"{float(printed):.6g}":
        return f"{float(printed):,.0f}"
    return printed.replace("e-0", "e-")


def main() -> None:
    """Fill the page, and print which rows changed and which figures have no row."""
    page, records = PAGE.read_text("utf-8"), read(LOG)
    new = filled(page, records)
    PAGE.write_text(new, "utf-8")
    for old, line in zip(page.split("\n"), new.split("\n"), strict=True):
        if line != old:
            print(line)
    for name in (name for name in records if f"| `{name}`" not in new):
        print(f"# on no row of the page: {name} ({records[name].command})")


if __name__ == "__main__":
    main()
