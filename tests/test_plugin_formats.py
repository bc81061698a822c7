"""File formats of another distribution: read, written, found by init; errors name the plug-in and leave nothing."""

import importlib
import json
import re
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tests.conftest import ROOT
from tests.docs.blocks import blocks
from tests.test_plugins import Site

from kinefit.cli import main
from kinefit.errors import CalibrationError, ExportError, ObservationError, PluginError, TakeError
from kinefit.exporters import write_motion, write_trc
from kinefit.fitting.tracking.checkpoints.checkpoint import key_of
from kinefit.geometry.camera import ImageFrame
from kinefit.readers import plugins
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.guess.folder import guess_take
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.landmarks.keypoints import read_keypoints
from kinefit.readers.markers import read_markers
from kinefit.readers.motion import read_motion
from kinefit.readers.plugins import KEYPOINTS, MARKERS, FileFormat
from kinefit.readers.take.file import read_take
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave
from kinefit.takes.batch.one import Choices, TakeJob, asked_take, work
from kinefit.takes.batch.results import FORMATS, MotionFormat, check_formats, write_format

MODULE = next(block.text for block in blocks("own-sensor", "python") if "MotionFormat(" in block.text)
PROJECT = next(block.text for block in blocks("own-sensor", "toml") if "kinefit.exporters" in block.text)
NAMED = r"the plug-in kinefit-formats 0\.1 \(entry point '{}' of kinefit\.{}\)"
READER, EXPORTER = NAMED.format(r"keypoints\.lab", "readers"), NAMED.format("angles", "exporters")
MORE = '''
from kinefit import Camera, Markers, Rig


def read_lines(path, unit):
    values = [[float(cell) for cell in line.split()[1:]] for line in path.read_text().splitlines()[1:]]
    return Markers(("a", "b"), 100.0, np.reshape(values, (-1, 2, 3)) * {"mm": 1e-3, None: 1.0}[unit])


def read_cameras(path, unit, image_size):
    names = path.read_text().split()[1:]
    return Rig(tuple(Camera(name, image_size(name) or (64, 48), np.diag([50.0, 50.0, 1.0])) for name in names))


def begins(word):
    return lambda path: path.read_bytes().startswith(word)


LINES = FileFormat(summary="lines", suffixes=(".lines",), recognise=begins(b"LINES"), read=read_lines)
CAMERAS = FileFormat(summary="cameras", suffixes=(".json",), recognise=begins(b"CAMERAS"), read=read_cameras)
'''
POINTS = '"markers.lines" = "kinefit_formats:LINES"\n"calibration.plain" = "kinefit_formats:CAMERAS"\n'


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    site = Site(tmp_path_factory.mktemp("site") / "packages")
    site.install(MODULE + MORE, PROJECT.replace('"keypoints.lab"', POINTS + '"keypoints.lab"'))
    return site


def write_tables(take):
    """Keypoints of each camera of a take as the laboratory writes them, in place of its own."""
    text = take.read_text()
    rig = read_calibration(read_take(take).calibration.file)
    for file in {*re.findall(r'^file = "(.+\.npy)"', text, re.M)}:
        (take.parent / file).unlink()
    names = KEYPOINT_SETS["COCO_17"]
    for record in simulate_keypoints(squat_and_wave(), rig, "COCO_17"):
        head = ",".join(["points", *(name for name in names for _ in range(3))])
        cells = np.concatenate([record.points, record.confidence[..., None]], axis=-1)[:, 0].reshape(len(record), -1)
        rows = [head] + [f"{k}," + ",".join(map(str, row)) for k, row in enumerate(cells)]
        (take.parent / f"{record.camera}.csv").write_text("\n".join(rows) + "\n")
    entries = [f'[[keypoints]]\ncamera = "{name}"\nfile = "{name}.csv"\nformat = "lab"\n' for name in rig.names]
    take.write_text("\n".join([text.partition("[[keypoints]]")[0], *entries]))


@pytest.fixture
def recording(tmp_path, copy_take):
    take = copy_take(tmp_path / "recording")
    write_tables(take)
    return take


@pytest.fixture
def here(site, monkeypatch):
    """The plug-in in this process: a function that changes its code, which is then imported anew."""
    file = site.folder / "kinefit_formats.py"
    monkeypatch.syspath_prepend(str(site.folder))

    def change(*pairs):
        text = MODULE + MORE
        for old, new in pairs:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        file.write_text(text)
        Path(importlib.util.cache_from_source(file)).unlink(missing_ok=True)
        forget()

    def forget():
        sys.modules.pop("kinefit_formats", None)
        importlib.invalidate_caches()
        for found in (plugins.installed, plugins._record):
            found.cache_clear()

    change()
    yield change
    change()
    monkeypatch.undo()
    forget()


@pytest.fixture
def other(monkeypatch, tmp_path, here):
    """Function that installs another distribution with entry points, whose module is not there."""

    def install(group, *points):
        info = tmp_path / "other" / "kinefit_other-0.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: kinefit-other\nVersion: 0.2\n")
        lines = [f"[kinefit.{group}]", *(f"{point} = kinefit_other:X" for point in points)]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        monkeypatch.syspath_prepend(str(info.parent))
        here()

    return install


def motion():
    return cut(squat_and_wave(), 0, 4)


def test_formats_of_another_distribution_go_from_init_to_export(site, recording, tmp_path):
    recording.unlink()
    code, said = site.kinefit("init", recording.parent)
    assert code == 0, said
    text = recording.read_text()
    assert text.count("[[keypoints]]") == 4 and "COCO_17, 4 cameras: used" in said
    comment = r"sure: of the plug-in kinefit-formats 0\.1: tables of the laboratory"
    assert re.search(rf'^format = "lab" +# {comment}$', text, re.M)
    code, said = site.kinefit("check", recording)
    assert code == 0, said
    out = tmp_path / "out"
    code, said = site.kinefit("track", recording, "-o", out, "--no-overlays", "--formats", "motion,angles")
    assert code == 0 and "kinefit-formats 0.1" in said, said
    found = read_motion(out / "motion.npz")
    assert found.provenance["plugins"] == ["kinefit-formats 0.1"]
    assert found.provenance["keypoints"][0]["format"] == "lab"
    truth = squat_and_wave()
    knee = found.body.tree.coordinates.index("knee_angle_r")
    assert np.median(np.abs(found.angles[:, knee] - truth.angles[: len(found), knee])) < np.radians(6.0)
    written = json.loads((out / "angles.json").read_text())
    np.testing.assert_allclose(written["angles"], np.degrees(found.angles))
    target = tmp_path / "radians.json"
    code, said = site.kinefit("export", out / "motion.npz", "--to", "angles", "--unit", "rad", "-o", target)
    assert code == 0 and "kinefit-formats 0.1" in said, said
    np.testing.assert_allclose(json.loads(target.read_text())["angles"], found.angles)
    code, said = site.kinefit("export", "--help")
    assert "|angles]" in said and re.search(r"angles +of the plug-in kinefit-formats 0\.1", said)
    code, said = site.kinefit("export", out / "motion.npz", "--to", "angles", "--unit", "mm")
    assert code == 2 and "--unit mm is not possible for angles. Give one of: deg, rad" in said
    assert not (out / "motion.json").exists()
    code, said = site.kinefit("export", out / "motion.npz", "--to", "angles")
    assert code == 0 and json.loads((out / "motion.json").read_text())["unit"] == "deg"


def test_keypoints_of_a_plugin_are_taken_to_the_calibration_and_the_clock(here, recording):
    file = recording.parent / "cam01.csv"
    plain = read_keypoints(file, camera="cam01", rate=30.0)
    assert plain.keypoint_set == "COCO_17" and plain.time_offset == 0.0
    turned = ImageFrame.rotated((640, 480), 90)
    moved = read_keypoints(file, format="lab", camera="cam01", rate=30.0, time_offset=0.5, image_frame=turned)
    assert moved.time_offset == 0.5
    np.testing.assert_allclose(moved.points, turned.to_calibration(plain.points))


def test_markers_and_calibrations_of_a_plugin(here, tmp_path):
    file = tmp_path / "walk.lines"
    file.write_text("LINES\n0 1 2 3 4 5 6\n1 1 2 3 4 5 7\n")
    assert read_markers(file).positions[1].tolist() == [[1, 2, 3], [4, 5, 7]]
    np.testing.assert_allclose(read_markers(file, unit="mm").positions[0, 1], [0.004, 0.005, 0.006])
    guess = guess_take(tmp_path)
    assert 'file = "walk.lines"' in guess.text
    cameras = tmp_path / "cameras.json"
    cameras.write_text("CAMERAS left right")
    assert read_calibration(cameras).names == ("left", "right")
    sizes = {"left": (320, 240), "right": (100, 50)}
    assert read_calibration(cameras, image_size=sizes.get)["right"].size == (100, 50)
    cameras.write_text("{ broken")
    with pytest.raises(CalibrationError, match="not a readable JSON file"):
        read_calibration(cameras)


END = "\nTABLES = FileFormat("
IMPORT = "from kinefit.readers import FileFormat"


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ((END, "\nraise ValueError('broken')" + END), "cannot be imported.*ValueError.*formats.py, line.*broken"),
        ((IMPORT, IMPORT + "\nimport absent_package"), "needs the package 'absent_package'.*install absent_package"),
        ((END, "\nTABLES = 1\nOTHER = FileFormat("), "is no FileFormat"),
        (('suffixes=(".csv",), recognise', 'suffixes=".csv", recognise'), "suffixes is a str. Give tuple of str"),
        (("recognise=recognise, read=read)", "recognise=recognise, read=3)"), "read is a int. Give Callable"),
    ],
)
def test_a_reader_that_cannot_be_imported(here, recording, pair, words):
    here(pair)
    with pytest.raises(PluginError, match=f"{READER} .*{words}") as caught:
        read_take(recording)
    assert Path(caught.value.file) == recording and "keypoints" in caught.value.place and caught.value.remedy


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        (("    table = np.gen", "    1 / 0\n    table = np.gen"), "ZeroDivisionError in read .*line"),
        (("    return Keypoints(", "    return 1\n    return Keypoints("), "returned a int from `read`, not Keypoints"),
        (("Keypoints(camera, ", "Keypoints(camera + 'x', "), "of the camera 'cam01' at 30.0 Hz"),
        (("tuple(names), rate,", "tuple(names), 2 * rate,"), "of the camera 'cam01' at 30.0 Hz"),
        (("def read(path, camera, rate):", "def read(path, camera):"), "raised TypeError: read.. got an unexpected"),
    ],
)
def test_a_reader_that_fails(here, recording, pair, words):
    here(pair)
    file = recording.parent / "cam01.csv"
    with pytest.raises(PluginError, match=words) as caught:
        read_keypoints(file, format="lab", camera="cam01", rate=30.0)
    assert re.search(READER, caught.value.problem) and Path(caught.value.file) == file
    notes = [note.text for note in guess_take(recording.parent).notes if note.about == "files"]
    assert any(re.search(f"{READER} ", note) for note in notes)


def test_a_format_that_cannot_be_asked_stops_only_files_that_no_other_reads(here, recording, tmp_path):
    here((END, "\nraise ValueError('broken')" + END))
    file = recording.parent / "cam01.csv"
    with pytest.raises(PluginError, match="cannot be imported") as caught:
        read_keypoints(file, camera="cam01", rate=30.0)
    trc = tmp_path / "walk.trc"
    write_trc(motion(), trc)
    assert len(read_markers(trc)) == 4 and len(read_calibration(recording.parent / "calibration.toml")) == 4
    (tmp_path / "walk.lines").write_text("LINES")
    with pytest.raises(PluginError, match=NAMED.format(r"markers\.lines", "readers")) as caught:
        read_markers(tmp_path / "walk.lines")
    assert Path(caught.value.file) == tmp_path / "walk.lines"
    here(('return file.readline().startswith("points,")', "return 1"))
    with pytest.raises(PluginError, match=f"{READER} returned a int from `recognise`, not a bool"):
        read_keypoints(file, camera="cam01", rate=30.0)
    assert "[[keypoints]]" not in guess_take(recording.parent).text


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        (("return lambda path: path", "return lambda path: 1 / 0 * path"), "ZeroDivisionError in .*lambda"),
        (("    return Rig(tuple(", "    return list(("), "returned a list from `read`, not a Rig"),
        (("    return Rig(tuple(", "    return Rig((), *("), "raised TypeError|returned a Rig"),
    ],
)
def test_a_reader_of_calibrations_that_fails(here, tmp_path, pair, words):
    here(pair)
    file = tmp_path / "cameras.json"
    file.write_text("CAMERAS left right")
    with pytest.raises(PluginError, match=words) as caught:
        read_calibration(file)
    assert re.search(NAMED.format(r"calibration\.plain", "readers"), caught.value.problem)
    assert Path(caught.value.file) == file


def test_a_format_of_keypoints_that_is_not_installed(recording):
    words = "no keypoint format 'lab'; there are: openpose, alphapose, mmpose, mediapipe"
    with pytest.raises(TakeError, match=f"{words}.*install the plug-in that adds this keypoint format\\."):
        read_take(recording)
    noted = 'format = "lab"   # sure: of the plug-in kinefit-formats 0.1: tables of the laboratory'
    recording.write_text(recording.read_text().replace('format = "lab"', noted))
    with pytest.raises(TakeError, match=r"-m pip install kinefit-formats\.") as caught:
        read_take(recording)
    assert caught.value.file == recording and caught.value.place == "[[keypoints]] 1"
    with pytest.raises(ObservationError, match="no keypoint format 'lab'.*install the plug-in"):
        read_keypoints(recording.parent / "cam01.csv", format="lab", camera="cam01", rate=30.0)


def test_a_format_of_motions_that_is_not_installed(tmp_path, recording):
    words = r"no format 'angles'; there are: motion, csv.*install the plug-in that adds this format\."
    with pytest.raises(ExportError, match=words):
        asked_take(recording, Choices(formats=("motion", "angles")))
    (row,) = work(TakeJob(recording, "a", tmp_path / "out", "out", Choices(formats=("angles",))))
    assert row.status == "failed" and "no format 'angles'" in row.error
    write_motion(motion(), tmp_path / "motion.npz")
    for words in (("export", tmp_path / "motion.npz", "--to", "angles"), ("track", recording, "--formats", "angles")):
        told = CliRunner().invoke(main, [*map(str, words)])
        assert told.exit_code == 2 and "no format 'angles'" in told.output and "install the plug-in" in told.output


def test_keys_that_mean_nothing_to_a_plugin(here, recording):
    text = recording.read_text()
    recording.write_text(text.replace('format = "lab"', 'format = "lab"\nset = "COCO_17"'))
    with pytest.raises(TakeError, match="'set' has no use with format = \"lab\""):
        read_take(recording)
    recording.write_text(text.replace('file = "cam01.csv"\n', ""))
    with pytest.raises(TakeError, match="no file of lab keypoints"):
        read_take(recording)


@pytest.mark.parametrize(
    ("group", "point", "words"),
    [
        ("readers", "keypoints.lab", "has the same name as kinefit-(other 0.2|formats 0.1).*pip uninstall"),
        ("readers", "keypoints.openpose", "has the name of kinefit's own keypoint format 'openpose'.*pip uninstall"),
        ("exporters", "angles", "has the same name as kinefit-(other 0.2|formats 0.1).*pip uninstall"),
        ("exporters", "bvh", "has the name of kinefit's own format 'bvh'.*pip uninstall kinefit-other"),
    ],
)
def test_a_name_that_is_taken(other, group, point, words, tmp_path):
    other(group, point)
    with pytest.raises(PluginError, match=words):
        if group == "exporters":
            check_formats(["motion", point])
        else:
            (tmp_path / "a.csv").write_text("x\n")
            read_keypoints(tmp_path / "a.csv", camera="a", rate=1.0)


def test_a_reader_of_no_kind_of_file_is_named(other):
    other("readers", "keypoint.lab")
    with pytest.warns(UserWarning, match=r"kinefit-other 0\.2 .*keypoint\.lab.* ignored.*none of keypoints\., markers"):
        KEYPOINTS.names()


WRITE = "    path.write_text(json"


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ((WRITE, "    path.write_text('half')\n    1 / 0\n" + WRITE), "ZeroDivisionError in write .*line"),
        ((WRITE, "    return None\n" + WRITE), "wrote nothing"),
        ((WRITE, "    path.touch()\n    return None\n" + WRITE), "wrote nothing"),
        (('def write(motion, path, unit="deg"):', "def write(motion):"), "`write`.*TypeError"),
    ],
)
def test_a_writer_that_fails_leaves_nothing(here, tmp_path, pair, words):
    here(pair)
    file = tmp_path / "out" / "angles.json"
    with pytest.raises(PluginError, match=EXPORTER) as caught:
        write_format(motion(), "angles", file)
    assert re.search(words, str(caught.value)) and Path(caught.value.file) == file
    assert not list(file.parent.iterdir())
    file.write_text("older")
    with pytest.raises(PluginError):
        write_format(motion(), "angles", file)
    assert file.read_text() == "older" and list(file.parent.iterdir()) == [file]


def test_a_disk_that_is_full_is_no_fault_of_the_plugin(here, tmp_path):
    here((WRITE, "    raise OSError(28, 'No space left on device')\n" + WRITE))
    with pytest.raises(ExportError, match=r"cannot be written \(No space left.*Free some space"):
        write_format(motion(), "angles", tmp_path / "angles.json")


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        (('file="angles.json"', 'file="tables"'), "has the file 'tables', not a name with an ending"),
        (('file="angles.json"', 'file="a/angles.json"'), "has the file 'a/angles.json', not a name"),
        (('file="angles.json"', 'file="motion.bvh"'), "writes motion.bvh, the file of the format 'bvh'"),
        (("write=write,", "write=None,"), "has a wrong record, MotionFormat: write is a NoneType. Give Callable"),
        (('unit=("deg", "rad")', 'unit="deg"'), "has a wrong record, MotionFormat: unit is a str. Give tuple of str"),
        (("ANGLES = MotionFormat(", "ANGLES = 1\nOTHER = MotionFormat("), "is no MotionFormat"),
    ],
)
def test_an_exporter_that_is_wrong_is_refused_before_anything_is_tracked(here, recording, pair, words):
    here(pair)
    with pytest.raises(PluginError, match=f"{EXPORTER} {words}"):
        asked_take(recording, Choices(formats=("motion", "angles")))


def test_resumed_runs_and_batches_notice_other_code_of_a_plugin(here, recording, tmp_path):
    take = read_take(recording)
    old = key_of(take)
    assert key_of(read_take(recording)) == old
    here(("confidence[..., None] > 0.0", "confidence[..., None] > 0.1"))
    assert key_of(read_take(recording)) != old
    here()
    text = recording.read_text().replace("[take]\n", "[take]\nframes = [0, 12]\nsize = false\n", 1)
    recording.write_text(text)
    choices = Choices(formats=("angles",), report=False, overlays=False, smooth=False)
    job = TakeJob(recording, "a", tmp_path / "out", "out", choices)
    (row,) = work(job)
    assert row.status == "done", row
    written = json.loads((tmp_path / "out" / "angles.json").read_text())
    assert len(written["angles"]) == 12 and written["unit"] == "deg"
    here(('unit="deg"):', 'unit="rad"):'))
    (row,) = work(job)
    assert row.status == "done" and json.loads((tmp_path / "out" / "angles.json").read_text())["unit"] == "rad"


@pytest.mark.parametrize("record", [FileFormat, MotionFormat])
def test_the_page_explains_every_part_of_a_format(record):
    page = (ROOT / "docs" / "own-sensor.md").read_text("utf-8").partition("## File formats of your own")[2]
    for part in fields(record):
        assert part.name == "plugin" or re.search(rf"^\| .*`{part.name}\b.*` \|", page, re.M), part.name


@pytest.mark.parametrize("formats", [KEYPOINTS, MARKERS])
def test_formats_of_kinefit_keep_the_rules_of_plugins(formats):
    for name in formats.built_in:
        format = formats.get(name)
        assert isinstance(format, FileFormat) and format.plugin is None and format.comment == format.summary
        assert all(suffix == f".{suffix[1:].lower()}" for suffix in format.suffixes)


def test_folders_and_tables_apart_formats_of_motions_keep_the_rules_of_plugins():
    faults = {name for name in FORMATS.built_in if FORMATS.get(name).fault(name)}
    assert faults == {"csv", "parquet"}  # which are folders
