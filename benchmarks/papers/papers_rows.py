"""Rows of docs/papers, tried once: `python -m benchmarks papers`; their values: `python -m benchmarks.page`.

A page a paper has a heading a row. The parts of benchmarks that a row names run in their quick form; a row that names
none is tried by its tests. The quick form of this area runs neither, as the other areas and the tests do: it checks
that all that the pages name is there. `fill` writes the values of the pages' tables and the index docs/papers.md, as
the log has them.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from benchmarks.areas import AREAS
from benchmarks.figures import LEFT_OUT, ROOT, figure, quick
from benchmarks.ledger import LOG, Record, read

ROWS = 57
"""Of the ledger: 48, and nine that were added."""

AREA_OF_PART = {part: area for area, parts in AREAS.items() for part in parts if "_" in part}

INDEX, PAGES = ROOT / "docs" / "papers.md", ROOT / "docs" / "papers"
_ROW = re.compile(r"^## (P\d-\d+) ([^\n]*)\n(.*?)(?=^## |\Z)", re.M | re.S)
_WORD = re.compile(r"[a-z]\w*")
_TEST = re.compile(r"`((?:\w+/)*)(test_\w+\.py)?`")
_COMMAND = re.compile(r"`(kinefit [^`]*|\[\[\w+\]\])[^`]*`")
_FIGURE = re.compile(r"^\| `([^`]+)` \|.*$", re.M)
_INDEX_ROW = re.compile(r"^\| \[P\d-\d+\].*\n", re.M)
_LIMIT = 900.0  # [s] of one command


@dataclass(frozen=True)
class Row:
    """A row of the five pages: item, title, and the parts of benchmarks, the tests and the figures that it names.

    `way` is its command, table of takes or "Python"; `source` is what its figures are of; `misses`: it names a miss.
    """

    item: str
    title: str
    parts: tuple[str, ...]
    tests: tuple[str, ...]
    figures: tuple[str, ...]
    way: str
    source: str
    misses: bool

    @property
    def commands(self) -> list[tuple[str, ...]]:
        """What tries it, as words after `python -m`."""
        if not self.parts:
            return [("pytest", "-q", "-x", "-m", "slow or not slow", "-p", "no:cacheprovider", *self.tests)]
        return [("benchmarks", AREA_OF_PART[part], part, "--quick", "--no-log") for part in self.parts]


def pages() -> list[Path]:
    """The pages of the five papers."""
    return sorted(PAGES.glob("p?.md"))


def read_rows(texts: Iterable[str]) -> list[Row]:
    """The rows of the pages; a test without a folder lies in that of the one before it."""
    return [_row(*found.groups()) for text in texts for found in _ROW.finditer(text)]


def _row(item: str, title: str, text: str) -> Row:
    tests, folder = [], ""
    for where, name in _TEST.findall(text.partition("Tests: ")[2].partition("\n")[0]):
        folder = where or folder
        tests.append(f"{folder}{name}" if folder.startswith("tests/") else f"tests/{folder}{name}")
    parts = dict.fromkeys(word for word in _WORD.findall(text) if word in AREA_OF_PART)
    way, source = _COMMAND.search(text), re.search(r"\*\*Figure\*\* \((.*?)\)", text)
    return Row(
        item, title, tuple(parts), tuple(tests), tuple(_FIGURE.findall(text)),
        f"`{way[1].strip()}`" if way else "Python", source[1] if source else "", "Missed" in text or "Missing" in text,
    )  # fmt: skip


def filled_page(text: str, records: Mapping[str, Record]) -> str:
    """A page whose rows have tables with value, goal and verdict as the log has them."""

    def line(found: re.Match[str]) -> str:
        return f"| `{found[1]}` | {' | '.join(_cells(records[found[1]]))} |"

    return _ROW.sub(lambda row: _FIGURE.sub(line, row[0]), text)


def filled_index(text: str, rows: Iterable[Row], records: Mapping[str, Record]) -> str:
    """The index with a line a row in the tables of the papers."""
    lines = _INDEX_ROW.sub("", text)
    for row in reversed(list(rows)):
        paper = row.item.partition("-")[0]
        anchor = re.sub(r"[^\w -]", "", f"{row.item} {row.title}".lower()).replace(" ", "-")
        link = f"[{row.item}](papers/{paper.lower()}.md#{anchor})"
        head = re.compile(rf"(^## {paper}\b.*?\n\| --- .*?\n)", re.M | re.S)
        line = f"| {link} | {row.title} | {row.way} | {row.source} | {_state(row, records)} |\n"
        lines = head.sub(lambda found, line=line: found[1] + line, lines, count=1)
    return lines


def _state(row: Row, records: Mapping[str, Record]) -> str:
    missed = "; **misses**" if row.misses else ""
    if not row.figures:
        return f"no figure of its own{missed}"
    found = [records[name] for name in row.figures]
    met = sum(record.verdict == "met" for record in found)
    return f"{met} of {len(found)} goals met{missed}"


def _cells(record: Record) -> tuple[str, str, str]:
    value = f"{record.value} {record.unit}".strip() if record.value else "not measured"
    return value.replace("|", "/"), record.goal, record.verdict.replace("missed", "**missed**")


def fill() -> None:
    """Write the pages and the index as the log has them."""
    records = read(LOG)
    for page in pages():
        page.write_text(filled_page(page.read_text("utf-8"), records), "utf-8")
    rows = read_rows(page.read_text("utf-8") for page in pages())
    INDEX.write_text(filled_index(INDEX.read_text("utf-8"), rows, records), "utf-8")


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
    rows = read_rows(page.read_text("utf-8") for page in pages())
    absent = [f"{row.item}: {test}" for row in rows for test in row.tests if not (ROOT / test).exists()]
    if absent:
        raise ValueError(f"docs/papers names what is not there: {', '.join(absent)}")
    idle = [row.item for row in rows if not (row.parts or row.tests)]
    figure("papers_rows", len(rows), "rows", f"== {ROWS}")
    figure("papers_without_trial", len(idle), f"rows {' '.join(idle)}".strip(), "== 0")
    for row in rows:
        good = None if quick() else float(all(map(ended, row.commands)))
        figure(f"papers_{row.item.replace('-', '_').lower()}", good, "ended", "== 1", LEFT_OUT)
