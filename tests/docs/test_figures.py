"""The page of figures is what the log makes it; the log says what a run printed."""

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
from benchmarks.ledger import BEFORE, LOG, Record, read
from benchmarks.page import PAGE, living, page, rows_of, worded, written

ROOT = Path(__file__).resolve().parents[2]
RUN = "python -m benchmarks solver solver"
WORDS = {
    "head": "# Figures",
    "glance": [{"what": "Solver", "says": "{speed} ms and {old}°"}],
    "subject": [
        {"title": "Solver", "runs": ["solver"], "text": "Simulated,\nall.", "waiting": ["new"],
         "means": {"speed": "of legs"}},
        {"title": "Legs", "runs": ["solver legs"], "text": "Real.", "images": ["![Legs](images/legs.png)"]},
    ],
    "retired": [{"names": ["gone_*"], "reason": "its goal is met by another"}],
}  # fmt: skip


def record_of(name, value, unit="ms", goal="<= 5", verdict="met", **more):
    told = {"command": RUN, "reason": "", "date": "2026-11-24", "commit": "abc1234", "machine": "a machine"} | more
    return Record(name=name, value=value, unit=unit, goal=goal, verdict=verdict, **told)


@pytest.fixture
def records():
    old = record_of("old", "2.70", "deg, mean", "<= 2", "missed", reason=BEFORE, date="2026-10-20", commit="0c1f146")
    legs = record_of("legs", "1.979e+04", "x faster", ">= 1e+04", command="python -m benchmarks solver legs")
    gone = record_of("gone_1", "3", verdict="missed", goal="<= 2")
    return {"speed": record_of("speed", "4.5"), "old": old, "legs": legs, "gone_1": gone}


@pytest.fixture
def log(tmp_path, monkeypatch):
    """A log of its own; figures are printed by a whole run of a part."""
    monkeypatch.setattr(ledger, "LOG", tmp_path / "figures.csv")
    monkeypatch.setattr(ledger, "commit", lambda: "abc1234")
    monkeypatch.setenv(figures.COMMAND, RUN)
    monkeypatch.delenv(figures.QUICK, raising=False)
    return tmp_path / "figures.csv"


def test_the_page_is_what_the_log_makes_it():
    shown, wanted = PAGE.read_text("utf-8").split("\n"), written().split("\n")
    wrong = [f"{a}\n  the log has: {b}" for a, b in zip(shown, wanted, strict=False) if a != b]
    assert not wrong and len(shown) == len(wanted), "\n".join(["run python -m benchmarks.page", *wrong])
    assert len(shown) <= 600


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
    assert not [name for name in living(read(LOG), worded()) if not printed.fullmatch(name)]


def lines_of(title, text):
    plain = text.replace("\N{NO-BREAK SPACE}", " ").replace("\N{NON-BREAKING HYPHEN}", "-")
    below = plain.partition(f"\n## {title}\n")[2]
    return below.partition("\n## ")[0].strip().split("\n")


def test_every_figure_has_a_line_of_its_own_in_the_table_of_its_subject(records):
    solver = lines_of("Solver", page(records, WORDS))
    assert solver[0] == "Simulated, all."
    assert solver[4:7] == [
        "| `new` | – | – | – | never logged |",
        "| `old` | 2.70°, mean | ≤ 2 | **missed** | 2026-10-20 0c1f146†, more than four weeks old |",
        "| `speed` | 4.5 ms | ≤ 5 | met | 2026-11-24 abc1234 |",
    ]
    assert solver[8] == "`speed`: of legs"
    legs = lines_of("Legs", page(records, WORDS))
    assert legs[2] == "![Legs](images/legs.png)"
    assert legs[-1] == "| `legs` | 19,790 × faster | ≥ 10,000 | met | 2026-11-24 abc1234 |"


def test_the_page_begins_with_sentences_of_the_log_and_ends_with_what_is_retired(records):
    text = page(records, WORDS)
    assert "| **Solver** | 4.5 ms and 2.7° | **missed**: 2.7\N{NO-BREAK SPACE}(≤\N{NO-BREAK SPACE}2) |" in text
    assert text.count("gone_1") == 1
    assert text.replace("\N{NO-BREAK SPACE}", " ").endswith(
        "| `gone_*` | 0 of 1 met, 2026-11-24; **missed**: `gone_1` 3 ms | its goal is met by another |\n"
    )


def test_figures_that_begin_alike_share_a_row_of_the_table(records):
    records |= {f"speed_{k}": record_of(f"speed_{k}", "1", "mm", "== 1") for k in range(3)}
    (row,) = [line for line in lines_of("Solver", page(records, WORDS)) if line.startswith("| `speed")]
    assert row.startswith("| `speed`<br>`speed_0`<br>`speed_1`<br>`speed_2` |")
    assert row.count("<br>") == 4 * 3 and row.endswith("| 2026-11-24 abc1234 |")
    assert "| 4.5 ms<br>1 mm<br>1 mm<br>1 mm |" in row


@pytest.mark.parametrize("count", [1, 9, 10, 40])
def test_no_figure_is_lost_among_many(count):
    names = sorted(f"{first}_{k % 3}_{k}" for first in ("a", "b", "a b") for k in range(count))
    rows = rows_of(reversed(names))
    assert sorted(name for row in rows for name in row) == names and max(map(len, rows)) <= 9


def test_numbers_in_names_are_sorted_as_numbers():
    assert rows_of(f"row_{k}" for k in range(11))[0][:3] == ["row_0", "row_1", "row_2"]


def test_a_figure_that_was_not_measured_has_no_value(records):
    records["old"] = record_of("old", "", "deg", "<= 2", "not measured", reason="no recording")
    words = WORDS | {"glance": []}
    assert "| `old` | – | ≤ 2 | not measured | 2026-11-24 abc1234 |" in lines_of("Solver", page(records, words))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [({"glance": [{"what": "Solver", "says": "{new} ms"}]}, "glance: not measured: new"),
     ({"subject": WORDS["subject"][1:]}, "no subject has the runs of"),
     ({"subject": [WORDS["subject"][0] | {"means": {"gone_1": "?"}}, WORDS["subject"][1]]}, "no such figure: gone_1"),
     ({"retired": [{"names": ["lost_*"], "reason": "?"}]}, "retired: no such figure: lost_")],
)  # fmt: skip
def test_words_of_what_is_not_in_the_log_are_refused(records, wrong, named):
    with pytest.raises(ValueError, match=named):
        page(records, WORDS | wrong)


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
    figures.run_parts("gait", ["gait_events", *options])
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
