"""`docs/figures.md`, made of the log and of what `docs/figures.toml` says of it: `python -m benchmarks.page` writes it.

The values of the pages on the papers are written, too.

A subject of the page takes the figures whose command begins with one of its `runs`. Figures whose names begin alike
share a row of its table, in which each has a line of its own; a run that all of them have in common stands once.
A figure that is retired keeps its record in the log and has no line but that of the reason, at the end of the page.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from datetime import date, timedelta
from fnmatch import fnmatchcase
from itertools import groupby
from textwrap import shorten
from typing import Any

from benchmarks.figures import ROOT
from benchmarks.ledger import BEFORE, LOG, Record, read
from benchmarks.papers.papers_rows import fill

PAGE, WORDS = ROOT / "docs" / "figures.md", ROOT / "docs" / "figures.toml"
OLD = timedelta(weeks=4)
_TOGETHER = 9
"""Figures that share a row at most."""

_LONG_UNIT = 22
"""Letters of a unit from which on only its first words are shown."""

_BEFORE_MARK = "†"
"""Of a value from before the log, as the head of docs/figures.toml says."""

_SIGNS = {"<=": "≤ ", ">=": "≥ ", ">": "> ", "==": ""}
_UNITS = {"x": "×", "deg": "°"}
_NO_BREAK = str.maketrans({" ": "\N{NO-BREAK SPACE}", "-": "\N{NON-BREAKING HYPHEN}"})


def page(records: Mapping[str, Record], words: Mapping[str, Any]) -> str:
    """The whole page.

    Raises
    ------
    ValueError
        Where a command of the log belongs to no subject, a meaning or a retired name to no figure, or a sentence
        names what was not measured.
    """
    newest = max(date.fromisoformat(record.date) for record in records.values())
    old = [(_retired(one, records), one["reason"]) for one in words["retired"]]
    records = {name: one for name, one in records.items() if not any(name in gone for gone, _ in old)}
    names = figures_of_subjects(records, words["subject"])
    parts = [words["head"].strip(), _table(("what", "figure", "goals"), _glance(records, words["glance"]))]
    for subject in words["subject"]:
        rows = [_cells(row, records, newest) for row in rows_of(names[subject["title"]])]
        parts += [f"## {subject['title']}", " ".join(subject["text"].split()), *subject.get("images", [])]
        parts.append(_table(("what", "value", "goal", "verdict", "run"), rows))
        means = [f"`{name}`: {meaning}" for name, meaning in subject.get("means", {}).items()]
        parts += ["<br>".join(means)] * bool(means)
    head = "figures", "what they were last", "why no benchmark prints them any more"
    rows = [
        (_names(one), _last(gone.values()), why) for one, (gone, why) in zip(words["retired"], old, strict=True)
    ]
    parts += ["## Retired", _table(head, rows)]
    return "\n\n".join(parts) + "\n"


def living(records: Mapping[str, Record], words: Mapping[str, Any]) -> dict[str, Record]:
    """The records without those of retired figures."""
    gone = {name for one in words["retired"] for name in _retired(one, records)}
    return {name: record for name, record in records.items() if name not in gone}


def _retired(entry: Mapping[str, Any], records: Mapping[str, Record]) -> dict[str, Record]:
    """The records of an entry: those whose names fit its patterns, and all that its parts printed."""
    found: dict[str, Record] = {}
    for part in entry.get("parts", []):
        found |= {n: one for n, one in records.items() if one.command == f"python -m benchmarks {part}"}
    for pattern in entry.get("names", []):
        fitting = {n: one for n, one in records.items() if fnmatchcase(n, pattern)}
        if not fitting:
            raise ValueError(f"docs/figures.toml, retired: no such figure: {pattern}")
        found |= fitting
    return found


def _names(entry: Mapping[str, Any]) -> str:
    parts = [f"all of `{part}`" for part in entry.get("parts", [])]
    return ", ".join([*parts, *(f"`{name}`" for name in entry.get("names", []))])


def _last(records: Collection[Record]) -> str:
    """How retired figures stood when they were printed last: "2 of 3 met, 2026-11-21"."""
    if not records:
        return "never logged"
    met = sum(one.verdict == "met" for one in records)
    missed = ", ".join(f"`{one.name}` {_value(one)}" for one in records if one.verdict == "missed")
    told = f"; **missed**: {missed}" if missed else ""
    return f"{met} of {len(records)} met, {max(one.date for one in records)}{told}"


def figures_of_subjects(records: Mapping[str, Record], subjects: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """{title: figures}, those that were never logged among them; the longest of all `runs` that fits decides."""
    runs = {run: subject["title"] for subject in subjects for run in subject["runs"]}
    found = {subject["title"]: [n for n in subject.get("waiting", []) if n not in records] for subject in subjects}
    for record in records.values():
        words = record.command.removeprefix("python -m benchmarks ") + " "
        fitting = [run for run in runs if words.startswith(run + " ")]
        if not fitting:
            raise ValueError(f"docs/figures.toml: no subject has the runs of `{record.command}`")
        found[runs[max(fitting, key=len)]].append(record.name)
    for subject in subjects:
        if unknown := subject.get("means", {}).keys() - {*found[subject["title"]]}:
            raise ValueError(f"docs/figures.toml, {subject['title']}: no such figure: {', '.join(sorted(unknown))}")
    return found


def rows_of(names: Iterable[str]) -> list[list[str]]:
    """Names in order, those that begin alike together, at most `_TOGETHER` in a row."""
    numbers = {name: [int(one) if one.isdigit() else one for one in re.split(r"(\d+)", name)] for name in names}
    by_number = sorted(numbers, key=numbers.__getitem__)
    return [row for _, group in groupby(by_number, _beginning(1)) for row in _parted([*group], 2)]


def _beginning(words: int) -> Callable[[str], tuple[str, ...]]:
    return lambda name: tuple(re.findall(r"[^_ ]+", name)[:words])


def _parted(names: list[str], words: int) -> list[list[str]]:
    """Parts of sorted names, by so many of their first words, and by more where they are still too many."""
    if len(names) <= _TOGETHER:
        return [names]
    out: list[list[str]] = []
    for _, group in groupby(names, _beginning(words)):
        part = [*group]
        if out and len(out[-1]) + len(part) <= _TOGETHER:
            out[-1] += part
        else:
            out += _parted(part, words + 1)
    return out


def _cells(names: list[str], records: Mapping[str, Record], newest: date) -> tuple[str, ...]:
    *columns, runs = zip(*(_line(name, records.get(name), newest) for name in names), strict=True)
    run = runs[0] if len({*runs}) == 1 else "<br>".join(one.translate(_NO_BREAK) for one in runs)
    return *map("<br>".join, columns), run


def _line(name: str, record: Record | None, newest: date) -> tuple[str, ...]:
    """What stands in the columns of one figure, none of which is wrapped but a run that stands once."""
    shown = f"`{name}`".replace(" ", " ".translate(_NO_BREAK))
    if record is None:
        return shown, "–", "–", "–", "never logged"
    verdict = f"**{record.verdict}**" if record.verdict == "missed" else record.verdict
    state = _BEFORE_MARK if record.reason == BEFORE else ""
    state += ", more than four weeks old" if newest - date.fromisoformat(record.date) > OLD else ""
    cells = (cell.translate(_NO_BREAK) for cell in (_value(record), _goal(record.goal), verdict))
    return shown, *cells, f"{record.date} {record.commit}{state}"


def _value(record: Record) -> str:
    if not record.value:
        return "–"
    unit = record.unit
    if len(unit) > _LONG_UNIT:
        unit = shorten(unit.partition(",")[0], _LONG_UNIT, placeholder=" …")
    unit = re.sub(r"^(x|deg)(?!\w)", lambda found: _UNITS[found[1]], unit)
    return f"{number(record.value)}{'' if unit.startswith('°') else ' '}{unit}".strip()


def _goal(goal: str) -> str:
    relation, bound = goal.split()
    return _SIGNS[relation] + number(bound)


def number(printed: str) -> str:
    """As the page writes it: 12,340 for 1.234e+04, 8e-7 for 8e-07."""
    if abs(float(printed)) >= 1000 and "." not in f"{float(printed):.6g}":
        return f"{float(printed):,.0f}"
    return printed.replace("e-0", "e-")


def _glance(records: Mapping[str, Record], lines: Iterable[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """What to expect: sentences whose numbers are the log's, with the goals that are missed."""
    table, last = [], ""
    for line in lines:
        named = re.findall(r"\{([^{}]+)\}", line["says"])
        if absent := [name for name in named if name not in records or not records[name].value]:
            raise ValueError(f"docs/figures.toml, glance: not measured: {', '.join(absent)}")
        says = re.sub(r"\{([^{}]+)\}", lambda found: number(_short(records[found[1]].value)), line["says"])
        missed = [records[name] for name in named if records[name].verdict == "missed"]
        faults = ", ".join(f"{_short(one.value)} ({_goal(one.goal)})".translate(_NO_BREAK) for one in missed)
        verdict = f"**missed**: {faults}" if missed else "met"
        table.append(("" if line["what"] == last else f"**{line['what']}**", says, verdict))
        last = line["what"]
    return table


def _short(printed: str) -> str:
    return printed if float(printed).is_integer() else f"{float(printed):.3g}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def written() -> str:
    """The page as log and words have it now."""
    return page(read(LOG), worded())


def worded() -> dict[str, Any]:
    """What docs/figures.toml says."""
    return tomllib.loads(WORDS.read_text("utf-8"))


if __name__ == "__main__":
    PAGE.write_text(written(), "utf-8")
    fill()
