"""A take with a depth sensor, keypoints and a few markers at once, simulated, by the command line."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import load_body, read_motion, track
from kinefit.bodies.marker_sets import placement
from kinefit.cli import main
from kinefit.errors import KinefitError
from kinefit.exporters import write_markers, write_motion
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.observations import Markers
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import cut, squat_and_wave
from kinefit.simulation.movements import movement, people
from kinefit.takes.track import track_take

MARKERS = ("l_wrist", "r_wrist", "l_knee")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One second of a wave as a time-of-flight camera and a colour camera's keypoints saw it, and three markers."""
    folder = tmp_path_factory.mktemp("wave")
    truth = movement("wave", people()[2].body, rate=10.0)
    write_motion(truth, folder / "truth.npz")
    told = CliRunner().invoke(
        main, ["simulate", str(folder / "truth.npz"), "-o", str(folder / "seen"), "--sensor", "tof", "--sensor",
               "keypoints", "--frames", "0:8"],
    )  # fmt: skip
    assert told.exit_code == 0, told.output
    motion = read_motion(folder / "seen" / "truth" / "motion.npz")
    x = motion.positions(motion.body.landmarks.select(MARKERS))
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tfew.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"10\t10\t{len(x)}\t{len(MARKERS)}\tm\t10\t1\t{len(x)}",
        "Frame#\tTime\t" + "\t\t\t".join(MARKERS) + "\t\t",
        "\t\t" + "\t".join(f"X{k}\tY{k}\tZ{k}" for k in (1, 2, 3)),
        "",
    ]
    lines += ["\t".join([f"{i + 1}", f"{i / 10:.6f}", *(f"{v:.6f}" for v in f.ravel())]) for i, f in enumerate(x)]
    (folder / "seen" / "few.trc").write_text("\n".join(lines) + "\n")
    take = folder / "seen" / "take.toml"
    take.write_text(take.read_text() + '\n[[markers]]\nfile = "few.trc"\n')
    return folder / "seen"


def test_every_step_holds_what_each_sensor_saw(folder):
    take = read_take(folder / "take.toml")
    seen = load_observations(take)
    recording, _ = recording_of(take, seen, load_body(take.body))
    sensors = [[f.sensor for f in recording.steps(i)] for i in range(8)]
    assert len(recording) == 8 and all(s == ["tof", "markers", "colour"] for s in sensors)
    (colour,) = recording.keypoints
    for i in range(8):
        frame = recording.steps(i)[-1]
        np.testing.assert_array_equal(frame.uv, colour.points[i, 0])
        np.testing.assert_array_equal(frame.confidence, colour.confidence[i, 0])
    assert set(recording.sigma) == {"tof", "colour", "markers"}
    assert {f.sensor for f in recording.depth.values()} == {"tof"}


@pytest.mark.slow
def test_a_take_of_three_kinds_of_sensors_is_fused(folder, tmp_path):
    """Size and start are found from the depth images alone; what is tracked then is within centimetres."""
    out = tmp_path / "out"
    told = CliRunner().invoke(main, ["track", str(folder / "take.toml"), "-o", str(out), "--no-report"])
    assert told.exit_code == 0, told.output
    assert "colour" in told.output and "markers" in told.output
    found, truth = read_motion(out / "motion.npz"), read_motion(folder / "truth" / "motion.npz")
    x, y = (m.positions(m.body.landmarks.select(("neck", *MARKERS))) for m in (found, truth))
    assert np.median(np.linalg.norm(x - y, axis=-1)) < 0.03
    assert found.residuals["markers"].unit == "m" and found.residuals["colour"].unit == "px"
    assert (out / "overlays" / "tof.mp4").stat().st_size > 1000 and (out / "montage.png").exists()


def test_size_and_background_can_be_left_as_they_are(folder):
    take = read_take(folder / "take.toml")
    recording, body = recording_of(take, load_observations(take), load_body(take.body))
    motion = track(recording, body, size=False)
    assert len(motion) == 8 and np.isfinite(motion.angles).all()
    np.testing.assert_array_equal(motion.body.tree.offsets, body.tree.offsets)
    assert not {"size", "shape"} & set(motion.provenance)


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ('unit = 0.001', "millimetres|size|unit|not found in the first"),
        ('file = "few.trc"', "no such|does not exist|not there"),
    ],
)
def test_what_is_wrong_is_named(folder, tmp_path, line, match):
    text = (folder / "take.toml").read_text()
    broken = {"unit = 0.001": "unit = 1.0", 'file = "few.trc"': 'file = "none.trc"'}[line]
    path = folder / "broken.toml"
    path.write_text(text.replace(line, broken))
    with pytest.raises(KinefitError, match=match):
        track_take(path)


def test_markers_beside_keypoints_count(tmp_path, copy_take):
    """Markers of three joints, 1 mm: where they are, the fused take is nearer to the truth than keypoints alone."""
    truth, take = squat_and_wave(), copy_take(tmp_path)
    x = truth.positions(truth.body.landmarks.select(MARKERS))
    x = x + 0.001 * np.random.default_rng(0).standard_normal(x.shape)
    write_markers(Markers(MARKERS, truth.rate, x, up=truth.up), tmp_path / "few.trc")
    without = track_take(take)[0]
    take.write_text(take.read_text() + '\n[[markers]]\nfile = "few.trc"\nsigma = 0.002\n')
    fused = track_take(take)[0]

    def off(motion):
        found = motion.positions(motion.body.landmarks.select(MARKERS))
        return np.linalg.norm(found - x, axis=2).mean()

    assert off(fused) < 0.003
    assert off(fused) < 0.75 * off(without)


REAL_MARKERS = {
    "momentum/momentum__examples__process_markers_app__02_01.c3d": 0.004,
    "nimblephysics/data__c3d__JA1Gait35.c3d": 0.012,
}


@pytest.mark.parametrize("name", REAL_MARKERS)
def test_real_labelled_markers_choose_the_set_that_knows_most_of_them(tmp_path, data_dir, name):
    """One label may be a marker of the body's own set by chance."""
    take = tmp_path / "take.toml"
    take.write_text(f'[take]\nframes = [0, 60]\n[[markers]]\nfile = "{data_dir("markers") / name}"\n', encoding="utf-8")
    motion, _ = track_take(take)
    residuals = motion.residuals["markers"]
    assert len(residuals.names) >= 30
    assert np.nanmedian(np.linalg.norm(residuals.values, axis=-1)) < REAL_MARKERS[name]
    assert np.isfinite(motion.dof_std).mean() > 0.6


@pytest.mark.parametrize(
    ("bands", "stretched"), [("{ all = 0.005 }", 0.02), ("{ elbow_r = 0.0001, neck = 0.01 }", 0.05)]
)
def test_joints_by_elastic_bands(tmp_path, bands, stretched):
    truth = cut(squat_and_wave(rate=30), 0, 12)
    points = placement(truth.body, "CMU_41").points
    x = truth.positions(points) + 0.003 * np.random.default_rng(0).normal(size=(12, len(points), 3))
    write_markers(Markers(points.names, 30.0, x, up="z"), tmp_path / "m.c3d")
    table = f'[take]\nup = "z"\nsize = false\nbands = {bands}\n[[markers]]\nfile = "m.c3d"\n'
    (tmp_path / "take.toml").write_text(table)
    motion, _ = track_take(tmp_path / "take.toml")
    ends = [motion.positions(motion.body.landmarks.select((c.point, c.to))) for c in motion.body.closures]
    stretch = {c.name: np.linalg.norm(x[:, 0] - x[:, 1], axis=1) for c, x in zip(motion.body.closures, ends)}
    assert 1e-4 < max(s.max() for s in stretch.values()) < stretched
    if "elbow_r" in bands:  # the stiff band holds, and joints without bands stay as they are
        assert max(s.max() for name, s in stretch.items() if "forearm_r" in name) < 1e-3
        assert "shank_r_band_tx" not in motion.body.tree.coordinates
    same = [motion.body.tree.coordinates.index(name) for name in truth.body.tree.coordinates]
    assert np.linalg.norm(motion.joint_centres - truth.joint_centres, axis=2).mean() < 0.005
    assert np.degrees(np.abs(motion.angles[:, same] - truth.angles)).mean() < 4.0
    write_motion(motion, tmp_path / "motion.npz")
    again, _ = track_take(replace(read_take(tmp_path / "take.toml"), start=tmp_path / "motion.npz"))
    assert again.body.tree.coordinates == motion.body.tree.coordinates


@pytest.mark.parametrize(("bands", "problem"), [("{ nose = 0.01 }", "no joint 'nose'"), ("{ all = 0 }", "in metres")])
def test_bands_that_cannot_be_are_named_with_their_place(tmp_path, bands, problem):
    write_markers(Markers(("C7", "CLAV", "STRN"), 30.0, np.ones((3, 3, 3)), up="z"), tmp_path / "m.c3d")
    (tmp_path / "take.toml").write_text(f'[take]\nbands = {bands}\n[[markers]]\nfile = "m.c3d"\n')
    with pytest.raises(KinefitError, match=problem) as raised:
        track_take(tmp_path / "take.toml")
    assert "bands" in str(raised.value)
