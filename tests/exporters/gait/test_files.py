"""Tables, summary and page of a gait record."""

import csv
import json

import numpy as np
import pytest
from tests.exporters.report.test_cycles import STRIDE, walk

from kinefit.errors import ExportError
from kinefit.exporters.gait.files import stride_table, summary, write_gait, write_gait_page
from kinefit.exporters.gait.record import gait_record


@pytest.fixture(scope="module")
def record():
    return gait_record({"one": walk(), "two": walk(1.45)})


def test_tables_have_a_row_for_every_stride_and_step(record, tmp_path):
    written = write_gait(record, tmp_path / "out")
    with open(written["csv"], newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(record.stretches) and {row["trial"] for row in rows} == {"one", "two"}
    for row, one in zip(rows, record.stretches):
        assert (row["side"], row["kind"], row["walk"]) == (one.side, one.kind, one.walk)
        assert float(row["step time [s]"]) == pytest.approx(one.values["step time [s]"][0])
        assert float(row["step time std [s]"]) == pytest.approx(one.values["step time [s]"][1])
        assert bool(row["stance [% of cycle]"]) == ("stance [% of cycle]" in one.values)
    parquet = pytest.importorskip("pyarrow.parquet").read_table(written["parquet"])
    table = stride_table(record)
    assert parquet.column_names == list(table)
    for name, column in table.items():
        if column.dtype.kind == "f":
            np.testing.assert_array_equal(parquet[name].to_numpy(), column)
        else:
            assert parquet[name].to_pylist() == column.tolist()


def test_the_summary_has_both_sides_their_symmetry_and_the_person(record, tmp_path):
    found = json.loads(write_gait(record, tmp_path)["json"].read_text())
    assert found == summary(record)
    stride = found["straight"]["quantities"]["stride time [s]"]
    assert stride["left"]["mean"] == pytest.approx(STRIDE, rel=0.02) and stride["left"]["std"] > 0
    assert stride["both"]["n"] == stride["left"]["n"] + stride["right"]["n"]
    assert abs(stride["symmetry_percent"]["value"]) < 5.0
    assert "symmetry_percent" not in found["straight"]["quantities"]["foot progression [deg]"]
    assert found["turning"]["quantities"] == {} and found["trials"] == ["one", "two"]
    assert found["mass_kg"] == pytest.approx(75.0, rel=0.01) and found["mass_std_kg"] > 5.0


def test_the_page_has_both_sides_and_the_band_of_a_reference(record, tmp_path):
    percent = np.linspace(0.0, 100.0, 11)
    norms = {"knee_angle": np.stack([percent, np.full(11, 20.0), np.full(11, 5.0)], axis=1)}
    plain, banded = tmp_path / "plain.html", tmp_path / "banded.html"
    write_gait_page(record, plain, date="2026-11-30")
    write_gait_page(record, banded, norms=norms, date="2026-11-30")
    text, more = plain.read_text(), banded.read_text()
    for word in ("stride time [s]", "left − right", "Pelvis", "Knee", "one and two", "single steps", "2026-11-30"):
        assert word in text, word
    assert '"legendgroup":"norm"' in more and '"legendgroup":"norm"' not in text


def test_a_reference_of_an_unknown_angle_is_refused(record, tmp_path):
    norms = {"kne_angle": np.array([[0.0, 1.0, 1.0]])}
    with pytest.raises(ExportError, match="knee_angle"):
        write_gait_page(record, tmp_path / "gait.html", norms=norms)
    assert not (tmp_path / "gait.html").exists()


def test_a_record_of_single_steps_has_no_curves(tmp_path):
    write_gait_page(gait_record({"two": walk(1.45)}), tmp_path / "gait.html")
    assert "curves need two contacts of one foot" in (tmp_path / "gait.html").read_text()
