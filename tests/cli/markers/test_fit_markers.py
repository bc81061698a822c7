"""What `kinefit markers fit` leaves in a folder."""

import re

import numpy as np
import pytest
from click.testing import CliRunner
from tests.exporters.test_opensim import poses_by_opensim, read_mot

from kinefit import Markers, read_markers, read_motion, read_take
from kinefit.bodies import PointSet
from kinefit.bodies.marker_sets import placement
from kinefit.cli import main
from kinefit.cli.markers._fit import WRITTEN, MarkerFitOptions, fit_file
from kinefit.errors import ExportError, FileError, ObservationError, TakeError
from kinefit.exporters import write_markers
from kinefit.geometry import se3
from kinefit.simulation import squat_and_wave


@pytest.fixture(scope="module")
def two_people(tmp_path_factory):
    """A C3D of two people with different marker sets in one room."""
    truth = squat_and_wave(rate=30)
    sets = [placement(truth.body, name).points for name in ("CMU_41", "PIG")]
    names = [f"{who}:{n}" for who, points in zip(("Anna", "Bob"), sets, strict=True) for n in points.names]
    x = [truth.positions(points) + (0, 2.0 * i, 0) for i, points in enumerate(sets)]
    path = tmp_path_factory.mktemp("people") / "two.c3d"
    ball = np.ones((len(truth), 1, 3))
    x = np.concatenate([*x, ball], axis=1)
    write_markers(Markers((*names, "Ball:top"), 30.0, x, up="z", first_frame=76), path)
    return path


def test_every_person_has_a_folder(two_people, tmp_path):
    found = fit_file(two_people, out=tmp_path)
    assert list(found) == ["Anna", "Bob"]
    for person, (motion, files) in found.items():
        assert set(files) == set(WRITTEN)
        assert all(path.exists() and path.parent == tmp_path / person for path in files.values())
        assert len(read_motion(files["motion"])) == len(motion) == 60
        assert motion.up == "z"
    away = found["Bob"][0].Ts_world_root[:, :3, 3] - found["Anna"][0].Ts_world_root[:, :3, 3]
    assert np.abs(away - (0, 2, 0)).max() < 0.05
    files = found["Anna"][1]
    worn = read_markers(files["markers"])
    of_motions = found["Anna"][0].times, read_motion(files["motion"]).times
    for times in (*of_motions, worn.times, read_markers(files["trc"]).times):
        np.testing.assert_allclose(times, 2.5 + np.arange(60) / 30, atol=1e-6)  # of the C3D, whose first frame is 76
    assert files["mot"].read_text().partition("endheader\n")[2].splitlines()[1].startswith("2.500000000\t")
    assert files["trc"].read_text().splitlines()[6].startswith("76\t2.500000000\t")
    model = found["Anna"][1]["osim"].read_text()
    assert "RFWT" in worn.names and all(f'<Marker name="{n}">' in model for n in worn.names)
    assert np.nanmin(worn.positions[..., 1]) > -0.1  # OpenSim's world: y is up
    assert np.nanmax(worn.positions[..., 1]) < 2.2


def test_what_cannot_be_done_is_told_first(two_people, tmp_path):
    with pytest.raises(ExportError, match="no format 'xyz'"):
        fit_file(two_people, out=tmp_path, formats=["xyz"])
    with pytest.raises(FileError, match="no such file"):
        fit_file(tmp_path / "none.c3d")
    assert not list(tmp_path.iterdir())


def test_one_mass_is_of_one_person(two_people, tmp_path):
    with pytest.raises(ObservationError, match="one mass for 2 people: Anna, Bob"):
        fit_file(two_people, tmp_path, MarkerFitOptions(mass=60.0))
    assert not list(tmp_path.iterdir())
    write_markers(squat(10)[0], tmp_path / "child.trc")
    run("markers", "fit", tmp_path / "child.trc", "--mass", 32, "--formats", "motion,osim")
    assert read_motion(tmp_path / "child-kinefit").body.mass == 32.0
    text = (tmp_path / "child-kinefit" / "body.osim").read_text()
    assert sum(map(float, re.findall("<mass>(.*?)</mass>", text))) == pytest.approx(32.0)


@pytest.mark.parametrize(
    ("named", "spelled"),
    [(str, "r_knee"), (lambda n: f"Anna:{n.upper()}", "R_KNEE"), (lambda n: n.replace("_", " "), "r_knee")],
)
def test_opensim_finds_every_marker_at_its_fitted_place(tmp_path, named, spelled):
    """Also markers whose labels are names of landmarks (r_knee, the joint's centre), and labels in other spellings."""
    truth = squat_and_wave(rate=10)
    points = placement(truth.body, "STANFORD_47").points
    away = np.random.default_rng(0).normal(scale=0.01, size=(len(points), 3))
    x = truth.positions(PointSet(points.names, points.segments, points.points + away))
    path = tmp_path / "take.trc"
    write_markers(Markers(tuple(map(named, points.names)), 10.0, x, up="z"), path)
    ((motion, files),) = fit_file(path, out=tmp_path / "out", formats=("mot", "osim", "markers", "trc")).values()
    model, poses = poses_by_opensim(files["osim"], read_mot(files["mot"]))
    measured, landmarks = read_markers(files["markers"]), read_markers(files["trc"])
    markers = {}
    for marker in model.findall("MarkerSet/objects/Marker"):
        T = poses[marker.find("socket_parent_frame").text.removeprefix("/bodyset/")]
        markers[marker.get("name")] = se3.apply(T, np.array(marker.find("location").text.split(), float))
    assert spelled in markers and set(measured.names) <= set(markers)
    off = np.stack([markers[n] for n in measured.names], axis=1) - measured.positions
    own = motion.residuals["markers"]
    np.testing.assert_allclose(np.sqrt(np.mean(off**2)), np.sqrt(np.mean(own.values**2)), atol=1e-6)
    assert np.linalg.norm(off, axis=2).max() < 0.04
    for name, track in zip(landmarks.names, np.moveaxis(landmarks.positions, 1, 0), strict=True):
        np.testing.assert_allclose(markers[name], track, atol=1e-5)


def run(*args):
    told = CliRunner().invoke(main, [str(arg) for arg in args])
    assert told.exit_code == 0, told.output
    assert "Warning" not in told.output
    return " ".join(told.output.split())


def squat(frames=40, keep=lambda name: True):
    """Some markers of a squat, z up, and its truth."""
    truth = squat_and_wave(rate=30)
    points = placement(truth.body, "CMU_41").points
    points = points.select(tuple(name for name in points.names if keep(name)))
    return Markers(points.names, 30.0, truth.positions(points)[:frames], up="z"), truth


def test_markers_alone_pass_every_door_and_empty_ends_are_left_out(tmp_path):
    markers, _ = squat(30)
    x = np.full((50, len(markers.names), 3), np.nan)
    x[10:40] = markers.positions
    write_markers(Markers(markers.names, 30.0, x, up=None), tmp_path / "walk.trc")
    told = run("init", tmp_path)
    assert "needs cameras" not in told and read_take(tmp_path).up == "z"
    assert "No fault" in run("check", tmp_path)
    told = run("track", tmp_path, "--no-overlays", "--no-report", "--formats", "motion")
    assert "note: no markers in the first 10 and last 10 of 50 frames: left out" in told
    told = run("markers", "fit", tmp_path / "walk.trc")
    assert "no markers in the first 10 and last 10 of 50 frames: left out." in told
    tracked, fitted = (read_motion(tmp_path / name) for name in ("take-kinefit", "walk-kinefit"))
    assert len(tracked) == len(fitted) == 30
    np.testing.assert_allclose(tracked.times, fitted.times, atol=1e-6)
    page = (tmp_path / "walk-kinefit" / "report.html").read_text()
    assert "left out" in page and "tables" in page and "markers as measured" in page


def test_parts_without_markers_are_not_observed_and_not_doubtful(tmp_path):
    legs = ("WT", "KNE", "ANK", "HEE", "TOE", "MT", "THI", "SHN", "LEG")
    write_markers(squat(30, lambda name: any(word in name for word in legs))[0], tmp_path / "legs.c3d")
    told = run("markers", "fit", tmp_path / "legs.c3d", "--formats", "motion,report")
    assert "not observed, as they have no markers: abdomen, thorax, head" in told
    assert "doubtful moments: none" in told and "lost" not in told
    page = (tmp_path / "legs-kinefit" / "report.html").read_text()
    assert "Not observed, as they have no markers: abdomen, thorax" in page and "None: no end of a segment" in page
    assert 'class="callout bad"' not in page


def test_a_take_names_a_static_trial(tmp_path):
    """Its lengths count, with markers that the moving trial lacks; nothing ignores it in silence."""
    whole, truth = squat(60)
    shown = [i for i, name in enumerate(whole.names) if "WRA" not in name]
    moving = Markers(tuple(whole.names[i] for i in shown), 30.0, whole.positions[30:, shown], up="z")
    static = Markers(whole.names, 30.0, whole.positions[:10], up="z")
    write_markers(moving, tmp_path / "squat.trc")
    write_markers(static, tmp_path / "static.trc")
    run("init", tmp_path)
    assert read_take(tmp_path).markers[0].static == tmp_path / "static.trc"
    run("track", tmp_path, "--no-overlays", "--no-report", "--formats", "motion")
    run("markers", "fit", tmp_path / "squat.trc", "--static", tmp_path / "static.trc", "--formats", "motion")
    motions = [read_motion(tmp_path / name) for name in ("take-kinefit", "squat-kinefit")]
    frames = [motion.provenance["markers"]["frames"] for motion in motions]
    assert frames[0] == frames[1] > 30  # of both trials
    lengths = [np.linalg.norm(motion.body.tree.offsets, axis=1) for motion in motions]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=2e-3)
    np.testing.assert_allclose(lengths[0], np.linalg.norm(truth.body.tree.offsets, axis=1), atol=0.03)

    exchanged = Markers(tuple({"L": "R", "R": "L"}.get(n[0], n[0]) + n[1:] for n in whole.names), 30.0,
                        whole.positions[:30], up="z")  # fmt: skip
    write_markers(exchanged, tmp_path / "static.trc")
    told = CliRunner().invoke(main, ["track", str(tmp_path), "--no-overlays", "--no-report"])
    assert told.exit_code == 2 and "static.trc" in told.output and "exchanged" in told.output
    text = (tmp_path / "take.toml").read_text()
    (tmp_path / "take.toml").write_text(text.replace("[take]\n", "[take]\nsize = false\n"))
    with pytest.raises(TakeError, match="'static' has no use here"):
        read_take(tmp_path)
