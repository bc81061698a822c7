"""Every row of docs/papers.md, tried once: `python -m benchmarks papers`.

The parts of benchmarks that a row names run in their quick form; a row that names none is tried by its tests. The quick
form of this area runs neither, as the other areas and the tests do: it checks that all that the page names is there.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache

from benchmarks.areas import AREAS
from benchmarks.figures import LEFT_OUT, ROOT, figure, quick

ROWS = 57
"""Of the ledger: 48, and nine that were added."""

AREA_OF_PART = {part: area for area, parts in AREAS.items() for part in parts if "_" in part}

_ROW = re.compile(r"\| (P\d-\d+) \|")
_WORD = re.compile(r"[a-z]\w*")
_TEST = re.compile(r"`((?:\w+/)*)(test_\w+\.py)?`")
_LIMIT = 900.0  # [s] of one command


@dataclass(frozen=True)
class Row:
    """A row of the page: its item, the parts of benchmarks and the tests that it names."""

    item: str
    parts: tuple[str, ...]
    tests: tuple[str, ...]

    @property
    def commands(self) -> list[tuple[str, ...]]:
        """What tries it, as words after `python -m`."""
        if not self.parts:
            return [("pytest", "-q", "-x", "-m", "slow or not slow", "-p", "no:cacheprovider", *self.tests)]
        return [("benchmarks", AREA_OF_PART[part], part, "--quick", "--no-log") for part in self.parts]


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
        for where, name in _TEST.findall(cells[header.index("test")]):
            folder = where or folder
            tests.append(f"{folder}{name}" if folder.startswith("tests/") else f"tests/{folder}{name}")
        parts = dict.fromkeys(word for word in _WORD.findall(line) if word in AREA_OF_PART)
        out.append(Row(found[1], tuple(parts), tuple(tests)))
    return out


@cache
def ended(command: tuple[str, ...]) -> bool:
    """Whether a command ends without an error."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-m", *command], cwd=ROOT, env=environment, timeout=_LIMIT, capture_output=True, text=True
        )
    except subprocess.TimeoutExpired:
        print(f"{' '.join(command)}: not ended after {_LIMIT:.0f} s")
        return False
    if done.returncode:
        print(f"{' '.join(command)}: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode == 0


def run() -> None:
    """Print the figures."""
    rows = read_rows((ROOT / "docs" / "papers.md").read_text("utf-8"))
    absent = [f"{row.item}: {test}" for row in rows for test in row.tests if not (ROOT / test).exists()]
    if absent:
        raise ValueError(f"docs/papers.md names what is not there: {', '.join(absent)}")
    idle = [row.item for row in rows if not (row.parts or row.tests)]
    figure("papers_rows", len(rows), "rows", f"== {ROWS}")
    figure("papers_without_trial", len(idle), f"rows {' '.join(idle)}".strip(), "== 0")
    for row in rows:
        good = None if quick() else float(all(map(ended, row.commands)))
        figure(f"papers_{row.item.replace('-', '_').lower()}", good, "ended", "== 1", LEFT_OUT)
