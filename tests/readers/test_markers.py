"""C3D and TRC: every real file, ezc3d as a second opinion, and damaged files that must not crash."""

import gzip
import re
import struct

import ezc3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.exporters.c3d_file import c3d_bytes
from kinefit.readers.c3d_file import _values, read_c3d
from kinefit.readers.markers import read_markers

TABLE = {  # folder/part of the name: markers, frames, rate, up, first frame
    "markers/Eb015pr.c3d": (26, 450, 50, "z", 1), "markers/Eb015si.c3d": (26, 450, 50, "z", 1),
    "markers/Eb015vi.c3d": (26, 450, 50, "z", 1), "markers/DEC_INT.C3D": (36, 89, 50, "z", 1),
    "markers/Dance.c3d": (40, 499, 65.0533, "z", 1), "markers/golfswing.c3d": (29, 514, 107.5269, "z", 1),
    "markers/01_01.c3d": (42, 2751, 120, "z", 40), "markers/sprintbasket.c3d": (26, 3678, 120, None, 0),
    "markers/walkingOptiTrack.c3d": (12, 3361, 160, "z", 0), "markers/85_12.c3d": (41, 4499, 120, None, 1),
    "markers/HDM_mm_01-02_03_120.c3d": (44, 3990, 120, None, 1), "markers/app__02_01.c3d": (41, 343, 120, "z", 50),
    "markers/JA1Gait35.c3d": (53, 324, 250, "z", 833), "markers/nick_freeform_001.c3d": (53, 1101, 120, None, 1),
    "markers/squat.c3d": (53, 2539, 120, None, 1), "markers/DJ1.trc": (51, 269, 100, None, 1),
    "markers/MarkerData__squats1.trc": (51, 1346, 100, None, 1), "markers/static1.trc": (55, 517, 100, None, 1),
    "markers/walking1.trc": (51, 131, 100, None, 1), "markers/DetectMarkerFlip__squats1.trc": (51, 1623, 100, None, 1),
    "markers/run200__markers.trc": (42, 237, 100, None, 1),
    "markers/WeirdFormatTests__markers.trc": (61, 281, 100, None, 1),
    "markers/motion_capture_walk.trc": (41, 238, 100, None, 1), "markers/static_walk_1.trc": (64, 287, 100, None, 1),
    "markers_bmc_run/Gait.c3d": (33, 487, 100, "z", 1),
    "markers_bmc_run/motion_capture_run.trc": (78, 123, 150, None, 1),
    "markers_bmc_run/static_run.trc": (78, 1500, 150, None, 1), "markers_bmc_run/walk1.trc": (28, 364, 150, None, 1),
    "markers_bmc_run/walk2.trc": (55, 251, 150, None, 1), "markers_pycgm/Sample_Static.c3d": (115, 275, 100, "z", 1),
    "markers_pycgm/Movement_trial.c3d": (159, 323, 120, "z", 695),
    "markers_pycgm/Static_trial.c3d": (153, 498, 120, "z", 1),
    "mv4_landmarks_caliscope/SIMPLE_HOLISTIC.trc": (81, 267, 30, None, 0),
    "video_balancing_4cam/openpose_refined.trc": (22, 99, 60, None, 0),
}
DAMAGED = {
    "badParameterOffset.c3d": (FileError, "ANALOG:UNITS"),
    "bad_parameter_section.c3d": (FileError, "after parameter 'LABELS'"),
    "parameterOverflow.c3d": (ObservationError, "none of the 106 markers is visible"),
}


def find(folder, ending):
    (path,) = [p for p in folder.rglob("*") if p.name.endswith(ending)]
    return path


@pytest.mark.parametrize("name", TABLE)
def test_real_files(data_dir, name):
    folder, ending = name.split("/")
    markers = read_markers(find(data_dir(folder), ending))
    found = (len(markers.names), len(markers), pytest.approx(markers.rate, abs=1e-3), markers.up, markers.first_frame)
    assert found == TABLE[name]
    assert len(set(markers.names)) == len(markers.names)
    assert not markers.notes
    extent = np.nanmax(markers.positions, axis=(0, 1)) - np.nanmin(markers.positions, axis=(0, 1))
    assert 0.5 < np.linalg.norm(extent) < 20  # [m] a person in a laboratory: the unit is right
    seen = np.isfinite(markers.positions)
    assert (seen.all(axis=-1) == seen.any(axis=-1)).all()


@pytest.mark.parametrize("name", DAMAGED)
def test_real_damaged_files(data_dir, name):
    error, told = DAMAGED[name]
    with pytest.raises(error, match=told) as caught:
        read_markers(find(data_dir("markers"), name))
    assert caught.value.file


def test_points_agree_with_ezc3d(data_dir):
    compared = 0
    for path in sorted(data_dir("markers").rglob("*.[cC]3[dD]")):
        if path.name.endswith(tuple(DAMAGED)):
            continue  # ezc3d takes half a minute over them
        try:
            other = ezc3d.c3d(str(path))["data"]
        except (RuntimeError, ValueError, OSError):
            continue  # those that only one of the two reads
        ours, points = read_c3d(path), other["points"][:3].transpose(2, 1, 0)
        missing = (other["meta_points"]["residuals"][0].T < 0) | np.isnan(points).any(axis=-1) | ~points.any(axis=-1)
        np.testing.assert_array_equal(ours.missing, missing)
        np.testing.assert_array_equal(ours.points[~missing], points[~missing])
        compared += 1
    assert compared >= 10


def test_three_processors_tell_the_same(data_dir):
    pc, vax, sgi = (read_markers(find(data_dir("markers"), f"Eb015{kind}.c3d")) for kind in ("pr", "vi", "si"))
    for other in (vax, sgi):
        assert other.names == pc.names
        np.testing.assert_allclose(other.positions, pc.positions, atol=1e-4)


def test_computed_quantities_are_no_markers(data_dir):
    markers = read_markers(find(data_dir("markers_pycgm"), "Static_trial.c3d"))
    assert "LASI" in markers.names
    assert "LHipAngles" not in markers.names


def test_static_trials_agree_across_formats_and_units(data_dir):
    weird = read_markers(find(data_dir("markers"), "WeirdFormatTests__markers.trc"))
    assert weird.names[:3] == ("LFHD", "RFHD", "LBHD")
    np.testing.assert_allclose(weird.positions[0, 0], [-1.8425, 1.573, -0.27479])
    run = read_markers(find(data_dir("markers"), "run200__markers.trc"))
    np.testing.assert_allclose(run.positions[0, 0], [1.233237613, 1.052082007, -0.197818005])


@pytest.fixture(scope="module")
def small_c3d(tmp_path_factory):
    """Two markers, 30 frames, one gap: (bytes, positions [mm])."""
    file = ezc3d.c3d()
    positions = 1000 + 10 * np.random.default_rng(0).normal(size=(30, 2, 3))
    points = np.ones((4, 2, 30))
    points[:3] = positions.transpose(2, 1, 0)
    points[:3, 1, 7] = np.nan
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = ("A", "")
    file["parameters"]["POINT"]["UNITS"]["value"] = ("mm",)
    file["data"]["points"] = points
    path = tmp_path_factory.mktemp("c3d") / "small.c3d"
    file.write(str(path))
    return path.read_bytes(), positions


def test_c3d_written_by_ezc3d(small_c3d, tmp_path):
    raw, positions = small_c3d
    (tmp_path / "a.c3d").write_bytes(raw)
    markers = read_markers(tmp_path / "a.c3d")
    assert markers.names == ("A", "*2")
    assert np.isnan(markers.positions[7, 1]).all()
    assert np.isnan(markers.positions).sum() == 3
    np.testing.assert_allclose(markers.positions[:, 0], positions[:, 0] / 1000, rtol=1e-6)
    np.testing.assert_allclose(read_markers(tmp_path / "a.c3d", unit="m").positions[:, 0], positions[:, 0], rtol=1e-6)


def test_c3d_without_a_known_unit(small_c3d, tmp_path):
    raw = small_c3d[0]
    at = raw.index(b"mm", raw.index(b"POINT"))
    (tmp_path / "a.c3d").write_bytes(raw[:at] + b"xq" + raw[at + 2 :])
    with pytest.raises(ObservationError, match="no unit 'xq'; there are: m"):
        read_markers(tmp_path / "a.c3d")
    (tmp_path / "a.c3d").write_bytes(raw[:at] + b"  " + raw[at + 2 :])
    with pytest.raises(ObservationError, match="states no unit"):
        read_markers(tmp_path / "a.c3d")


def test_truncated_c3d_tells_what_can_be_read(small_c3d, tmp_path):
    raw = small_c3d[0]
    start = 512 * (int.from_bytes(raw[16:18], "little") - 1)
    (tmp_path / "a.c3d").write_bytes(raw[: start + 32 * 12 + 5])
    with pytest.raises(FileError, match="truncated: 12 of 30 frames"):
        read_markers(tmp_path / "a.c3d")


@settings(max_examples=300)
@given(st.data())
def test_damaged_c3d_never_crashes(small_c3d, tmp_path_factory, data):
    """Any bytes of header and parameters changed, or the file cut: a reading, or a typed error."""
    raw = bytearray(small_c3d[0])
    if data.draw(st.booleans()):
        raw = raw[: data.draw(st.integers(0, len(raw)))]
    for _ in range(data.draw(st.integers(0, 8)) if raw else 0):
        raw[data.draw(st.integers(0, min(len(raw), 2500) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.c3d"
    path.write_bytes(raw)
    try:
        markers = read_markers(path)
    except KinefitError as error:
        assert error.file == path
    else:
        assert np.isfinite(markers.positions).any()
        assert 0 < markers.rate < np.inf


def trc(rows, *, names=("A", "B"), units="mm", rate="100", frames=None, extra=""):
    header = "\t".join(f"{name}\t\t" for name in names)
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tx.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{len(rows) if frames is None else frames}\t{len(names)}\t{units}\t{rate}\t1\t{len(rows)}",
        f"Frame#\tTime\t{header}", "\t\tX1\tY1\tZ1\tX2\tY2\tZ2", extra, *rows,
    ]
    return "\n".join(lines) + "\n"


ROWS = ["1\t0.00\t1\t2\t3\t4\t5\t6", "2\t0.01\t1\t2\t3\t\t\t", "3\t0.02\t0\t0\t0\t7\t8\t9", "4\t0.03\t1\t2\t3"]


@pytest.mark.parametrize(("units", "metre"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("MM", 0.001)])
def test_trc_units_and_gaps(tmp_path, units, metre):
    path = tmp_path / "a.trc"
    path.write_text(trc(ROWS, units=units))
    markers = read_markers(path)
    assert markers.names == ("A", "B")
    np.testing.assert_allclose(markers.positions[0], np.array([[1, 2, 3], [4, 5, 6]]) * metre)
    np.testing.assert_array_equal(np.isnan(markers.positions[..., 0]), [[0, 0], [0, 1], [1, 0], [0, 1]])


def test_trc_with_spaces_windows_ends_and_byte_order_mark(tmp_path):
    path = tmp_path / "a.trc"
    text = trc(ROWS[:1] + ["2\t0.01\t1\t2\t3\t4\t5\tNaN"])
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    tabs = read_markers(path)
    path.write_text(text.replace("\t\t", "  ").replace("\t", "  "))
    np.testing.assert_array_equal(read_markers(path).positions, tabs.positions)
    assert np.isnan(tabs.positions[1, 1]).all()


BAD_TRC = {
    "truncated: 4 of 9 frames": trc(ROWS, frames=9),
    "truncated: 3 frames can be read": trc(ROWS).rstrip("\n"),
    "no unit 'furlong'": trc(ROWS, units="furlong"),
    "not a number.*x7": trc([*ROWS[:2], "3\t0.02\tx7\t0\t0\t7\t8\t9"]),
    "line 8.*7 cells where 2 markers need 8": trc([ROWS[0], "2\t0.01\t1\t2\t3\t4\t5"]),
    "line 8.*9 cells": trc([ROWS[0], "2\t0.01\t1\t2\t3\t4\t5\t6\t7"]),
    "missing or not a number": trc(ROWS, rate="fast"),
    "DataRate 100 Hz, but the 4 rows": trc([*ROWS[:3], "4\t9.0\t1\t2\t3"]),
    "none of the 2 markers": trc(["1\t0.00\t0\t0\t0\t0\t0\t0", "2\t0.01\t\t\t\t\t\t"]),
    "nothing in this file": trc([]),
    "rate 0": trc(ROWS, rate="0"),
    "missing or not a number .*infinity": trc(ROWS).replace("\t4\t2\t", "\t4\tinf\t"),
    "1000000000000 markers in 4 frames": trc(ROWS).replace("\t4\t2\t", "\t4\t1e12\t"),
    "not a TRC file": "PathFileType\t4\n",
}


@pytest.mark.parametrize("problem", BAD_TRC)
def test_bad_trc(tmp_path, problem):
    path = tmp_path / "a.trc"
    path.write_text(BAD_TRC[problem])
    with pytest.raises(KinefitError, match=problem) as caught:
        read_markers(path)
    assert caught.value.file == path


@settings(max_examples=300)
@given(st.data())
def test_damaged_trc_never_crashes(tmp_path_factory, data):
    raw = bytearray(trc(ROWS * 2).encode())
    if data.draw(st.booleans()):
        raw = raw[: data.draw(st.integers(0, len(raw)))]
    for _ in range(data.draw(st.integers(0, 6)) if raw else 0):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.sampled_from(list(b"\t\n\r 0-.eEnX\xff\x00")))
    path = tmp_path_factory.getbasetemp() / "damaged.trc"
    path.write_bytes(raw)
    try:
        markers = read_markers(path)
    except KinefitError as error:
        assert error.file == path
    else:
        assert np.isfinite(markers.positions).any()
        assert 0 < markers.rate < np.inf


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        read_markers(tmp_path / "none.c3d")
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(FileError, match="neither C3D nor TRC"):
        read_markers(tmp_path / "a.txt")
    (tmp_path / "a.c3d").write_bytes(b"")
    with pytest.raises(FileError, match="not a C3D file"):
        read_markers(tmp_path / "a.c3d")
    with pytest.raises(FileError, match="is not a file"):
        read_markers(tmp_path)


def test_a_parameter_of_no_numbers_in_dimensions_beyond_bounds_is_refused():
    with pytest.raises(FileError, match="impossible dimensions"):
        _values(bytes([2, 10, 0, *[255] * 9]), "intel", "POINT:X")


def test_the_clock_is_the_files(data_dir, tmp_path):
    markers = read_markers(data_dir("cases_of_users") / "trc-starts-at-12.5-s" / "take.trc")
    np.testing.assert_allclose(markers.times, 12.5 + np.arange(100) / 100)
    (path,) = data_dir("markers").rglob("*JA1Gait35.c3d")
    walk = read_markers(path)
    assert (walk.first_frame, walk.times[0]) == (833, pytest.approx(832 / 250))
    assert walk.times[0] < walk.events[0].time < walk.times[-1]  # of the same clock
    path = tmp_path / "a.trc"
    path.write_text(trc([row.replace("\t0.0", "\t-0.5", 1) for row in ROWS[:1]]))
    assert read_markers(path).first_time == -0.5


def rows_at(times, numbers=None):
    return [f"{n}\t{t:.5f}\t{i}\t2\t3\t4\t5\t6" for i, (n, t) in enumerate(zip(numbers or range(1, 99), times), 1)]


def test_missing_rows_are_empty_frames(data_dir, tmp_path):
    markers = read_markers(data_dir("cases_of_users") / "trc-rows-missing" / "take.trc")
    empty = np.isnan(markers.positions).all(axis=(1, 2))
    assert (len(markers), list(np.flatnonzero(empty)), markers.rate) == (200, [100, 101, 102], 100.0)
    assert markers.times[103] == pytest.approx(1.03)
    assert markers.notes == ("take.trc: 3 frames have no row and are empty, first after frame 100",)
    path, kept = tmp_path / "a.trc", np.r_[:10, 14:30]
    for numbers in (None, (kept + 1).tolist(), (5 * kept + 7).tolist()):  # of every fifth frame
        path.write_text(trc(rows_at(kept / 100, numbers)))
        found = read_markers(path)
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(found.positions[:, 0, 0])), kept)
        assert "4 frames have no row" in found.notes[0]
    path.write_text(trc(rows_at(np.arange(26) / 100, (kept + 1).tolist())))
    found = read_markers(path)
    assert len(found) == 26 and "frame numbers jump, times do not, first after frame 10" in found.notes[0]


@pytest.mark.parametrize(("stated", "true", "noted"), [(60, 59.94, True), (100, 99, True), (65.05, 65.0533, False)])
def test_the_rate_is_that_of_the_times(tmp_path, stated, true, noted):
    path = tmp_path / "a.trc"
    path.write_text(trc(rows_at(np.arange(90) / true), rate=str(stated)))
    found = read_markers(path)
    assert found.rate == pytest.approx(true if noted else stated, rel=1e-5)
    assert bool(found.notes) == noted == ("the times count" in "".join(found.notes))


def test_times_in_whole_milliseconds_give_the_stated_rate(tmp_path):
    path = tmp_path / "a.trc"
    path.write_text(trc(rows_at(np.round(np.arange(90) / 150, 3)), rate="150"))
    assert (read_markers(path).rate, read_markers(path).notes) == (150.0, ())


NAMES = {
    "A\t\t\tB\t\t\t": ("A", "B"), "\t\t\tB": ("*1", "B"), "A": ("A", "*2"), "": ("*1", "*2"), "\tA\t\t\tB": ("A", "B"),
    "A\tB": ("A", "B"), "A\t\tB": ("A", "B"), "A\tA\tA\tB\tB\tB": ("A", "B"),
    "A_x\tA_y\tA_z\tB_x\tB_y\tB_z": ("A", "B"),
    "A:X\tA:Y\tA:Z\tB:X\tB:Y\tB:Z": ("A", "B"), "L ASI (X)\tL ASI (Y)\tL ASI (Z)\tB X\tB Y\tB Z": ("L ASI", "B"),
}  # fmt: skip


@pytest.mark.parametrize("line", NAMES)
def test_names_belong_to_the_columns_below(tmp_path, line):
    path, usual = tmp_path / "a.trc", "Frame#\tTime\tA\t\t\tB\t\t"
    assert usual in trc(ROWS)
    path.write_text(trc(ROWS).replace(usual, f"Frame#\tTime\t{line}"))
    markers = read_markers(path)
    assert markers.names == NAMES[line]
    np.testing.assert_allclose(markers.positions[0], [[0.001, 0.002, 0.003], [0.004, 0.005, 0.006]])


def test_real_names_by_columns(data_dir):
    cases = data_dir("cases_of_users")
    markers = read_markers(cases / "trc-unnamed-column" / "take.trc")
    assert markers.names == ("LASI", "*2", "LPSI", "RPSI", "C7")
    np.testing.assert_allclose(markers.positions[0, 2], [-0.6014, 0.9321, -0.2611], atol=1e-4)
    assert read_markers(cases / "trc-axis-labels-from-X5" / "take.trc").positions.shape == (60, 5, 3)


@pytest.mark.parametrize("axes", ["\t\tX0\tY0\tZ0\tX1\tY1\tZ1", "\t\tX\tY\tZ\tX\tY\tZ", "(s)\t\t(mm)", ""])
def test_a_line_of_axes_is_no_row(tmp_path, axes):
    path = tmp_path / "a.trc"
    path.write_text(trc(ROWS).replace("\t\tX1\tY1\tZ1\tX2\tY2\tZ2", axes))
    assert len(read_markers(path)) == 4


def test_a_missing_name_between_blanks_is_refused(tmp_path):
    path = tmp_path / "a.trc"
    path.write_text(trc(ROWS).replace("Frame#\tTime\tA\t\t\tB\t\t", "Frame# Time A"))
    with pytest.raises(FileError, match="1 names for 2 markers") as caught:
        read_markers(path)
    assert caught.value.place == "line 4"


PLACES = np.random.default_rng(0).normal(size=(60, 2, 3)).astype(np.float32)
ANALOG = np.arange(60 * 40, dtype=np.float32).reshape(60, 40)
EIGHT = {"ANALOG": {"USED": np.array(8, np.uint16), "RATE": np.array(500.0, np.float32)}}
SEVEN = {"ANALOG": EIGHT["ANALOG"] | {"USED": np.array(7, np.uint16)}}


def of_header(changes, *, points=PLACES, groups=None, first=1, **more):
    """A C3D of two markers, whose header has other words or floats at some bytes."""
    own = {"POINT": {"UNITS": ["m"], "LABELS": ["A", "B"]}, **(groups or {})}
    own["POINT"] = {"UNITS": ["m"], "LABELS": ["A", "B"]} | own["POINT"]
    raw = bytearray(c3d_bytes(points, np.zeros(points.shape[:2]), own, scale=-1.0, rate=100.0, first=first, **more))
    for at, value in changes.items():
        struct.pack_into("<f" if isinstance(value, float) else "<H", raw, at, value)
    return bytes(raw)


REFUSED_C3D = {
    "header's rate is 60 Hz, POINT:RATE is 100 Hz": of_header({20: 60.0}),
    "header's rate is 100 Hz, POINT:RATE is 120 Hz": of_header(
        {}, groups={"POINT": {"RATE": np.array(120, np.float32)}}
    ),
    "header's scale is 0.1, POINT:SCALE is -1 ": of_header({12: 0.1}),
    "POINT:SCALE is 0.05": of_header({}, groups={"POINT": {"SCALE": np.array(0.05, np.float32)}}),
    "8 analog values a frame from block.*fits none": of_header({4: 8}, groups=SEVEN, analog=ANALOG, samples=5),
}


@pytest.mark.parametrize("problem", REFUSED_C3D)
def test_a_c3d_that_contradicts_itself_is_refused(tmp_path, problem):
    path = tmp_path / "a.c3d"
    path.write_bytes(REFUSED_C3D[problem])
    with pytest.raises(FileError, match=problem) as caught:
        read_markers(path)
    assert caught.value.file == path and "header" in caught.value.place


NOTED_C3D = {
    "60 Hz, POINT:RATE is 100 Hz: 100 Hz counts": of_header({20: 60.0}, groups=EIGHT, analog=ANALOG, samples=5),
    "states 8 analog values.*40 from": of_header({4: 8}, groups=EIGHT, analog=ANALOG, samples=5),
    "states 0 analog values.*40 from": of_header({4: 0, 18: 0}, groups=EIGHT, analog=ANALOG, samples=5),
    "from block 9 on; 0 from block": of_header({16: 9}),
    "begins with frame 1, TRIAL:ACTUAL_START_FIELD is 833": of_header({6: 1, 8: 60}, first=833),
    "scale of residuals is 2, POINT:SCALE's 1 counts": of_header({12: -2.0}),
}


@pytest.mark.parametrize("note", NOTED_C3D)
def test_a_contradiction_that_the_file_decides_is_noted(tmp_path, note):
    path = tmp_path / "a.c3d"
    path.write_bytes(NOTED_C3D[note])
    markers = read_markers(path)
    assert (markers.rate, len(markers.notes)) == (100.0, 1)
    np.testing.assert_array_equal(markers.positions, PLACES.astype(float))
    assert re.search(note, markers.notes[0])


def test_frames_beyond_the_header_are_counted_by_parameters_or_length(data_dir, tmp_path):
    path, long = tmp_path / "a.c3d", np.resize(PLACES, (66_000, 2, 3))
    path.write_bytes(gzip.decompress((data_dir("cases_of_users") / "c3d-long-frames" / "take.c3d.gz").read_bytes()))
    markers = read_markers(path)
    assert (len(markers), markers.notes) == (66_000, ())
    assert markers.positions[-1, 0, 0] == pytest.approx(0.5)
    none = {"TRIAL": {"ACTUAL_END_FIELD": []}}
    for raw in (of_header({}, points=long), of_header({}, points=long, groups=none) + bytes(300)):
        path.write_bytes(raw)
        markers = read_markers(path)
        assert (len(markers), markers.notes) == (66_000, ())
        np.testing.assert_array_equal(markers.positions[-2:], long[-2:].astype(float))
    path.write_bytes(of_header({}, points=long)[:-10_000])
    with pytest.raises(FileError, match="truncated: .* of 66000 frames"):
        read_markers(path)
