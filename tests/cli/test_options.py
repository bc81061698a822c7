"""Nothing is ignored silently: every option, argument and key acts on every kind of take, or is refused."""

import inspect
import shutil
import warnings
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import load_body, read_motion
from kinefit.bodies.rendering import render_body
from kinefit.cli import main
from kinefit.cli.tracking.track import track as command
from kinefit.errors import KinefitError
from kinefit.exporters import write_markers, write_motion
from kinefit.fitting.smoothing.online.fixed_lag import KnownNoise
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.fitting.tracking.video import track
from kinefit.observations import Markers
from kinefit.readers.take.entries import keys_of
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import cut
from kinefit.simulation.movements import movement, people
from kinefit.simulation.recordings import write_recording
from kinefit.takes.track import track_take

KINDS = ("keypoints", "depth", "silhouettes", "markers")
FRAMES = 6
QUICK = TrackSettings(search=False, smooth_rounds=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, copy_take):
    """One movement as four kinds of takes: four cameras, a depth camera, silhouettes with a start, markers alone."""
    root = tmp_path_factory.mktemp("kinds")
    cameras = copy_take(root / "keypoints")
    cameras.write_text(cameras.read_text().replace("rate = 30.0", f"rate = 30.0\nframes = [0, {FRAMES}]"))
    truth = cut(movement("wave", people()[2].body, rate=10.0), 0, FRAMES)
    seen = write_recording(truth, root / "depth", ("tof", "keypoints"))
    head, _, rest = seen.read_text().partition("[calibration]")
    calibration, depth = rest.partition("[[depth]]")[::2]
    depth = depth.partition("[[camera]]")[0]
    seen_truth = recording_of(read_take(seen), load_observations(read_take(seen)), load_body("humanoid10"))[0]
    write_motion(truth, root / "depth" / "motion.npz")
    started = head + 'start = "motion.npz"\n\n'
    seen.write_text(started + "[calibration]" + calibration + "[[depth]]" + depth)
    shutil.copytree(root / "depth", root / "silhouettes")
    (root / "silhouettes" / "masks").mkdir()
    camera = seen_truth.rig["colour"]
    for i in range(FRAMES):
        drawn = render_body(truth.body, truth.state(i), camera)
        cv2.imwrite(str(root / "silhouettes" / "masks" / f"{i:06d}.png"), np.where(drawn.segment >= 0, 255, 0))
    (root / "silhouettes" / "take.toml").write_text(
        started + "[calibration]" + calibration + '[[camera]]\nname = "colour"\nsize = [640, 480]\n\n[[silhouette]]\n'
        'camera = "colour"\nfile = "masks"\nformat = "masks"\nrate = 10.0\n'
    )
    (root / "markers").mkdir()
    names = tuple(n for n in truth.body.landmarks.names if n in load_body("humanoid10").landmarks.names)
    x = truth.positions(truth.body.landmarks.select(names))
    write_markers(Markers(names, truth.rate, x, up=truth.up), root / "markers" / "all.trc")
    (root / "markers" / "take.toml").write_text(head + '[[markers]]\nfile = "all.trc"\n')
    return root


@pytest.fixture
def take(folder, tmp_path):
    def of(kind, changes=()):
        shutil.copytree(folder / kind, tmp_path / kind, dirs_exist_ok=True)
        path = tmp_path / kind / "take.toml"
        text = path.read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path.write_text(text)
        return path

    return of


def digest(motion):
    """What a motion tells, as bytes; how long anything took is not in it."""
    arrays = [motion.times, motion.Ts_world_root, motion.angles, motion.dof_std, motion.body.tree.offsets]
    arrays += [r.values for r in motion.residuals.values()]
    told = (motion.name, motion.up, motion.rate, motion.body.name, motion.body.mass, tuple(motion.residuals))
    return repr(told).encode() + b"".join(np.round(a, 9).tobytes() for a in arrays)


@pytest.fixture(scope="module")
def usual(folder):
    """What comes of a take as it is, made once."""
    made = {}

    def of(kind, **given):
        key = kind, repr(given)
        if key not in made:
            made[key] = digest(track_take(folder / kind / "take.toml", settings=QUICK, **given)[0])
        return made[key]

    return of


def acts_or_is_refused(make, usual):
    """True where it acts, False where it is refused; a failure where neither."""
    try:
        made = make()
    except KinefitError as error:
        assert len(str(error)) > 20
        return False
    assert digest(made) != usual, "it is ignored"
    return True


# Keys of a take

HEAD = {
    "name": 'name = "another"', "rate": "rate = 5.0", "up": 'up = "x"', "body": 'body = "humanoid39"',
    "height": "height = 1.3", "mass": "mass = 32.0", "subject": 'subject = "take.toml"', "start": 'start = "other.npz"',
    "frames": "frames = [0, 4]", "size": "size = false", "person": "person = 2", "bands": "bands = { neck = 0.01 }",
}  # fmt: skip
OWN = {
    "keypoints": {
        "sigma": "sigma = 20.0", "frames": "frames = [0, 3]", "rate": "rate = 15.0", "set": 'set = "BODY_25"',
        "frame": 'frame = "calibration"', "face": "face = [1.0, 1.0, 9.0, 9.0]",
        "stream": 'stream = "coming"', "excluded": "excluded = [[1, 3], [4, 5]]", "swapped": "swapped = [[0, 2]]",
        "names": 'names = { a = "left_knee" }',
    },
    "markers": {
        "sigma": "sigma = 0.05", "unit": 'unit = "mm"', "set": 'set = "no such"', "model": 'model = "none.npz"',
        "shift": "shift = [0.1, 0.0, 0.0]", "turn": "turn = [0.0, 10.0, 0.0]",
        "time_offset": "time_offset = 0.2", "sides": 'sides = "exchanged"', "static": 'static = "none.trc"',
    },
    "depth": {
        "sigma": "sigma = 0.2", "unit": "unit = 0.0011", "range": "range = [0.5, 2.0]", "rate": "rate = 5.0",
        "time_offset": "time_offset = 0.2", "on_body": "on_body = true", "background": 'background = "tof"',
        "segment": 'segment = "torso"', "size": "size = [9, 9]", "intrinsics": "intrinsics = [9.0, 9.0, 9.0, 9.0]",
        "distortion": "distortion = [0.1, 0.0, 0.0, 0.0]", "time_unit": "time_unit = 0.2",
        "camera": 'camera = "no such"', "stream": 'stream = "coming"', "topic": 'topic = "/depth"',
    },
    "silhouettes": {
        "sigma": "sigma = 40.0", "rate": "rate = 5.0", "frame": 'frame = "video"', "low": "low = [0, 0, 0]",
        "high": "high = [9, 9, 9]", "channels": 'channels = "hsv"', "smooth": "smooth = 2.0",
    },
}  # fmt: skip
NAMING = {"camera", "file", "format"}  # which sensor an entry is of: another file or format is another take
TABLE = {"keypoints": "keypoints", "markers": "markers", "depth": "depth", "silhouettes": "silhouette"}


def changed(text, place, line):
    """A take's text with a key in the first table of a name, in place of what it has."""
    key = line.split(" =")[0]
    before, mark, after = text.partition(place)
    body, sep, rest = after.partition("\n[")
    lines = [one for one in body.split("\n") if not one.startswith(f"{key} =")]
    return before + mark + "\n".join([lines[0], line, *lines[1:]]) + sep + rest


@pytest.mark.parametrize("key", HEAD)
@pytest.mark.parametrize("kind", KINDS)
def test_a_key_of_the_take_acts_or_is_refused(kind, key, take, usual):
    path = take(kind)
    if key == "start":
        truth = movement("wave", people()[2].body, rate=10.0)
        write_motion(cut(truth, 8, 10), path.with_name("other.npz"))
    path.write_text(changed(path.read_text(), "[take]", HEAD[key]))
    acts_or_is_refused(lambda: track_take(path, settings=QUICK)[0], usual(kind))


START = {
    "at": "at = [0.3, 0.9, 0.1]", "forward": "forward = [0.0, 0.1, 1.0]", "upward": "upward = [0.0, 1.0, 0.1]",
    "angles": "angles = { elbow_flex_r = 80 }", "step": "step = 3",
}  # fmt: skip


@pytest.mark.parametrize("key", START)
def test_a_key_of_the_start_acts(key, take):
    """Two starts that differ in this key are two starts."""
    path = take("silhouettes", [('start = "motion.npz"\n', "size = false\n")])
    text = path.read_text()

    def start(line):
        path.write_text(changed(text + "\n[start]\nat = [0, 0.9, 0]\nforward = [1, 0, 0]\n", "[start]", line))
        read = read_take(path)
        step, state = recording_of(read, load_observations(read), load_body(read.body))[0].start
        return step, state.T_world_root.tobytes(), state.angles.tobytes()

    assert start(START[key]) != start("step = 0")


def test_an_old_key_is_a_note_of_the_command(take):
    path = take("markers")
    path.write_text(changed(path.read_text(), "[[markers]]", "accuracy = 0.01"))
    with warnings.catch_warnings():
        warnings.simplefilter("default", FutureWarning)
        code, _, words, _ = run(path, "--no-overlays", "--no-report")
    assert code == 0 and "note: " in words and "'accuracy' is now called 'sigma'" in words
    assert ".py" not in words.partition("'accuracy'")[0]


@pytest.mark.parametrize(("kind", "key"), [(kind, key) for kind, keys in OWN.items() for key in keys])
def test_a_key_of_a_sensor_acts_or_is_refused(kind, key, take, usual):
    path = take(kind)
    path.write_text(changed(path.read_text(), f"[[{TABLE[kind]}]]", OWN[kind][key]))
    if key == "frame":  # says what is so already: it acts by what follows from it
        pytest.skip("tests of readers hold what a frame of another image does")
    acts_or_is_refused(lambda: track_take(path, settings=QUICK)[0], usual(kind))


def test_every_key_is_tried():
    assert set(HEAD) | {"hide_faces"} == set(keys_of("take"))  # tests/preparing/test_faces.py
    elsewhere = {"low_pass", "clicks", "click_sigma"}  # takes/test_starts.py, test_init.py, batch/test_corrections.py
    assert set(START) | elsewhere == set(keys_of("start"))
    for kind, table in TABLE.items():
        assert set(OWN[kind]) | NAMING | {"name"} >= set(keys_of(table)) - {"camera", "name"}


@pytest.mark.parametrize("table", ["keypoints", "markers", "depth", "silhouettes"])
def test_an_old_key_is_read_with_a_warning(table, take):
    path = take(table)
    path.write_text(changed(path.read_text(), f"[[{TABLE[table]}]]", "accuracy = 0.5").replace("sigma = 0.0319\n", ""))
    text = path.read_text()
    first = text.index("accuracy")
    path.write_text(text[:first] + text[first:].replace("sigma = 2.0\n", "", 1))
    with pytest.warns(FutureWarning, match="'accuracy' is now called 'sigma'"):
        read = read_take(path)
    masks = read.sensors.get("silhouette")
    entry = {"keypoints": read.keypoints, "markers": read.markers, "depth": read.depth, "silhouettes": masks}
    assert entry[table][0].sigma == 0.5


# Arguments

ARGUMENTS = {
    "subject": lambda body: Subject(body.scaled(np.full(len(body.scale_groups), 0.9)), np.ones(len(body.scale_groups))),
    "trial": lambda body: Subject(body, np.ones(len(body.scale_groups))),
    "height": lambda body: 1.3,
    "size": lambda body: False,
    "settings": lambda body: replace(QUICK, angle_acceleration=3.0, smooth_rounds=2),
    "smooth": lambda body: False,
    "contacts": lambda body: True,
    "shape_frames": lambda body: 3,
    "lag": lambda body: 0.1,
    "noise": lambda body: KnownNoise.usual(body),
}


def arguments():
    long = ("depth", "size")  # a size from depth images alone
    for kind in KINDS:
        for name in ARGUMENTS:
            yield pytest.param(kind, name, marks=pytest.mark.slow if (kind, name) == long else ())


@pytest.mark.parametrize(("kind", "name"), list(arguments()))
def test_an_argument_of_track_acts_or_is_refused(kind, name, folder):
    read = read_take(folder / kind / "take.toml")
    body = read_motion(read.start).body if read.start else load_body(read.body)
    recording, body = recording_of(read, load_observations(read), body)
    given = {"settings": QUICK, **({"size": False} if read.start else {})}
    plain = digest(track(recording, body, **given))
    made = []

    def make():
        made.append(track(recording, body, **{**given, name: ARGUMENTS[name](body)}))
        return made[0]

    if name == "size" and read.start:
        make = lambda: track(recording, body, settings=QUICK)  # as it is without a start
    if name == "contacts":  # a sole that rests nowhere is not held: what was looked for is told
        make()
        assert "contacts" in made[0].provenance["smoothing"]
        with pytest.raises(KinefitError, match="smooth"):
            track(recording, body, contacts=True, smooth=False)
        return
    acts_or_is_refused(make, plain)


def test_every_argument_is_tried():
    others = {"progress", "checkpoint"}  # see test_progress_is_told, tests/tracking/checkpoints/test_checkpoint.py
    assert set(ARGUMENTS) | {"recording", "body"} | others == set(inspect.signature(track).parameters)
    assert set(inspect.signature(track_take).parameters) <= {*ARGUMENTS, "take", "view"} | others  # test_people.py


@pytest.mark.parametrize("kind", KINDS)
def test_progress_is_told(kind, folder):
    told = []
    track_take(folder / kind / "take.toml", settings=QUICK, progress=lambda *one: told.append(one))
    assert ("frames", FRAMES, FRAMES) in told


def a_recording(**more):
    from tests.fitting.tracking.movements import RATE, a_rig, marker_frame

    steps = [[marker_frame(i, ("neck", "r_hip", "l_hip", "r_wrist"))] for i in range(3)]
    return Recording.of_frames(steps, a_rig(), rate=RATE, **more)


@pytest.mark.parametrize("given", [
    {"sigma": {"mokap": 0.1}}, {"up": "w"}, {"on_body": ("nobody",)}, {"backgrounds": {"nobody": np.zeros((2, 2))}},
    {"start": (7, None)},
])  # fmt: skip
def test_an_argument_of_a_recording_is_refused_where_it_means_nothing(given):
    with pytest.raises(KinefitError, match="mokap|'w'|nobody|step 7"):
        a_recording(**given)


@pytest.mark.parametrize("given", [
    {"rate": 0.0}, {"sigma": {"mocap": 0.0}}, {"on_body": ("nobody",)}, {"values": {"rope": {"length": 1.0}}},
])  # fmt: skip
def test_an_argument_of_a_tracker_is_refused_where_it_means_nothing(given):
    from tests.fitting.tracking.movements import BODY, a_rig

    with pytest.raises(KinefitError):
        Tracker(BODY, a_rig(), **given)


# No frame in common


def test_cameras_that_share_no_step_are_told():
    from tests.fitting.tracking.movements import BODY, RATE, a_rig, keypoint_frame

    steps = [[keypoint_frame(i, "left" if i < 4 else "right")] for i in range(8)]
    with pytest.raises(KinefitError, match="frame|step|camera"):
        track(Recording.of_frames(steps, a_rig(), rate=RATE, up="y"), BODY)


def test_sensors_of_a_take_that_share_no_time_are_told(take):
    path = take("depth")
    marks = '[[markers]]\nfile = "../markers/all.trc"\ntime_offset = 1000.0\n'
    take("markers")
    path.write_text(path.read_text() + "\n" + marks)
    with pytest.raises(KinefitError, match="common|share|time"):
        track_take(path, settings=QUICK)


# The command line

OPTIONS = {
    "overlays": "--overlays", "overlay_skin": "--overlay-skin", "formats": "--formats=motion,csv",
    "report": "--no-report", "contacts": "--contacts",
    "realtime": "--realtime", "verbose": "-v", "lag": "--lag=0.1", "pictures": "--pictures=none",
    "person": "--person=2", "out": None, "take": None, "restart": None,  # tests/cli/test_resume.py
    "hide_faces": None,  # tests/preparing/test_faces.py
    "quiet": None, "as_json": None,  # tests/cli/tracking/test_track.py
}  # fmt: skip


def test_every_option_is_tried():
    assert {p.name for p in command.params} == set(OPTIONS)


def run(path, *more):
    """Files, the motion and the words of one run."""
    out = path.with_name("out")
    shutil.rmtree(out, ignore_errors=True)
    told = CliRunner().invoke(main, ["track", str(path), "-o", str(out), "--formats", "motion", *more])
    files = sorted(p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file())
    moved = read_motion(out / "motion.npz") if (out / "motion.npz").exists() else None
    return told.exit_code, files, told.output, moved


@pytest.mark.parametrize("kind", ["keypoints", "markers"])
def test_an_option_acts_or_is_refused(kind, take):
    path = take(kind)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        code, files, words, motion = run(path, "--no-overlays", "--no-report")
        assert code == 0, words
        assert files == ["motion.npz"]
        with_report = run(path, "--no-overlays")
        assert with_report[1] == ["motion.npz", "report.html"]
        code, drawn, said, _ = run(path, "--overlays", "--no-report")
        plain = (path.with_name("out") / "montage.png").read_bytes() if kind == "keypoints" else b""
        assert (code == 0 and "montage.png" in drawn) if kind == "keypoints" else (code != 0 and "overlays" in said)
        code, _, said, _ = run(path, "--overlay-skin", "--no-report")
        assert code == 0 if kind == "keypoints" else (code != 0 and "no video for a skin on overlays" in said)
        if kind == "keypoints":
            assert (path.with_name("out") / "montage.png").read_bytes() != plain
        assert run(path, "--overlay-skin", "--no-overlays")[0] != 0
        assert run(path, "--pictures", "none")[1] == ["motion.npz", "report.html"]
        assert "tables/angles.csv" in run(path, "--formats", "csv", "--no-overlays", "--no-report")[1]
        assert digest(run(path, "--realtime", "--no-overlays", "--no-report")[3]) != digest(motion)
        assert "contacts" in run(path, "--contacts", "--no-overlays", "--no-report")[3].provenance["smoothing"]
        assert run(path, "--contacts", "--realtime")[0] != 0
        assert len(run(path, "-v", "--no-overlays", "--no-report")[2]) > len(words)


def test_settings_are_all_used():
    """Every field of the settings is read somewhere, be it by a property of theirs."""
    import kinefit

    root = kinefit.__path__[0]
    from pathlib import Path

    text = "\n".join(p.read_text("utf-8") for p in Path(root).rglob("*.py"))
    unused = [f.name for f in fields(TrackSettings) if f".{f.name}" not in text]
    assert unused == []
