"""The tables and the page over takes, subjects and sessions."""

import csv

import msgspec
import pytest
from msgspec.structs import replace

from kinefit.errors import ExportError
from kinefit.findings import Finding
from kinefit.takes.batch.summary import FAILED, Range, Row, write_summary


def knee(left, right):
    """A knee that is bent so far [deg] on both sides, the right one not seen all the time."""
    other = Range("knee_angle", "right", 5.0, right + 5, right, 1.0, 0.9)
    return Range("knee_angle", "left", 0.0, left, left, 2.0, 1.0), other


ROWS = (
    Row(take="a/take.toml", subject="s<1>", visit="pre", folder="a/take-kinefit", frames=60, seconds=2.0, quality=0.9,
        lost=0.01, ranges=knee(60.0, 50.0), notes=("camera 1 is off",)),
    Row(take="b/take.toml", subject="s<1>", visit="pre", folder="b/take-kinefit", frames=30, seconds=1.0, quality=0.5,
        lost=0.2, ranges=(*knee(64.0, 40.0), Range("lumbar_extension", "", -5.0, 5.0, 10.0, 3.0, 1.0))),
    Row(take="c/take.toml", status=FAILED, error="it is, alas, broken"),
    Row(take="d/take.toml", person=2, subject="s2", folder="d/take-kinefit/person-2", frames=9, seconds=0.3,
        quality=0.7, lost=0.0,
        ranges=(Range("knee_angle", "left"), Range("knee_angle", "right", 1.0, 2.0, 1.0, 0.5, 1.0))),
)  # fmt: skip


def test_the_tables_hold_a_row_for_each_take_and_person(tmp_path):
    write_summary(ROWS, tmp_path)
    table = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()))
    assert [row["status"] for row in table] == ["done", "done", "failed", "done"]
    assert table[2]["error"] == "it is, alas, broken" and table[2]["quality"] == table[2]["frames"] == ""
    assert table[1] == {
        "take": "b/take.toml", "person": "", "subject": "s<1>", "visit": "pre", "date": "", "movement": "",
        "frames": "30", "seconds": "1", "quality": "0.5", "lost share": "0.2", "faults": "", "status": "done",
        "error": "", "folder": "b/take-kinefit",
    }  # fmt: skip
    ranges = list(csv.DictReader((tmp_path / "ranges.csv").read_text().splitlines()))
    assert len(ranges) == 7 and ranges[5]["range [deg]"] == "" and ranges[5]["person"] == "2"
    assert float(ranges[3]["range [deg]"]) == 40.0 and ranges[3]["side"] == "right"


def test_the_page_links_reports_and_tells_means_over_takes(tmp_path):
    (tmp_path / "a" / "take-kinefit").mkdir(parents=True)
    (tmp_path / "a" / "take-kinefit" / "report.html").write_text("x")
    write_summary(ROWS, tmp_path)
    text = (tmp_path / "summary.html").read_text("utf-8")
    assert 'href="a/take-kinefit/report.html"' in text and 'href="b/' not in text
    assert "s&lt;1&gt;" in text and "s<1>" not in text
    assert "<td>60 ± 2</td><td>50 ± 1*</td><td>10 ± 2</td>" in text  # of one take: left, right, left less right
    assert "<td>2</td><td>62 ± 3</td><td>45 ± 7</td><td>17 ± 10</td>" in text  # of both takes of a session
    assert "unobserved" in text and "camera 1 is off" in text and "3 of 4 takes are done. 2 subjects" in text
    assert "Knee flexion" in text and "Lumbar extension" in text


def test_faults_of_the_inputs_are_the_first_thing_on_the_page(tmp_path):
    fault = Finding("fault", "time", "cam02 runs 5 frames late.", ("cam02",), "Sure.", "Write time_offset = 0.1.")
    write_summary([replace(ROWS[3], findings=(fault,)), ROWS[0]], tmp_path)
    text = (tmp_path / "summary.html").read_text("utf-8")
    place = [text.index(part) for part in ("d/take.toml, person 2: Fault. ", "cam02 runs 5 frames late.", "takes are")]
    assert place == sorted(place)
    assert "What to do: </strong>Write time_offset = 0.1." in text
    table = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()))
    assert [row["faults"] for row in table] == ["cam02 runs 5 frames late.", ""]
    told = msgspec.json.decode(msgspec.json.encode(replace(ROWS[3], findings=(fault,))), type=Row)
    assert told.findings == (fault,)  # as a worker sends it, and an unfinished study keeps it


def test_a_study_of_failures_alone_has_a_page(tmp_path):
    write_summary(ROWS[2:3], tmp_path)
    assert "alas, broken" in (tmp_path / "summary.html").read_text("utf-8")
    with pytest.raises(ExportError):
        write_summary((), tmp_path)
