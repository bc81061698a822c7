"""Normative values are read whole or refused with their line, and drawn behind the cycles."""

import pytest
from tests.exporters.report.test_cycles import walk
from tests.exporters.report.test_page import plots

from kinefit.errors import ExportError, FileError
from kinefit.exporters.report.cycles import read_norms
from kinefit.exporters.report.report import write_report

HEAD = "coordinate,percent,mean,sd\n"


def table(tmp_path, text):
    (tmp_path / "norms.csv").write_text(text)
    return tmp_path / "norms.csv"


def test_values_are_sorted_by_percent(tmp_path):
    found = read_norms(table(tmp_path, HEAD + "knee_angle,100,5,2\nknee_angle,0,4,1\nhip_flexion_l,50,20,3\n"))
    assert found["knee_angle"].tolist() == [[0, 4, 1], [100, 5, 2]] and found["hip_flexion_l"].shape == (1, 3)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no column coordinate"), (HEAD, "no line of values"), ("coordinate,percent,mean\na,1,2\n", "column sd"),
        (HEAD + "knee_angle,0,1,2\nknee_angle,101,1,2\n", "line 3"), (HEAD + "knee_angle,0,nan,2\n", "line 2"),
        (HEAD + "knee_angle,0,1,-2\n", "line 2"), (HEAD + "knee_angle,0,one,2\n", "line 2"),
        (HEAD + "knee_angle,0\n", "line 2"),
    ],
)  # fmt: skip
def test_what_is_no_table_of_norms_is_told(tmp_path, text, told):
    with pytest.raises(FileError) as error:
        read_norms(table(tmp_path, text))
    assert told in str(error.value) and "norms.csv" in str(error.value)


def test_a_missing_table_and_an_unknown_coordinate(tmp_path):
    with pytest.raises(FileError, match="No such file"):
        read_norms(tmp_path / "none.csv")
    norms = read_norms(table(tmp_path, HEAD + "knie,0,1,2\n"))
    with pytest.raises(ExportError, match="knie"):
        write_report(walk(), tmp_path / "r.html", norms=norms)
    assert not (tmp_path / "r.html").exists()


def test_bands_lie_behind_the_cycles_of_both_sides(tmp_path):
    norms = read_norms(table(tmp_path, HEAD + "knee_angle,0,4,1\nknee_angle,100,5,2\n"))
    bands = []
    for given in (None, norms):
        path = write_report(walk(), tmp_path / "r.html", norms=given, date="x")
        drawn = [t for plot in plots(path.read_text()) for t in plot.get("data", [])]
        bands.append([t for t in drawn if t.get("legendgroup") == "norm"])
    assert not bands[0] and len(bands[1]) == 1
    assert max(bands[1][0]["y"]) == 7 and min(bands[1][0]["y"]) == 3
