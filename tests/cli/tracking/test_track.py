"""`kinefit track`, whole: results, bad takes, a full disk, Ctrl-C."""

import json
import os
import re
import signal
import subprocess
import sys
from importlib import resources

import numpy as np
import pytest
from click.testing import CliRunner
from tests.cli.stopping import STOPPABLE

import kinefit
from kinefit.cli import main
from kinefit.cli._summary import bone_lengths
from kinefit.errors import ObservationError
from kinefit.exporters.report.moments import doubt_sentence, doubtful_moments, when
from kinefit.findings import frame_ranges
from kinefit.fitting.tracking.checkpoints.checkpoint import TrackingInterrupted
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track
from kinefit.readers.videos.video import Video
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig
from kinefit.takes.batch.results import DEFAULT_FORMATS, FORMATS
from kinefit.takes.preparing import faces

HUMANOID = (resources.files("kinefit.bodies.toml") / "catalogue" / "humanoid.toml").read_text(encoding="utf-8")


def run(*args):
    return CliRunner().invoke(main, [str(arg) for arg in args])


def test_a_take_becomes_a_folder_of_results(take):
    told = run("track", take, "-v")
    assert told.exit_code == 0, told.output
    out = take.with_name("take-kinefit")
    overlays = {f"overlays/cam0{c}.mp4" for c in (1, 2, 3, 4)}
    tables = {f"tables/{name}.csv" for name in ("angles", "joints", "landmarks", "quality", "residuals")}
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    single = {FORMATS.get(name).file for name in DEFAULT_FORMATS if name != "csv"} | {"montage.png", "report.html"}
    assert files == single | tables | overlays
    motion = kinefit.read_motion(out / "motion.npz")
    assert len(motion) == 60
    for camera in motion.residuals:
        with Video(out / "overlays" / f"{camera}.mp4") as video:
            assert (len(video), video.size, video.rate) == (60, (544, 960), 30)
    assert "squat_and_wave: 60 frames at 30 Hz (2.00 s)" in told.stdout
    for camera, residuals in motion.residuals.items():
        median = np.nanmedian(residuals.norms)
        assert re.search(rf"^{camera} +{median:.1f} px .* {residuals.swapped.sum()} frames", told.stdout, re.M)
    assert "left_foot_index" in told.stdout  # -v
    assert all(str(out / FORMATS.get(name).file) in told.stdout for name in DEFAULT_FORMATS)


def test_faults_of_the_inputs_stand_on_top_of_summary_and_report(take, tmp_path, change):
    change(take, "[take]\n", "[take]\nframes = [0, 12]\n")
    calibration = take.parent / "calibration.toml"
    text = re.sub(
        r"translation = \[(.*?)\]",
        lambda m: f"translation = [{', '.join(str(1.8 * float(v)) for v in m[1].split(','))}]", calibration.read_text(),
    )  # fmt: skip
    calibration.write_text(text)
    out = tmp_path / "out"
    told = run("track", take, "--no-overlays", "--pictures", "none", "--formats", "motion", "--realtime", "--out", out)
    assert told.exit_code == 0, told.output
    first, how, remedy = told.stdout.strip().splitlines()[:3]
    assert re.match(r"fault: The person would be 3\.\d+ m tall: the calibration's unit or scale is wrong\.", first)
    assert how.startswith("   confidence: ")
    assert "size of the board's squares" in remedy
    assert told.stdout.index("fault: ") < told.stdout.index("median residual")
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.index("Faults of the inputs") < page.index("the calibration&#x27;s unit or scale is wrong")
    assert page.index("the calibration&#x27;s unit or scale is wrong") < page.index("In short")
    assert kinefit.read_motion(out / "motion.npz").provenance["findings"][0]["kind"] == "scale"


def test_a_camera_that_is_out_of_step_is_noted_with_the_line_to_write(take, tmp_path, change):
    change(take, 'name = "cam03"\n', 'name = "cam03"\ntime_offset = 0.06\n')
    told = run("track", take, "--no-overlays", "--no-report", "--formats", "motion", "--realtime", "--out", tmp_path)
    assert told.exit_code == 0, told.output
    printed = " ".join((told.stdout + told.stderr).split())
    note = r"note: cam03 is 1\.\d+ ± 0\.\d+ frames \(\d+ ms\) earlier .* Write time_offset = (\S+) into"
    found = re.search(note, printed)
    assert found and abs(float(found[1])) < 0.01


def test_only_what_is_asked_for_is_written(take, tmp_path):
    told = run("track", take, "--no-overlays", "--no-report", "--formats", "bvh, trc", "--out", tmp_path / "there")
    assert told.exit_code == 0
    assert {path.name for path in (tmp_path / "there").iterdir()} == {"motion.bvh", "motion.trc"}


def test_programs_get_one_json_object_and_quiet_prints_nothing(take, tmp_path, change):
    change(take, "[take]\n", "[take]\nframes = [0, 8]\n")
    done = run("track", take, "--json", "--formats", "csv", "--no-overlays", "--no-report", "-o", tmp_path / "out")
    result = json.loads(done.stdout)
    (person,) = result["people"]
    assert (done.exit_code, result["exit_code"], person["frames"]) == (0, 0, 8) and not done.stderr
    assert set(person["residuals"]) == {f"cam0{c}" for c in (1, 2, 3, 4)}
    assert person["files"]["csv"] == str(tmp_path / "out" / "tables") and not person["findings"]
    quiet = run("track", take, "-q", "--formats", "csv", "--no-overlays", "--no-report", "-o", tmp_path / "out")
    assert (quiet.exit_code, quiet.output) == (0, "")
    missing = run("track", tmp_path / "nowhere.toml", "--json")
    assert missing.exit_code == 2 and not missing.stdout and "no such take file" in missing.stderr


def test_in_real_time_nothing_is_smoothed_and_contacts_need_the_whole_take(take, tmp_path):
    told = run("track", take, "--no-overlays", "--no-report", "--realtime", "--formats", "motion", "--out", tmp_path)
    assert told.exit_code == 0
    motion = kinefit.read_motion(tmp_path / "motion.npz")
    assert "smoothing" not in motion.provenance and motion.provenance["detector noise"]
    refused = run("track", take, "--realtime", "--contacts")
    assert refused.exit_code == 2 and "--contacts needs the whole take" in refused.stderr


def test_a_lag_knows_a_little_of_what_comes_and_stands_alone(take, tmp_path):
    quiet = "--no-overlays", "--no-report", "--formats", "motion", "--out", tmp_path
    told = run("track", take, *quiet, "--lag", "0.1")
    assert told.exit_code == 0
    motion = kinefit.read_motion(tmp_path / "motion.npz")
    assert motion.provenance["estimate"] == "fixed lag" and motion.provenance["fixed lag"]["seconds"] == 0.1
    for other in ("--realtime", "--contacts"):
        refused = run("track", take, "--lag", "0.1", other)
        assert refused.exit_code == 2 and other in refused.stderr and "--lag SECONDS" in refused.stderr
    long = run("track", take, *quiet, "--lag", "5")
    assert long.exit_code == 2 and "longer than the take of 60 frames" in long.stderr


def test_an_unknown_format_is_told_before_anything_is_read():
    told = run("track", "none.toml", "--formats", "bvh,dae")
    assert told.exit_code == 2
    assert "no format 'dae'; there are: motion, csv, parquet, bvh" in told.stderr


def cut_video(take, share):
    path = take.with_name("cam02.mp4")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def landmarks(take, edit):
    path = take.with_name("mediapipe_cam02.npy")
    np.save(path, edit(np.load(path)))


def with_nan(array):
    array[3, 4, 0] = np.nan
    return array


def own_body(take, old, new):
    assert old in HUMANOID
    take.with_name("mine.toml").write_text(HUMANOID.replace(old, new))
    take.write_text(take.read_text().replace('body = "humanoid"', 'body = "mine.toml"'))


def swap(take, name, old, new):
    path = take.with_name(name)
    assert re.search(old, path.read_text(), re.M)
    path.write_text(re.sub(old, new, path.read_text(), flags=re.M))


def millimetres(match):
    return "translation = [" + ", ".join(f"{1000 * float(v):.3f}" for v in match[1].split(",")) + "]"


BAD = {
    "missing video": (lambda t: t.with_name("cam02.mp4").unlink(), "camera cam02, video", "no such file"),
    "truncated video": (lambda t: cut_video(t, 0.7), "cam02.mp4", "video"),
    "no calibration": (lambda t: swap(t, "calibration.toml", "cam03", "other"), "calibration.toml", "'cam03'"),
    "millimetres": (
        lambda t: [swap(t, "calibration.toml", 'unit = "m"', ""),
                   swap(t, "calibration.toml", r"^translation = \[(.*)\]", millimetres)],
        "camera cam01", "cannot be metres",
    ),
    "image size": (
        lambda t: swap(t, "calibration.toml", "^size = .*", "size = [1280.0, 720.0]"), "camera cam01", "544x960",
    ),
    "rates": (lambda t: swap(t, "take.toml", "^rate = .*", "rate = 35.0"), "take.toml", "take 35 Hz, video cam01 30"),
    "lengths": (lambda t: landmarks(t, lambda a: a[:-7]), "take.toml", "keypoints cam02 53 frames"),
    "nan": (lambda t: landmarks(t, with_nan), "frame 3", "right_eye_inner"),
    "nobody": (lambda t: landmarks(t, np.zeros_like), "mediapipe_cam02.npy", "no person is detected"),
    "unknown sensor": (lambda t: swap(t, "take.toml", r"\Z", "\n[[lidar]]\nx = 1\n"), "[lidar]", "keypoints, markers"),
    "unknown camera": (lambda t: swap(t, "take.toml", '^camera = "cam04"', 'camera = "cam7"'), "take.toml", "'cam7'"),
    "empty": (lambda t: t.write_text(""), "take.toml", "names no sensor"),
    "not toml": (lambda t: t.write_text("rate = = 3"), "take.toml", "not TOML"),
    "missing take": (lambda t: t.unlink(), "take.toml", "no such take file"),
    "body with a cycle": (
        lambda t: own_body(t, 'parent = "pelvis"\njoint = { name = "back"', 'parent = "head"\njoint = { name = "back"'),
        "mine.toml", "cycle",
    ),
    "unknown parent": (lambda t: own_body(t, 'parent = "thorax"', 'parent = "thorx"'), "segment head", "'thorx'"),
    "zero axis": (lambda t: own_body(t, 'axes = ["-z"]', "axes = [[0.0, 0.0, 0.0]]"), "joint knee_r", "no direction"),
    "unknown body": (lambda t: swap(t, "take.toml", "^body = .*", 'body = "human"'), "", "humanoid10"),
    "one camera": (
        lambda t: swap(t, "take.toml", r'\[\[keypoints\]\]\ncamera = "cam0[234]"\n(.+\n)+', ""), "", "two cameras",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_told_and_nothing_is_written(case, take, tmp_path):
    damage, place, problem = BAD[case]
    damage(take)
    told = run("track", take, "--out", tmp_path / "out")
    assert told.exit_code == 2, told.output
    message = told.stderr[told.stderr.index("error: ") :]
    assert place in message
    assert problem in message
    assert "Traceback" not in message
    assert told.stdout == ""
    assert not (tmp_path / "out").exists()


@pytest.fixture
def openpose_take(tmp_path, data_dir):
    """Twelve frames of the real recording, with json files that may be damaged."""
    recording = data_dir("video_balancing_4cam")
    text = f'[take]\nrate = 60.0\n[calibration]\nfile = "{(recording / "Calib_refined_static.toml").as_posix()}"\n'
    for name in ("cam01", "cam02", "cam03", "cam04"):
        (tmp_path / name).mkdir()
        for path in sorted((recording / "openpose_json" / name).glob("*.json"))[:12]:
            (tmp_path / name / path.name).write_bytes(path.read_bytes())
        text += f'[[camera]]\nname = "{name}"\n[[keypoints]]\ncamera = "{name}"\nfile = "{name}"\n'
    (tmp_path / "take.toml").write_text(text)
    return tmp_path / "take.toml"


def people(take, camera, edit):
    """Change the list of people in the json files of a camera: edit(frame, people) -> people."""
    for frame, path in enumerate(sorted((take.parent / camera).glob("*.json"))):
        content = json.loads(path.read_text())
        content["people"] = edit(frame, content["people"])
        path.write_text(json.dumps(content))


def test_json_without_anybody_is_told(openpose_take):
    people(openpose_take, "cam02", lambda frame, there: [])
    told = run("track", openpose_take)
    assert told.exit_code == 2
    assert "no person is detected in any of the 12 frames of camera cam02" in told.stderr
    assert not openpose_take.with_name("take-kinefit").exists()


def test_json_with_nan_is_told(openpose_take):
    def edit(frame, there):
        if frame == 5:
            there[0]["pose_keypoints_2d"][7] = float("nan")
        return there

    people(openpose_take, "cam03", edit)
    told = run("track", openpose_take)
    assert told.exit_code == 2
    assert "NaN" in told.stderr
    assert re.search(r"at .*cam03.*5.*\.json", told.stderr)


def test_frames_without_anybody_and_bystanders_are_no_error(openpose_take):
    def edit(frame, there):
        person = there[0]
        other = [300 + 0.3 * v if k % 3 < 2 and v else v for k, v in enumerate(person["pose_keypoints_2d"])]
        return [] if frame == 6 else [{**person, "pose_keypoints_2d": other}, person]

    assert run("track", openpose_take, "--formats", "motion", "--out", openpose_take.with_name("plain")).exit_code == 0
    people(openpose_take, "cam01", edit)
    told = run("track", openpose_take, "--formats", "motion")
    assert told.exit_code == 0, told.output
    crowded, plain = (kinefit.read_motion(openpose_take.with_name(n) / "motion.npz") for n in ("take-kinefit", "plain"))
    gap = np.linalg.norm(crowded.positions() - plain.positions(), axis=-1)
    assert np.median(gap) < 0.02
    moments = doubtful_moments(crowded)
    report = openpose_take.with_name("take-kinefit").joinpath("report.html").read_text("utf-8")
    assert f"doubtful moments: {doubt_sentence(crowded, moments)}\n" in told.stdout
    assert f"doubtful moments: {doubt_sentence(crowded, moments)}." in report or not moments
    assert all(when(crowded, m) in told.stdout for m in moments[:5])


def test_with_v_a_failed_track_shows_which_cameras_agree(take):
    def scramble(array):
        array[..., :2] = np.random.default_rng(0).uniform(0, 500, array[..., :2].shape)
        return array

    for path in take.parent.glob("*.npy"):
        np.save(path, scramble(np.load(path)))
    told = run("track", take, "-v")
    assert told.exit_code == 2
    assert re.search(r"^cam01 - cam02 +\d+\.\d px", told.stdout, re.M)


def test_a_folder_in_whose_place_a_file_stands_is_told_at_once(take, tmp_path):
    (tmp_path / "out").write_text("mine")
    told = run("track", take, "--out", tmp_path / "out")
    assert told.exit_code == 2
    assert "in the way" in told.stderr
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit of file sizes")
def test_a_full_disk_leaves_only_whole_files(take, tmp_path):
    code = (
        "import resource, sys; from kinefit.cli import main\n"
        "import kinefit.takes.batch.results as r; write = r.write_overlays\n"
        "def limited(*a, **k):\n    resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000)); write(*a, **k)\n"
        "r.write_overlays = limited; main()"
    )
    out = tmp_path / "out"
    args = [sys.executable, "-c", code, "track", str(take), "--out", str(out), "--formats", "motion,bvh"]
    done = subprocess.run(args, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert "cannot be written" in done.stderr
    assert "overlays" in done.stderr
    assert not list((out / "overlays").iterdir())
    assert {path.name for path in out.iterdir()} == {"motion.npz", "motion.bvh", "overlays", "unfinished"}
    assert str(out / "motion.bvh") in done.stdout
    assert len(kinefit.read_motion(out / "motion.npz")) == 60


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_ctrl_c_keeps_the_frames_that_are_done(take, tmp_path):
    import pty

    take.write_text(re.sub("^video = .*\n", "", take.read_text(), flags=re.M))
    for path in take.parent.glob("*.npy"):
        np.save(path, np.tile(np.load(path), (200, 1, 1)))
    out = tmp_path / "out"
    ours, theirs = pty.openpty()  # a terminal, on which progress is shown while it happens
    command = STOPPABLE + "from kinefit.cli import main; main()"
    args = [sys.executable, "-c", command, "track", str(take), "--out", str(out)]
    environment = {**os.environ, "TERM": "xterm", "NO_COLOR": "1"}
    process = subprocess.Popen(args, stdout=subprocess.DEVNULL, stderr=theirs, env=environment)
    os.close(theirs)
    shown, sent = "", False
    while True:
        try:
            shown += os.read(ours, 65536).decode()
        except OSError:  # the other end is closed
            break
        if not sent and re.search(r"frames .* [1-9]\d*/12000", shown):
            process.send_signal(signal.SIGINT)
            sent = True
    os.close(ours)
    assert process.wait() == 130, shown
    done = int(re.search(r"Stopped\. (\d+) of 12000 frames are tracked and written", shown)[1])
    motion = kinefit.read_motion(out / "motion.npz")
    assert len(motion) == done
    assert 0 < done < 12000
    assert all(len(r.values) == done for r in motion.residuals.values())
    assert (out / "tables" / "angles.csv").read_text().count("\n") == done + 1
    assert not list(out.rglob(".*"))


def test_ctrl_c_gives_a_script_the_frames_that_are_done():
    motion = cut(squat_and_wave(), 0, 12)
    rig = studio_rig(motion)
    recording = Recording.of_keypoints(rig, simulate_keypoints(motion, rig), up=motion.up)

    def stop_at(frames):
        def progress(what, done, total):
            if what == "frames" and done == frames:
                raise KeyboardInterrupt

        return progress

    whole = track(recording, motion.body, smooth=False)
    with pytest.raises(TrackingInterrupted) as stopped:
        track(recording, motion.body, progress=stop_at(5))
    part = stopped.value.motion
    assert (len(part), stopped.value.total) == (5, 12)
    assert np.array_equal(part.angles, whole.angles[:5])
    assert np.array_equal(part.times, whole.times[:5])


def test_ctrl_c_before_the_first_frame_is_only_that(monkeypatch):
    motion = cut(squat_and_wave(), 0, 3)
    rig = studio_rig(motion)

    def interrupted(*args, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("kinefit.fitting.tracking.tracker.Tracker.update", interrupted)
    with pytest.raises(KeyboardInterrupt) as stopped:
        track(Recording.of_keypoints(rig, simulate_keypoints(motion, rig), up=motion.up), motion.body)
    assert not isinstance(stopped.value, TrackingInterrupted)


def test_ctrl_c_during_overlays_lists_what_is_whole(take, tmp_path, monkeypatch):
    def interrupted(*args, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("kinefit.takes.batch.results.write_overlays", interrupted)
    told = run("track", take, "--out", tmp_path / "out", "--formats", "bvh")
    assert told.exit_code == 130
    assert str(tmp_path / "out" / "motion.bvh") in told.stdout
    assert "The files listed are complete" in told.stderr


def test_frames_are_told_as_stretches():
    assert frame_ranges(np.array([3, 7, 8, 9])) == "3, 7-9"
    assert frame_ranges(np.arange(0, 60, 2)).endswith("22 and 18 more stretches")


def test_bone_lengths_tell_left_and_right_once():
    lengths = bone_lengths(type("Motion", (), {"body": kinefit.load_body("humanoid")}))
    assert lengths["hip to knee"] == "42.0"
    assert len(lengths) == 11


def test_pictures_without_faces_or_none_at_all(take, tmp_path, monkeypatch):
    def absent(*_):
        raise ObservationError("no networks here", remedy="Fetch them.")

    told = run("track", take, "--out", tmp_path / "none", "--formats", "bvh", "--pictures", "none")
    assert told.exit_code == 0, told.stderr
    monkeypatch.setattr(faces, "networks", absent)
    told = run("track", take, "--out", tmp_path / "blurred", "--formats", "bvh", "--pictures", "blurred")
    assert told.exit_code == 2 and "use --hide-faces" in told.stderr and "no networks here" in told.stderr
    assert not (tmp_path / "blurred" / "montage.png").exists()
    assert not (tmp_path / "none" / "montage.png").exists() and not (tmp_path / "none" / "overlays").exists()
    assert "<img" not in (tmp_path / "none" / "report.html").read_text()
    told = run("track", take, "--out", tmp_path / "c", "--pictures", "none", "--overlays")
    assert told.exit_code == 2 and "give one of them" in told.stderr


def test_the_session_of_a_take_heads_its_report(take, tmp_path):
    table = tmp_path / "norms.csv"
    table.write_text("coordinate,percent,mean,sd\nknee_angle,0,5,4\nknee_angle,100,6,4\n")
    text = take.read_text()
    session = f"subject = 'P07'\ndate = 2026-03-02\nside = 'left'\nnorms = '{table.as_posix()}'\n"
    take.write_text(f"{text}\n[session]\n{session}")
    told = run("track", take, "--out", tmp_path / "out", "--formats", "motion", "--no-overlays")
    assert told.exit_code == 0, told.stderr
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<dt>Subject</dt><dd>P07</dd>" in page and "<dt>Date of the recording</dt><dd>2026-03-02</dd>" in page
    assert kinefit.read_motion(tmp_path / "out" / "motion.npz").provenance["session"]["side"] == "left"
    take.write_text(f"{text}\n[session]\nside = 'port'\n")
    told = run("track", take, "--out", tmp_path / "bad")
    assert told.exit_code == 2 and "[session] side" in told.stderr and "'left'" in told.stderr
