"""Every row of a table of figures shows what the log says; the log says what a run printed."""

import ast
import re
import subprocess
import sys
from datetime import date
from pathlib import Path
from types import SimpleNamespace

import pytest
from benchmarks import figures, ledger
from benchmarks.figures import figure, holds
from benchmarks.ledger import BEFORE, LOG, PAGE, Record, filled, read

ROOT = Path(__file__).resolve().parents[2]
RUN = "python -m benchmarks solver solver"
TABLE = """| figure | value | before | goal | | run |
| --- | --- | --- | --- | --- | --- |
| `speed`, of legs | 4.5 ms | 9 | ≤ 5 | met, narrowly | 2026-11-24 abc1234 |
| `old` | 2.70° | | ≤ 2 | **missed** by 0.7 | not rerun, 2026-11-21 0c1f146 |
| `new` | – | | ≤ 3 | | not rerun |
"""


def record_of(name, value, unit="ms", goal="<= 5", verdict="met", **more):
    told = {"command": RUN, "reason": "", "date": "2026-11-24", "commit": "abc1234", "machine": "a machine"} | more
    return Record(name=name, value=value, unit=unit, goal=goal, verdict=verdict, **told)


@pytest.fixture
def records():
    old = record_of("old", "2.70", "°", "<= 2", "missed", reason=BEFORE, date="2026-11-21", commit="0c1f146")
    return {"speed": record_of("speed", "4.5"), "old": old}


@pytest.fixture
def log(tmp_path, monkeypatch):
    """A log of its own; figures are printed by a whole run of a part."""
    monkeypatch.setattr(ledger, "LOG", tmp_path / "figures.csv")
    monkeypatch.setattr(ledger, "commit", lambda: "abc1234")
    monkeypatch.setenv(figures.COMMAND, RUN)
    monkeypatch.delenv(figures.QUICK, raising=False)
    return tmp_path / "figures.csv"


def test_the_page_shows_what_the_log_says():
    shown, wanted = PAGE.read_text("utf-8").split("\n"), filled(PAGE.read_text("utf-8"), read(LOG)).split("\n")
    wrong = [f"{a}\n  the log has: {b}" for a, b in zip(shown, wanted, strict=True) if a != b]
    assert not wrong, "values are printed, not written: python -m benchmarks.ledger\n" + "\n".join(wrong)


def test_every_verdict_follows_from_value_and_goal():
    records = read(LOG).values()
    assert len(records) > 600
    verdicts = [("met" if holds(float(r.value), r.goal) else "missed") if r.value else "not measured" for r in records]
    assert [r.name for r, verdict in zip(records, verdicts, strict=True) if r.verdict != verdict] == []
    run = re.compile(r"20\d\d-\d\d-\d\d [0-9a-f]{7,}(\+changes)?")
    assert [r.name for r in records if not run.fullmatch(f"{r.date} {r.commit}")] == []


def test_the_log_is_sorted_so_that_changes_are_read_as_lines(tmp_path):
    ledger.write(read(LOG), tmp_path / "log.csv")
    assert (tmp_path / "log.csv").read_text("utf-8") == LOG.read_text("utf-8")


def test_names_on_the_page_are_printed_by_a_benchmark():
    patterns = set()
    for path in (ROOT / "benchmarks").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [re.escape(v.value) if isinstance(v, ast.Constant) else ".+" for v in node.values]
                patterns |= {"".join(parts)} if len("".join(parts).replace(".+", "")) >= 5 else set()
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                patterns.add(re.escape(node.value))
    printed = re.compile("|".join(f"(?:{pattern})" for pattern in patterns))
    assert not [name for name in read(LOG) if not printed.fullmatch(name)]


def test_a_filled_page_stays_as_it_is(records):
    assert filled(TABLE, records) == TABLE


@pytest.mark.parametrize(
    ("by_hand", "was"),
    [("4.4 ms", "4.5 ms"), ("≤ 6", "≤ 5"), ("missed, narrowly", "met, narrowly"), ("2026-11-25", "2026-11-24"),
     ("abc1235", "abc1234"), ("1.90°", "2.70°"), ("met", "**missed** by 0.7"),
     ("2026-11-22 0c1f146", "2026-11-21 0c1f146"),
     ("| 2026-11-21 0c1f146", "| not rerun, 2026-11-21 0c1f146"), ("2.9 mm | | ≤ 3 | met |", "– | | ≤ 3 | |"),
     ("4.5 s |", "4.5 ms |")],
)  # fmt: skip
def test_what_is_written_by_hand_is_found(records, by_hand, was):
    assert was in TABLE
    edited = TABLE.replace(was, by_hand)
    assert filled(edited, records) != edited


def test_prose_of_a_row_is_not_touched(records):
    page = TABLE.replace("of legs", "of all legs").replace("| 9 |", "| 9.1 |") + "4.4 ms in prose, | `old` | 3 |"
    assert filled(page, records) == page


def test_a_run_fills_its_row(records):
    records["old"] = record_of("old", "12345.6", "x faster, on one core", ">= 1e+04", commit="def5678+changes")
    line = filled(TABLE, records).split("\n")[3]
    assert line == "| `old` | 12345.6 × faster, on one core | | ≥ 10,000 | met | 2026-11-24 def5678+changes |"
    records["old"] = record_of("old", "1.979e+04", "deg, mean", "== 2", "missed")
    assert "| 19,790°, mean | | 2 | **missed** |" in filled(TABLE, records)
    records["old"] = record_of("old", "", "deg", "<= 2", "not measured", reason="no recording")
    assert "| – | | ≤ 2 | not measured: no recording | 2026-11-24 abc1234 |" in filled(TABLE, records)


@pytest.mark.parametrize("row", ["| speed | 1 | | ≤ 2 | met | x |", "| `speed` | 4.5 ms | | ≤ 5 | met | x |"])
def test_a_row_without_a_name_of_its_own_is_refused(records, row):
    with pytest.raises(ValueError, match=r"figures\.md:6"):
        filled(TABLE.rstrip("\n") + "\n" + row, records)


def test_a_whole_run_is_logged_and_replaces_the_last(log, capsys):
    figure("b", 1.23456, "ms", "<= 2")
    figure("a", 3.0, "ms", "<= 2")
    figure("b", 2.5, "ms", "<= 2")
    found = read(log)
    assert list(found) == ["a", "b"]
    told = RUN, "b", "2.5", "ms", "<= 2", "missed", "", date.today().isoformat(), "abc1234"
    assert found["b"][:-1] == told
    assert "Python" in found["b"].machine and "numba" in found["b"].machine
    assert capsys.readouterr().out.split("\n")[0] == "figure b = 1.235 ms (goal <= 2): met"


def test_what_is_no_whole_run_is_not_logged(log, monkeypatch):
    figure("a", 1.0, "ms", "<= 2", whole=False)
    monkeypatch.setenv(figures.QUICK, "1")
    figure("a", 1.0, "ms", "<= 2")
    monkeypatch.delenv(figures.QUICK)
    figures.find_benchmarks()
    figure("a", 1.0, "ms", "<= 2")
    assert not log.exists()


@pytest.mark.parametrize("options", [[], ["--no-log"]])
def test_a_part_is_logged_with_its_command(log, monkeypatch, options):
    part = SimpleNamespace(run=lambda: figure("a", 1.0, "ms", "<= 2"))
    monkeypatch.setattr(figures, "module_of", {"gait_events": part}.get)
    monkeypatch.setenv("PYTHONPATH", "")
    figures.run_parts("gait", options)
    assert {r.command for r in read(log).values()} == set() if options else {"python -m benchmarks gait gait_events"}


def test_what_was_not_measured_replaces_no_value(log, capsys):
    figure("a", None, "ms", "<= 2", "no recording")
    assert read(log)["a"].verdict == "not measured"
    figure("a", 1.0, "ms", "<= 2")
    figure("a", float("nan"), "ms", "<= 2")
    assert read(log)["a"].value == "1"
    assert capsys.readouterr().out.endswith("figure a = - ms (goal <= 2): not measured (no value)\n")


def test_printed_values_show_their_verdict(log, capsys):
    figure("a", 99.9999, "%", "== 100")
    figure("b", 2.00004, "ms", "<= 2")
    assert capsys.readouterr().out.splitlines() == [
        "figure a = 99.9999 % (goal == 100): missed", "figure b = 2.00004 ms (goal <= 2): missed",
    ]  # fmt: skip


@pytest.mark.parametrize(("value", "text"), [(61430, "61430"), (12.0, "12"), (61430.5, "6.143e+04"), (-0.0, "0")])
def test_whole_numbers_are_printed_with_all_their_digits(log, capsys, value, text):
    figure("a", value, "", "<= 2")
    assert capsys.readouterr().out.startswith(f"figure a = {text} ")


def test_processes_side_by_side_lose_nothing(tmp_path):
    log, code = tmp_path / "figures.csv", (
        "import sys; from pathlib import Path; from benchmarks import ledger\n"
        "ledger.commit, ledger.LOG = lambda: 'abc1234', Path(sys.argv[1])\n"
        "for k in range(40):\n"
        "    ledger.record(f'{sys.argv[2]}{k}', '1', '', '<= 2', 'met', '', command='x')"
    )  # fmt: skip
    started = [subprocess.Popen([sys.executable, "-c", code, log, name], cwd=ROOT) for name in "ab"]
    assert [process.wait(60) for process in started] == [0, 0]
    assert sorted(read(log)) == sorted(f"{name}{k}" for name in "ab" for k in range(40))
