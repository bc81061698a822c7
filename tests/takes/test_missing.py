"""A take with several cameras and no calibration: these are found once, kept, and used by everything."""

import re

import numpy as np
import pytest
from click.testing import CliRunner
from tests.rigs.people.test_skeletons import FRAMES, LATE, seen, turn_errors
from tests.rigs.people_data import BODY, room, walker

from kinefit import check_take, read_motion, read_take, track_take
from kinefit.cli import main
from kinefit.errors import FileError, TakeError
from kinefit.exporters.motion_file import write_detections
from kinefit.observations import Detections
from kinefit.readers.calibration.read import read_found
from kinefit.readers.take.load import load_observations
from kinefit.studio.live.take import live_session
from kinefit.takes import missing
from kinefit.takes.missing import cameras_file, find_cameras, last_found
from kinefit.takes.track import trial_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four detections and a take of cameras with guessed lenses."""
    where = tmp_path_factory.mktemp("phones")
    for camera, record in zip(room(), seen(LATE), strict=True):
        write(camera, record, where)
    (where / "take.toml").write_text(take_text(f"height = {BODY.stature}"))
    return where


def write(camera, record, where):
    masks = np.zeros(0, np.uint32), np.zeros(FRAMES + 1, int)
    seen = record.points, record.confidence, *masks, "", record.lifted
    write_detections(Detections(camera.name, 30.0, camera.size, *seen), where / f"{camera.name}.npz")


def take_text(head):
    text = f'[take]\nrate = 30.0\nup = "z"\n{head}\n'
    for camera in room():
        text += f'[[camera]]\nname = "{camera.name}"\nsize = [{camera.size[0]}, {camera.size[1]}]\n'
        text += f'[[keypoints]]\ncamera = "{camera.name}"\nformat = "detect"\nfile = "{camera.name}.npz"\nsigma = 2.0\n'
    return text


def test_track_take_is_kinefit_track(folder, tmp_path):
    """Both find cameras and clocks of a take that has none; the second uses what the first left."""
    with pytest.warns(UserWarning, match="found from the people in view"):
        motion, observations = track_take(folder / "take.toml")
    found = read_found(cameras_file(folder / "take.toml"))
    assert turn_errors(found.rig).max() < 0.6 and found.height == BODY.stature
    np.testing.assert_allclose(np.array(found.time_offsets) * 30.0, LATE, atol=0.2)
    assert any("clock" in note for note in observations.notes) and any("known to" in n for n in observations.notes)
    truth = walker(FRAMES)
    at = np.round(motion.times * 30.0).astype(int)
    x, y = motion.joint_centres, truth.joint_centres[at]
    apart = lambda p: np.linalg.norm(p[:, :, None] - p[:, None], axis=-1)
    assert np.abs(apart(x) - apart(y)).mean() < 0.01
    out = ["--out", str(tmp_path), "--formats", "motion", "--no-report", "--no-overlays"]
    told = CliRunner().invoke(main, ["track", str(folder / "take.toml"), *out])
    assert told.exit_code == 0, told.output
    again = read_motion(tmp_path / "motion.npz")
    np.testing.assert_array_equal(again.angles, motion.angles)
    np.testing.assert_array_equal(again.dof_std, motion.dof_std)


@pytest.fixture
def kept(folder, monkeypatch):
    """The folder with cameras that were found, which nothing finds anew."""

    def never(*args, **options):
        raise AssertionError("found anew")

    if not cameras_file(folder / "take.toml").exists():
        find_cameras(folder / "take.toml", tell=lambda text: None)
    (folder / "take.toml").write_text(take_text(f"height = {BODY.stature}"))
    before = cameras_file(folder / "take.toml").read_bytes()
    monkeypatch.setattr(missing, "calibrate_people", never)
    yield folder
    cameras_file(folder / "take.toml").write_bytes(before)


def silent(text):
    raise AssertionError(text)


def test_check_take_has_the_cameras_too_as_kinefit_check(kept):
    found = check_take(kept / "take.toml", tell=silent)
    assert found.take.calibration is not None and len(found.biases) == len(room())


@pytest.mark.parametrize("change", [
    ("[take]\n", f"[take]\nframes = [2, {FRAMES - 2}]\n"),
    ("sigma = 2.0\n", "sigma = 2.0\nexcluded = [[3, 9]]\n"),
    ("sigma = 2.0\n", "sigma = 3.0\nswapped = [[3, 9]]\n"),
    ("[take]\n", '[take]\nperson = "moving"\nbody = "humanoid10"\n'),
    (f"height = {BODY.stature}\n", ""),
])  # fmt: skip
def test_found_cameras_belong_to_the_take(kept, change):
    before = cameras_file(kept / "take.toml").read_bytes()
    text = (kept / "take.toml").read_text()
    (kept / "take.toml").write_text(text.replace(*change))
    assert text != (kept / "take.toml").read_text()
    take = find_cameras(kept / "take.toml", tell=silent)
    assert take.calibration.file == cameras_file(kept / "take.toml") and take.calibration.position_sigma > 0
    assert last_found(read_take(kept / "take.toml")).cameras == take.cameras
    assert cameras_file(kept / "take.toml").read_bytes() == before


def test_another_height_resizes_them(kept):
    file, said = cameras_file(kept / "take.toml"), []
    before = read_found(file)
    for height in (1.1 * BODY.stature, 1.2 * BODY.stature):
        (kept / "take.toml").write_text(take_text(f"height = {height}"))
        take = find_cameras(kept / "take.toml", tell=said.append)
    found = read_found(file)
    for a, b in zip(found.rig, before.rig, strict=True):
        np.testing.assert_allclose(a.centre_world, 1.2 * b.centre_world, atol=1e-6)
        np.testing.assert_allclose(a.T_camera_world[:3, :3], b.T_camera_world[:3, :3], atol=1e-9)
        np.testing.assert_allclose(a.matrix, b.matrix)
    assert found.position_sigma == pytest.approx(1.2 * before.position_sigma) == take.calibration.position_sigma
    assert (found.rotation_sigma, found.time_offsets) == (before.rotation_sigma, before.time_offsets)
    assert len(said) == 2 and sum("Resized" in note for note in found.notes) == 1


@pytest.mark.parametrize("change", [
    ('up = "z"', 'up = "y"'), ("[[keypoints]]", "field_of_view = 70.0\n[[keypoints]]"),
    ("[[keypoints]]", "time_offset = 0.5\n[[keypoints]]"), ('.npz"', '-new.npz"'),
])  # fmt: skip
def test_other_cameras_or_keypoints_find_them_anew(kept, change):
    said = []
    for camera in room():
        (kept / f"{camera.name}-new.npz").write_bytes((kept / f"{camera.name}.npz").read_bytes())
    (kept / "take.toml").write_text((kept / "take.toml").read_text().replace(*change))
    with pytest.raises(AssertionError, match="found anew"):
        find_cameras(kept / "take.toml", tell=said.append)
    assert len(said) == 1 and f"of {', '.join(room().names)}" in said[0]


def test_a_file_of_another_recording_is_not_used(kept, tmp_path):
    for camera, record in zip(room(), seen((0, 0, 0, 0)), strict=True):
        write(camera, record, tmp_path)
    (tmp_path / "take.toml").write_text((kept / "take.toml").read_text())
    cameras_file(tmp_path / "take.toml").write_bytes(cameras_file(kept / "take.toml").read_bytes())
    with pytest.raises(AssertionError, match="found anew"):
        find_cameras(tmp_path / "take.toml", tell=lambda text: None)


def test_a_file_of_an_earlier_version_is_read_and_told(kept):
    said, file = [], cameras_file(kept / "take.toml")
    text = re.sub(r"kinefit_found_from = .*", 'kinefit_found_from = "0123 all"', file.read_text())
    file.write_text(re.sub(r"height = .*\n", "", text))
    take = find_cameras(kept / "take.toml", tell=said.append)
    assert take.calibration.file == file and len(said) == 1 and "earlier version" in said[0] and "Delete it" in said[0]


@pytest.mark.parametrize("content", ["", "[cam]\nsize = [1, 2]\n", "[met", "kinefit_found_from"])
def test_a_file_that_is_none_is_told(kept, content):
    cameras_file(kept / "take.toml").write_text(content)
    for finds in (find_cameras, track_take):
        with pytest.raises(FileError, match="take-cameras.toml"):
            finds(kept / "take.toml")
    assert cameras_file(kept / "take.toml").read_text() == content


def test_the_trial_of_a_subject_gets_its_cameras(kept):
    (kept / "second.toml").write_text(take_text('subject = "take.toml"'))
    assert trial_of(read_take(kept / "second.toml")).body.stature == pytest.approx(BODY.stature, rel=0.02)


def test_a_live_session_replays_with_found_cameras(kept):
    session = live_session(read_take(kept / "take.toml"), tell=silent)
    session.close()
    assert session.tracker.rig.names == room().names


def test_reading_alone_says_what_finds_them(folder):
    with pytest.raises(TakeError, match="not calibrated yet.*kinefit track"):
        load_observations(read_take(folder / "take.toml"))


def test_a_camera_that_sees_nobody_is_left_out(folder):
    text = take_text(f"height = {BODY.stature}")
    name = room().names[3]
    text = text.replace(f'[[keypoints]]\ncamera = "{name}"\nformat = "detect"\nfile = "{name}.npz"\nsigma = 2.0\n', "")
    (folder / "three.toml").write_text(text)
    take = find_cameras(folder / "three.toml", tell=lambda text: None)
    assert [camera.name for camera in take.cameras] == list(room().names[:3])


def test_clocks_start_from_sound(folder, tmp_path, monkeypatch):
    early = 30  # frames that the second telephone began later than the others: a third of all
    names = room().names
    for camera, record, late in zip(room(), seen(LATE), (0, early, 0, 0), strict=True):
        kept = slice(late, FRAMES)
        masks = np.zeros(0, np.uint32), np.zeros(FRAMES - late + 1, int)
        parts = record.points[kept], record.confidence[kept], *masks, "", record.lifted[kept]
        write_detections(Detections(camera.name, 30.0, camera.size, *parts), tmp_path / f"{camera.name}.npz")
    (tmp_path / "take.toml").write_text(take_text(f"height = {BODY.stature}"))
    truth = (np.array(LATE) + [0, early, 0, 0]) / 30.0
    heard = dict(zip(names, (truth + [0.0, 0.03, -0.02, 0.04]).tolist(), strict=True))
    monkeypatch.setattr(missing, "_heard", lambda take: heard)
    take = find_cameras(tmp_path / "take.toml", tell=lambda text: None)
    found = read_found(cameras_file(tmp_path / "take.toml"))
    np.testing.assert_allclose((np.array(found.time_offsets) - found.time_offsets[0]) * 30.0, truth * 30.0, atol=0.25)
    assert turn_errors(found.rig).max() < 1.0 and any("Clocks by sound" in note for note in found.notes)
    assert [camera.time_offset for camera in take.cameras] == pytest.approx(found.time_offsets)
