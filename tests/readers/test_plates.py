"""Force plates of C3D files beside ezc3d, what contradicts itself in them, and ground forces of OpenSim."""

import ezc3d
import numpy as np
import pytest

from kinefit.errors import FileError, KinefitError
from kinefit.exporters.c3d_file import c3d_bytes, label_groups
from kinefit.readers.markers import read_markers
from kinefit.readers.plates import read_force_file

REAL = {
    "gait_biomechzoo/HC002D/straight.c3d": (2, 393.7), "markers_bmc_run/Gait.c3d": (2, 871.4),
    "markers_pycgm/Test_Files/Movement_trial.c3d": (4, 1214.2),
    "markers/btkdata/Input__C3DSamples__c3d.org__sample01__Eb015pr.c3d": (2, 817.3),
}  # fmt: skip
"""{file: its plates, and the largest load [N]}; the second is of type 4."""
CORNERS = np.array([[0.6, 0.4, 0.0], [0.1, 0.4, 0.0], [0.1, 0.0, 0.0], [0.6, 0.0, 0.0]])
SAMPLES, FRAMES, LOADED = 4, 30, 10


def recording(tmp_path, kind, channels, *, origin=(0.0, 0.0, -40.0), units=None, matrix=None, change=lambda _: None):
    """A C3D of one marker and one plate, whose z is down, with such channels (N, 6 or 8) [N, N mm]."""
    width = channels.shape[1]
    platform = {
        "USED": np.array(1, np.uint16), "TYPE": np.array([kind], np.uint16), "ZERO": np.zeros(2, np.uint16),
        "CORNERS": 1e3 * CORNERS[[1, 0, 3, 2]].T[..., None].astype(np.float32),
        "ORIGIN": np.array(origin, np.float32)[:, None],
        "CHANNEL": np.arange(1, width + 1, dtype=np.uint16)[:, None],
    }  # fmt: skip
    if matrix is not None:
        platform["CAL_MATRIX"] = matrix.astype(np.float32)[..., None]
    plain = ["N"] * 8 if width == 8 else ["N"] * 3 + ["Nmm"] * 3
    analog = {
        "USED": np.array(width, np.uint16), "RATE": np.array(100.0 * SAMPLES, np.float32),
        "SCALE": np.ones(width, np.float32), "OFFSET": np.zeros(width, np.int16),
        "GEN_SCALE": np.array(1.0, np.float32), "UNITS": units or plain,
        **label_groups([f"c{k}" for k in range(width)], [""] * width),
    }  # fmt: skip
    groups = {
        "POINT": {"UNITS": ["mm"], "Y_SCREEN": ["+Z"], "X_SCREEN": ["+X"], **label_groups(["A"], [""])},
        "ANALOG": analog, "FORCE_PLATFORM": platform,
    }  # fmt: skip
    change(groups)
    places = np.full((FRAMES, 1, 3), 900.0)
    raw = channels.reshape(FRAMES, -1)
    file = tmp_path / "plate.c3d"
    file.write_bytes(c3d_bytes(
        places, np.zeros((FRAMES, 1)), groups, scale=-1.0, rate=100.0, first=1, analog=raw, samples=SAMPLES
    ))  # fmt: skip
    return file


def loads(width, seed=0):
    """Channels (N, width) of a person who stands on the plate after a while."""
    channels = np.random.default_rng(seed).normal(scale=8.0, size=(FRAMES * SAMPLES, width))
    down = slice(4, 8) if width == 8 else slice(2, 3)
    channels[LOADED * SAMPLES :, down] += 700.0 / (4 if width == 8 else 1)
    channels[: LOADED * SAMPLES] = 0.0
    return channels


@pytest.mark.parametrize("name", REAL)
def test_real_plates_are_those_of_ezc3d(data_dir, name):
    file = data_dir(name.split("/")[0]) / name.partition("/")[2]
    plates = read_markers(file).plates
    others = ezc3d.c3d(str(file), extract_forceplat_data=True)["data"]["platform"]
    assert len(plates) == len(others) == REAL[name][0]
    assert max(plate.load.max() for plate in plates) == pytest.approx(REAL[name][1], abs=0.1)
    for plate, other in zip(plates, others):
        stood = plate.load > 100.0
        if not name.startswith(("markers_bmc", "markers/btk")) and stood.any():  # whose ZERO ezc3d does not use
            np.testing.assert_allclose(np.abs(plate.force[stood]), np.abs(other["force"].T[stood]), atol=1e-3)
            at = 1e-3 * other["center_of_pressure"].T
            np.testing.assert_allclose(plate.centre_of_pressure()[stood], at[stood], atol=1e-5)
        assert plate.normal @ [0.0, 0.0, 1.0] > 0.99


@pytest.mark.parametrize(("kind", "width"), [(2, 6), (3, 8), (4, 6)])
def test_types_are_those_of_ezc3d(tmp_path, kind, width):
    rng = np.random.default_rng(1)
    matrix = np.diag([1.0, 1.0, 1.0, 300.0, 300.0, 300.0]) + rng.normal(scale=0.01, size=(6, 6)) if kind == 4 else None
    origin = (120.0, 200.0, -40.0) if kind == 3 else (1.0, 2.0, -40.0)
    file = recording(tmp_path, kind, loads(width), origin=origin, matrix=matrix)
    (plate,), (other,) = (
        read_markers(file).plates, ezc3d.c3d(str(file), extract_forceplat_data=True)["data"]["platform"]
    )  # fmt: skip
    stood = plate.load > 100.0
    assert stood.sum() == (FRAMES - LOADED) * SAMPLES
    np.testing.assert_allclose(plate.force[stood], -other["force"].T[stood], rtol=1e-5, atol=1e-2)
    found, wanted = plate.centre_of_pressure()[stood], 1e-3 * other["center_of_pressure"].T[stood]
    np.testing.assert_allclose(found[:, :2], wanted[:, :2], atol=1e-4)


def test_type_1_states_the_centre_of_pressure(tmp_path):
    channels = loads(6)
    channels[:, 3:5] = [50.0, -30.0]  # [mm] along the plate's x and y
    (plate,) = read_markers(recording(tmp_path, 1, channels, units=["N"] * 3 + ["mm"] * 2 + ["Nmm"])).plates
    at = plate.centre_of_pressure()[-1] - plate.centre
    np.testing.assert_allclose(plate.axes @ at, [0.05, -0.03], atol=1e-6)
    np.testing.assert_allclose(plate.free_moment()[-5:], 1e-3 * channels[-5:, 5], atol=1e-6)


def test_an_offset_turns_nothing_upside_down(tmp_path):
    channels = loads(6)
    channels[:, 2] -= 30.0
    (plate,) = read_markers(recording(tmp_path, 2, np.concatenate([channels[:40]] * 2 + [channels[80:]]))).plates
    assert plate.normal @ [0.0, 0.0, 1.0] > 0.99 and plate.load.max() > 600.0


def test_frames_of_a_baseline_count_where_nobody_stands(tmp_path):
    channels = loads(6)
    channels[:, :3] += [3.0, -2.0, 25.0]
    zero = lambda first, last: lambda g: g["FORCE_PLATFORM"].update(ZERO=np.array([first, last], np.uint16))
    at_rest = read_markers(recording(tmp_path, 2, channels, change=zero(1, LOADED)))
    assert np.abs(at_rest.plates[0].force[: LOADED * SAMPLES]).max() < 1e-3 and not at_rest.notes
    under_load = read_markers(recording(tmp_path, 2, channels, change=zero(LOADED + 2, LOADED + 8)))
    assert under_load.plates[0].load[0] == pytest.approx(25.0) and "under load" in under_load.notes[0]


def test_a_downward_axis_turns_no_force(tmp_path):
    down = lambda g: g["POINT"].update(Y_SCREEN=["-Z"])
    (plate,) = read_markers(recording(tmp_path, 2, loads(6), change=down)).plates
    assert plate.force[-1, 2] < -600.0 and plate.normal @ [0.0, 0.0, -1.0] > 0.99


def test_a_wrong_unit_of_moments_is_named_and_corrected(tmp_path):
    channels = loads(6)
    channels[:, 3:5] += 700.0 * np.array([60.0, 80.0]) * np.linspace(0.5, 1.0, len(channels))[:, None]
    right = read_markers(recording(tmp_path, 2, channels))
    wrong = read_markers(recording(tmp_path, 2, channels, units=["N"] * 3 + ["Nm"] * 3))
    assert not right.notes and "not in N m" in wrong.notes[0]
    np.testing.assert_allclose(right.plates[0].moment, wrong.plates[0].moment, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (lambda g: g["FORCE_PLATFORM"].pop("CORNERS"), "no CORNERS of force plate 1"),
        (lambda g: g["FORCE_PLATFORM"].update(TYPE=np.array([6], np.uint16)), "of type 6"),
        (lambda g: g["FORCE_PLATFORM"].update(CORNERS=np.zeros((3, 4, 1), np.float32)), "no corners"),
        (lambda g: g["FORCE_PLATFORM"].update(CHANNEL=np.arange(5, 11, dtype=np.uint16)[:, None]), "has the channels"),
        (lambda g: g["FORCE_PLATFORM"].update(TYPE=np.array([3], np.uint16)), "of type 3 has the channels"),
    ],
)
def test_plates_that_cannot_be_read_are_noted_and_the_markers_kept(tmp_path, change, note):
    markers = read_markers(recording(tmp_path, 2, loads(6), change=change))
    assert not markers.plates and note in " ".join(markers.notes) and len(markers) == FRAMES


MOT = """forces
version=1
endheader
time\tground_force_vx\tground_force_vy\tground_force_vz\tground_force_px\tground_force_py\tground_force_pz
0.00\t0\t0\t0\t0\t0\t0
0.01\t5\t700\t3\t0.30\t0\t0.20
0.02\t6\t710\t3\t0.35\t0\t0.22
"""


def test_ground_forces_of_opensim(tmp_path):
    file = tmp_path / "grf.mot"
    file.write_text(MOT)
    (plate,) = read_force_file(file).plates
    assert (plate.rate, plate.first_time) == (pytest.approx(100.0), 0.0)
    np.testing.assert_allclose(plate.load, [0, 700, 710])
    np.testing.assert_allclose(plate.centre_of_pressure()[1:], [[0.30, 0.0, 0.20], [0.35, 0.0, 0.22]], atol=1e-9)


def test_forces_on_the_plate_are_turned_round(tmp_path):
    file = tmp_path / "grf.mot"
    file.write_text(MOT.replace("\t700\t", "\t-700\t").replace("\t710\t", "\t-710\t"))
    found = read_force_file(file)
    assert "turned round" in found.notes[0] and found.plates[0].load.max() == pytest.approx(710.0)


def test_rounded_times_keep_their_rate(tmp_path):
    rows = "".join(f"{k / 120:.3f}\t0\t700\t0\t0.3\t0\t0.2\n" for k in range(600))
    file = tmp_path / "grf.mot"
    file.write_text(MOT[: MOT.index("0.00\t")] + rows)
    assert read_force_file(file).plates[0].rate == pytest.approx(120.0, abs=0.01)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("time\tx\n0\t1\n", "endheader"), (MOT.replace("_px", "_qx"), "ground_force_px"),
        (MOT.replace("710", "much"), "no number"), (MOT.replace("_vx", "_ux"), "ground_force_vx"),
        (MOT.replace("0.02\t", "0.05\t"), "not evenly spaced"), (MOT.replace("700", "nan"), "force that is no number"),
        (MOT.replace("0.35", "350"), "350 m from the origin"), (MOT.replace("version=1", "nRows=7"), "3 of 7 rows"),
        (MOT.replace("\t0.22", ""), "6 cells for 7 columns"),
    ],
)
def test_wrong_ground_forces_are_named(tmp_path, text, problem):
    file = tmp_path / "grf.mot"
    file.write_text(text)
    with pytest.raises(KinefitError, match=problem) as error:
        read_force_file(file)
    assert isinstance(error.value, FileError) and error.value.remedy
