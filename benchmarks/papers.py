"""Every row of docs/papers.md, tried once: `python -m benchmarks.papers`.

A row's benchmark runs in its quick form; a row that names none is tried by its tests. The quick form of this area runs
neither, as the other areas and the tests do: it checks that all that the page names is there.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

from benchmarks import AREAS
from benchmarks.figures import LEFT_OUT, figure, quick, run_parts

PARTS = {"papers": "every row of the five papers by its benchmark, or by its tests"}
ROWS = 53
"""Of the ledger: 48, and five that were added."""

_ROOT = Path(__file__).resolve().parents[1]
_ROW = re.compile(r"\| (P\d-\d+) \|")
_BENCHMARK = re.compile(r"python -m benchmarks\.(\w+)((?: \w+)*)")
_LIMIT = 900.0  # [s] of one command


@dataclass(frozen=True)
class Row:
    """A row of the page: its item, its benchmarks as (area, parts), its tests below `tests`."""

    item: str
    benchmarks: tuple[tuple[str, tuple[str, ...]], ...]
    tests: tuple[str, ...]

    def commands(self) -> list[tuple[str, ...]]:
        """What tries it, as words after `python -m`."""
        named = [(f"benchmarks.{area}", *parts, "--quick", "--no-log") for area, parts in self.benchmarks]
        return named or [("pytest", "-q", "-x", "-m", "slow or not slow", "-p", "no:cacheprovider", *self.tests)]

    def absent(self) -> list[str]:
        """Areas, parts and tests that are not there."""
        out = [test for test in self.tests if not (_ROOT / test).exists()]
        for area, parts in self.benchmarks:
            known = import_module(f"benchmarks.{area}").PARTS if area in AREAS else {}
            out += [f"{area} {part}" for part in parts or ("",) if (part and part not in known) or not known]
        return out


def read_rows(text: str) -> list[Row]:
    """The rows of the page; a test without a folder lies in that of the one before it."""
    out, header = [], list[str]()
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        header = cells if cells[0] == "item" else header
        found = _ROW.match(line)
        if found is None:
            continue
        tests, folder = [], ""
        for where, name in re.findall(r"`((?:\w+/)*)(test_\w+\.py)?`", cells[header.index("test")]):
            folder = where or folder
            tests.append(f"{folder}{name}" if folder.startswith("tests/") else f"tests/{folder}{name}")
        benchmarks = {(area, tuple(parts.split())): None for area, parts in _BENCHMARK.findall(line)}
        out.append(Row(found[1], tuple(benchmarks), tuple(tests)))
    return out


@cache
def ended(command: tuple[str, ...]) -> bool:
    """Whether a command ends without an error."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-m", *command], cwd=_ROOT, env=environment, timeout=_LIMIT, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired:
        print(f"{' '.join(command)}: not ended after {_LIMIT:.0f} s")
        return False
    if done.returncode:
        print(f"{' '.join(command)}: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode == 0


def run() -> None:
    """Print the figures."""
    rows = read_rows((_ROOT / "docs" / "papers.md").read_text("utf-8"))
    absent = [f"{row.item}: {name}" for row in rows for name in row.absent()]
    if absent:
        raise ValueError(f"docs/papers.md names what is not there: {', '.join(absent)}")
    idle = [row.item for row in rows if not (row.benchmarks or row.tests)]
    figure("papers_rows", len(rows), "rows", f"== {ROWS}")
    figure("papers_without_trial", len(idle), f"rows {' '.join(idle)}".strip(), "== 0")
    for row in rows:
        good = None if quick() else float(all(map(ended, row.commands())))
        figure(f"papers_{row.item.replace('-', '_').lower()}", good, "ended", "== 1", LEFT_OUT)


if __name__ == "__main__":
    run_parts(PARTS)
