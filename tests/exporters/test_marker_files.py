"""Markers into files and back."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from kinefit.errors import ExportError, FileError
from kinefit.exporters import write_markers
from kinefit.observations import MarkerEvent, Markers
from kinefit.readers.c3d_file import read_c3d
from kinefit.readers.markers import read_markers

EVENTS = (MarkerEvent("Foot Strike", 0.25, "Left", "Anna"), MarkerEvent("Foot Off", 61.5, "Right"))


def some_markers(frames=12, seed=0, **changes):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(frames, 4, 3))
    x[2:5, 1] = np.nan
    residual = np.where(np.isnan(x[..., 0]), np.nan, rng.integers(0, 200, (frames, 4)) * 5e-5)
    given = {
        "residual": residual, "up": "z", "first_frame": 40, "unit": "mm", "events": EVENTS, "source": "a.c3d", **changes
    }  # fmt: skip
    return Markers(("Anna:LASI", "Ünter Arm", "*3", "RTOE"), 119.88, x, **given)


@pytest.mark.parametrize("unit", ["mm", "m", "in"])
def test_c3d_round_trip(tmp_path, unit):
    markers = some_markers()
    write_markers(markers, tmp_path / "a.c3d", unit=unit)
    read = read_markers(tmp_path / "a.c3d")
    assert (read.names, read.up, read.first_frame, read.unit) == (markers.names, "z", 40, unit)
    assert read.rate == pytest.approx(markers.rate, rel=1e-6)
    np.testing.assert_allclose(read.positions, markers.positions, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(read.residual, markers.residual, atol=1e-7)
    assert [(e.label, e.context, e.subject) for e in read.events] == [(e.label, e.context, e.subject) for e in EVENTS]
    assert [e.time for e in read.events] == pytest.approx([e.time for e in EVENTS])


@given(st.lists(st.floats(0, 1e-2), min_size=8, max_size=8))
@example([0.0] * 7 + [1e-12])
def test_residuals_keep_a_255th(tmp_path_factory, residuals):
    path = tmp_path_factory.getbasetemp() / "r.c3d"
    given = np.array(residuals).reshape(2, 4)
    write_markers(Markers(tuple("abcd"), 100.0, np.ones((2, 4, 3)), residual=given, unit="mm"), path)
    assert np.abs(read_markers(path).residual - given).max() <= given.max() / 255 * 0.51 + 1e-9


@pytest.mark.parametrize("unit", ["mm", "m", None])
def test_trc_round_trip(tmp_path, unit):
    markers = some_markers()
    write_markers(markers, tmp_path / "a.trc", unit=unit)
    read = read_markers(tmp_path / "a.trc")
    assert (read.names, read.first_frame, read.unit) == (markers.names, 40, unit or "mm")
    np.testing.assert_allclose(read.positions, markers.positions, rtol=1e-6)


CLOCKS = [({"first_frame": 40}, 40), ({"first_frame": 1, "first_time": 12.5}, 1251)]


@pytest.mark.parametrize(("given", "first"), CLOCKS)
def test_the_clock_goes_into_every_file_and_back(tmp_path, given, first):
    """C3D counts frames from 0 s; other programs read the same."""
    ezc3d = pytest.importorskip("ezc3d")
    x = np.random.default_rng(0).normal(size=(9, 2, 3))
    markers = Markers(("A", "B"), 100.0, x, **given)
    assert markers.times[0] == pytest.approx((first - 1) / 100)
    for name in ("a.trc", "a.c3d"):
        write_markers(markers, tmp_path / name)
        np.testing.assert_allclose(read_markers(tmp_path / name).times, markers.times, atol=1e-9)
    assert read_markers(tmp_path / "a.trc").first_frame == given["first_frame"]
    assert ezc3d.c3d(str(tmp_path / "a.c3d"))["header"]["points"]["first_frame"] == first - 1  # which counts from 0
    row = (tmp_path / "a.trc").read_text().splitlines()[6].split("\t")
    assert (float(row[0]), float(row[1])) == (given["first_frame"], (first - 1) / 100)


def test_a_row_never_ends_in_an_empty_cell(tmp_path):
    """OpenSim refuses one."""
    x = np.ones((4, 3, 3))
    x[0, 2] = x[1, :] = x[2, 1] = np.nan
    write_markers(Markers(("A", "B", "C"), 100.0, x), tmp_path / "a.trc", unit="m")
    rows = [line.split("\t") for line in (tmp_path / "a.trc").read_text().splitlines()[6:]]
    assert [(len(row), row[-1]) for row in rows] == [(11, "NaN"), (11, "NaN"), (11, "1"), (11, "1")]
    np.testing.assert_array_equal(read_markers(tmp_path / "a.trc").positions, x)


def test_a_copy_keeps_force_plates(data_dir, tmp_path):
    source = data_dir("markers_pycgm") / "Test_Files" / "Movement_trial.c3d"
    markers = read_markers(source)
    write_markers(markers, tmp_path / "a.c3d", like=source)
    before, after = read_c3d(source), read_c3d(tmp_path / "a.c3d")
    np.testing.assert_array_equal(after.analog, before.analog.astype(np.float32))
    assert after.samples == before.samples == 9
    assert after.parameters["ANALOG:LABELS"] == before.parameters["ANALOG:LABELS"]
    corners = [c3d.parameters["FORCE_PLATFORM:CORNERS"] for c3d in (before, after)]
    np.testing.assert_array_equal(*corners)
    part = Markers(markers.names, markers.rate, markers.positions[50:80], first_frame=markers.first_frame + 50)
    write_markers(part, tmp_path / "b.c3d", like=source)
    np.testing.assert_array_equal(read_c3d(tmp_path / "b.c3d").analog, after.analog[50:80])
    early = Markers(markers.names, 120.0, markers.positions[:30], first_frame=1)
    with pytest.raises(ExportError, match="frames 1 to 30 are not all in"):
        write_markers(early, tmp_path / "c.c3d", like=source)


def test_another_program_reads_the_same(data_dir, tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    (source,) = data_dir("markers").rglob("*JA1Gait35.c3d")
    markers = read_markers(source)
    assert len(markers.events) == 10 and markers.events[-1].context in ("Left", "Right")
    write_markers(markers, tmp_path / "a.c3d", like=source)
    before, after = ezc3d.c3d(str(source)), ezc3d.c3d(str(tmp_path / "a.c3d"))
    np.testing.assert_allclose(after["data"]["analogs"], before["data"]["analogs"])
    points = [f["data"]["points"][:3, : len(markers.names)] for f in (before, after)]
    np.testing.assert_array_equal(points[1], np.where(points[0].any(axis=0), points[0], np.nan))
    times = [f["parameters"]["EVENT"]["TIMES"]["value"] for f in (before, after)]
    np.testing.assert_allclose(np.sort(times[1][1]), np.sort(times[0][1]))


def test_header_events_are_read(data_dir):
    (path,) = data_dir("markers").rglob("*Eb015pr.c3d")
    events = read_markers(path).events
    assert len(events) == 3 and events[0].label
    assert all(0 < e.time < 10 for e in events)


def test_what_cannot_be_written_is_refused(tmp_path):
    markers = some_markers()
    with pytest.raises(ExportError, match=r"neither \.c3d nor \.trc"):
        write_markers(markers, tmp_path / "a.csv")
    with pytest.raises(ExportError, match="0 frames of 4 markers"):
        write_markers(some_markers(0), tmp_path / "a.c3d")
    with pytest.raises(ExportError, match="no unit of length 'furlong'"):
        write_markers(markers, tmp_path / "a.c3d", unit="furlong")
    with pytest.raises(FileError, match="no such file"):
        write_markers(markers, tmp_path / "a.c3d", like=tmp_path / "none.c3d")
    with pytest.raises(ExportError, match=r"no frames before 0 s, the markers begin at -0\.5 s"):
        write_markers(some_markers(first_time=-0.5), tmp_path / "a.c3d")
    assert not list(tmp_path.iterdir())
