"""`kinefit check`, whole: the page, the refined calibration beside the old one, bad takes."""

import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.bodies import load_body
from kinefit.cli.checks._refine import free_name
from kinefit.cli.checks.check import check
from kinefit.errors import ExportError, KinefitError, TakeError
from kinefit.exporters.c3d_file import write_markers
from kinefit.findings import Edit, Finding
from kinefit.geometry import se3
from kinefit.observations import Markers
from kinefit.readers.calibration.read import read_calibration, write_calibration
from kinefit.readers.take.file import read_take
from kinefit.rigs.diagnostics.checks import Checked
from kinefit.simulation import known_motion, movement, simulate_keypoints, studio_rig
from kinefit.takes import check as checking
from kinefit.takes.batch.corrections import undo


def run(*args):
    return CliRunner().invoke(check, [str(arg) for arg in args])


def swap(path, old, new, count=0):
    assert re.search(old, path.read_text(), re.M)
    path.write_text(re.sub(old, new, path.read_text(), count=count, flags=re.M))


def landmarks(take, camera, edit):
    path = take.with_name(f"mediapipe_{camera}.npy")
    np.save(path, edit(np.load(path)))


def late(take, camera, frames):
    landmarks(take, camera, lambda a: np.concatenate([a[frames:], np.repeat(a[-1:], frames, axis=0)]))


def exchange(take, a, b):
    one, other = (take.with_name(f"mediapipe_{name}.npy") for name in (a, b))
    first, second = np.load(one), np.load(other)
    np.save(one, second)
    np.save(other, first)


def test_a_good_take_has_no_fault_and_gets_a_page(take):
    told = run(take, "--strict")
    assert told.exit_code == 0, told.output
    assert "No fault and no doubt." in told.stdout
    page = take.with_name("take-check.html").read_text("utf-8")
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", page)
    assert page.count("data:image/jpeg;base64,") == 8  # of each camera the points and the map
    assert all(name in page for name in ("cam01", "cam02", "cam03", "cam04"))
    assert not re.search(r">[^<]*\bnan\b", re.sub(r"<script.*?</script>", "", page, flags=re.S), re.I)


def cut_calibration(take):
    path = take.with_name("calibration.toml")
    path.write_text(re.sub(r"(?ms)^\[cam03\].*?(?=^\[)", "", path.read_text()))


def without_video(take):
    path = take.with_name("cam02.mp4")
    path.write_bytes(path.read_bytes()[:2000])


BAD = {
    "exchanged": (lambda t: exchange(t, "cam01", "cam03"), "cam01 and cam03 are swapped", "rename cam01 to cam03"),
    "five frames": (lambda t: late(t, "cam02", 5), r"cam02 is (4\.9|5\.0)\d .* later", "time_offset = 0.1"),
    "upside down": (lambda t: swap(t, 'up = "z"', 'up = "-z"'), "the floor would be the ceiling", 'up = "z"'),
    "size": (
        lambda t: swap(t.with_name("calibration.toml"), "^size = .*", "size = [1088.0, 1920.0]", count=1),
        "cam01 has another size", 'image = "scaled"',
    ),
    "lengths": (
        lambda t: landmarks(t, "cam02", lambda a: a[:-7]),
        "streams of different length", "frames = [0, 53]",
    ),
    "not calibrated": (cut_calibration, "cam03 is not in the calibration", "Correct its name"),
    "broken video": (without_video, "cam02.mp4", "re-encode"),
    "nobody": (
        lambda t: landmarks(t, "cam02", np.zeros_like),
        "no person is detected", "detector",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_take_is_told_in_words_and_the_rest_is_checked(case, take):
    damage, words, remedy = BAD[case]
    damage(take)
    told = run(take, "--strict")
    assert told.exit_code == 2, told.output
    assert re.search(f"fault: .*{words}", told.stdout)
    assert remedy in told.stdout
    assert take.with_name("take-check.html").exists()


def test_a_calibration_that_cannot_be_read_is_a_finding(take):
    take.with_name("calibration.toml").write_text("nothing")
    told = run(take)
    assert told.exit_code == 0
    assert "fault: " in told.stdout
    assert "not a calibration" in told.stdout


def test_no_take_is_an_error_and_writes_nothing(tmp_path):
    told = run(tmp_path / "none.toml")
    assert isinstance(told.exception, KinefitError)
    assert not list(tmp_path.iterdir())


def test_what_belongs_to_refining_is_refused_without_it(take):
    told = run(take, "--focal")
    assert told.exit_code == 2
    assert "--refine" in told.output


def test_refining_is_refused_before_gross_faults_are_fixed(take):
    exchange(take, "cam01", "cam03")
    told = run(take, "--refine")
    assert isinstance(told.exception, KinefitError)
    assert "needs a recording without faults" in str(told.exception)
    assert take.with_name("take-check.html").exists()
    assert not take.with_name("calibration_refined.toml").exists()


@pytest.mark.slow
def test_a_turned_camera_is_refined_beside_the_old_calibration(take):
    path = take.with_name("calibration.toml")
    text = path.read_text()
    pattern = r"(?ms)(^\[cam02\].*?^rotation = \[)([^,]*)"
    path.write_text(re.sub(pattern, lambda m: f"{m[1]}{float(m[2]) + 0.01}", text, count=1))
    before = path.read_bytes()
    told = run(take, "--refine")
    assert told.exit_code == 0, told.output
    assert path.read_bytes() == before
    assert 'with file = "calibration_refined.toml" in [calibration]' in told.stdout
    old, new = read_calibration(path), read_calibration(take.with_name("calibration_refined.toml"))
    assert new.names == old.names
    copy = take.with_name("take_refined.toml")
    assert read_take(copy).calibration.file.name == "calibration_refined.toml"
    assert "No fault and no doubt." in run(copy).stdout


def test_a_refined_calibration_never_takes_a_name_that_is_there(tmp_path):
    old = tmp_path / "Calib.qca.txt"
    for name in ("Calib.qca.txt", "Calib_refined.qca.txt"):
        (tmp_path / name).touch()
    assert free_name(old).name == "Calib_refined2.qca.txt"
    assert free_name(tmp_path).name == f"{tmp_path.name}_refined"


def walker():
    """Two cameras that see a person walk a metre and turn, 45 markers."""
    steps = movement("walk", load_body("humanoid"), rate=15.0, speed=2.0)
    T, u = np.array(steps.Ts_world_root), np.linspace(0.0, 1.0, len(steps))
    T[:, :3, :3] = se3.exp_so3(np.outer(np.pi * u, (0.0, 1.0, 0.0))) @ T[:, :3, :3]
    motion = known_motion(steps.body, steps.rate, T, steps.angles, up="y")
    points = motion.body.markers("HANIM_45")
    return motion, Markers(points.names, motion.rate, motion.positions(points), up="y", unit="m")


def test_a_marker_system_that_does_not_fit_the_videos_is_named_and_moved(tmp_path):
    motion, markers = walker()
    rig = studio_rig(motion, cameras=2)
    for seen in simulate_keypoints(motion, rig, "MEDIAPIPE_33", noise_px=2.0, outliers=0.0, missing=0.0):
        values = np.concatenate([seen.points[:, 0], seen.confidence[:, 0, :, None]], axis=-1)
        np.save(tmp_path / f"mediapipe_{seen.camera}.npy", np.nan_to_num(values))
    write_calibration(rig, tmp_path / "calibration.toml")
    wrong = se3.transform(se3.exp_so3(np.radians([0.0, 2.0, 0.0])), np.array([0.03, 0.0, 0.0]))
    write_markers(replace(markers, positions=se3.apply(wrong, markers.positions)), tmp_path / "markers.trc")
    names = "".join(f'[[camera]]\nname = "{c}"\n' for c in rig.names)
    table = '[[keypoints]]\ncamera = "{0}"\nfile = "mediapipe_{0}.npy"\nformat = "mediapipe"\n'
    head = '[take]\nrate = 15.0\nup = "y"\n[calibration]\nfile = "calibration.toml"\n'
    take = tmp_path / "take.toml"
    take.write_text(head + names + "".join(map(table.format, rig.names)) + '[[markers]]\nfile = "markers.trc"\n')
    told = run(take, "--refine", "--strict")
    assert told.exit_code == 2, told.output
    assert re.search(r"fault: markers does not fit the videos: its frame is off by (1\.[89]|2\.[01])", told.stdout)
    assert not tmp_path.joinpath("calibration_refined.toml").exists()  # the videos' cameras stay
    left = read_take(tmp_path / "take_refined.toml").markers[0].T_world_file @ wrong
    assert np.degrees(np.linalg.norm(se3.log_so3(left[:3, :3]))) < 0.2
    middle = markers.positions.mean(axis=(0, 1))
    assert np.linalg.norm(se3.apply(left, middle) - middle) < 0.005


FIXED = {
    "five frames": ("time_offset = 0.1", lambda t: read_take(t).cameras[1].time_offset > 0.15),
    "upside down": ('up = "z" in [take]', lambda t: read_take(t).up == "z"),
    "lengths": ("frames = [0, 53] in [take]", lambda t: read_take(t).frames == (0, 53)),
    "late, with stated frames": ("frames = [5, 60] in [take]", lambda t: read_take(t).frames == (5, 60)),
    "exchanged": ('name = "cam03"', lambda t: [c.name for c in read_take(t).cameras][::2] == ["cam03", "cam01"]),
}  # fmt: skip


@pytest.mark.parametrize("case", FIXED)
def test_fix_writes_the_lines_of_the_findings_and_checks_again(case, take):
    BAD["five frames" if "late" in case else case][0](take)
    if "late" in case:  # which leaves no camera what it saw before the late one began
        swap(take, r"^\[take\]", "[take]\nframes = [0, 60]")
    before = take.read_bytes()
    told = run(take, "--fix", "--strict")
    assert told.exit_code == 0, told.output
    words, is_right = FIXED[case]
    assert re.search(f"Written into .*{re.escape(words)}", told.stdout) and is_right(take)
    assert "No fault" in told.stdout and "page" in take.with_name("take-check.html").read_text("utf-8")
    kept = take.with_name("take-before") / "0001.txt"
    assert str(kept) in told.stdout and kept.read_bytes() == before
    while undo(take):
        pass
    assert take.read_bytes() == before


def test_fix_writes_nothing_where_nothing_is_certain_or_the_take_is_read_only(take):
    before = take.read_bytes()
    assert "Nothing is written" in run(take, "--fix").stdout and take.read_bytes() == before
    BAD["upside down"][0](take)
    before = take.read_bytes()
    take.chmod(0o444)
    told = run(take, "--fix")
    assert isinstance(told.exception, ExportError) and "read-only" in str(told.exception)
    assert take.read_bytes() == before and not take.with_name("take-before").exists()
    assert "the floor would be the ceiling" in told.stdout and take.with_name("take-check.html").exists()


def test_fix_refuses_findings_that_contradict_each_other(take, monkeypatch):
    twice = tuple(Finding("fault", "up", "", edits=(Edit("take", "up", f'"{axis}"'),)) for axis in "xy")
    monkeypatch.setattr(checking, "check_take", lambda take, progress, tell: Checked(take.name, twice, take))
    before = take.read_bytes()
    told = run(take, "--fix")
    assert isinstance(told.exception, TakeError) and 'up = "x" and up = "y"' in str(told.exception)
    assert take.read_bytes() == before
