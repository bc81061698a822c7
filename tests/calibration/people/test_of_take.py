"""A take with several cameras and no calibration: these are found once, kept, and used by everything."""

from dataclasses import replace

import numpy as np
import pytest
from tests.calibration.people.test_skeletons import FRAMES, LATE, seen, turn_errors
from tests.calibration.people_data import BODY, room, walker

from kinefit import read_take, track_take
from kinefit.calibration.people import of_take
from kinefit.calibration.people.of_take import _holds_for, cameras_file, find_cameras, last_found
from kinefit.errors import TakeError
from kinefit.exporters.motion_file import write_detections
from kinefit.observations import Detections
from kinefit.readers.calibration.found import read_found
from kinefit.readers.take.load import load_observations


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four detections and a take of cameras with guessed lenses."""
    where = tmp_path_factory.mktemp("phones")
    for camera, record in zip(room(), seen(LATE), strict=True):
        masks = np.zeros(0, np.uint32), np.zeros(FRAMES + 1, int)
        write_detections(
            Detections(camera.name, 30.0, camera.size, record.points, record.confidence, *masks, "", record.lifted),
            where / f"{camera.name}.npz",
        )  # fmt: skip
    (where / "take.toml").write_text(take_text(f"height = {BODY.stature}"))
    return where


def take_text(head):
    text = f'[take]\nrate = 30.0\nup = "z"\n{head}\n'
    for camera in room():
        text += f'[[camera]]\nname = "{camera.name}"\nsize = [{camera.size[0]}, {camera.size[1]}]\n'
        text += f'[[keypoints]]\ncamera = "{camera.name}"\nformat = "detect"\nfile = "{camera.name}.npz"\nsigma = 2.0\n'
    return text


def test_a_take_without_calibration_is_tracked(folder):
    with pytest.warns(UserWarning, match="found from the people in view"):
        motion, observations = track_take(find_cameras(folder / "take.toml"))
    found = read_found(cameras_file(folder / "take.toml"))
    assert turn_errors(found.rig).max() < 0.6
    np.testing.assert_allclose(np.array(found.time_offsets) * 30.0, LATE, atol=0.2)
    assert any("clock" in note for note in observations.notes) and any("known to" in n for n in observations.notes)
    truth = walker(FRAMES)
    at = np.round(motion.times * 30.0).astype(int)
    x, y = motion.joint_centres, truth.joint_centres[at]
    apart = lambda p: np.linalg.norm(p[:, :, None] - p[:, None], axis=-1)
    assert np.abs(apart(x) - apart(y)).mean() < 0.01


def test_what_was_found_is_used_again_until_something_changes(folder, monkeypatch):
    def never(*args, **options):
        raise AssertionError("found anew")

    monkeypatch.setattr(of_take, "calibrate_people", never)
    take = find_cameras(folder / "take.toml", tell=lambda text: None)
    assert take.calibration.file.name == "take-cameras.toml" and take.calibration.position_sigma > 0
    trimmed = replace(read_take(folder / "take.toml"), frames=(2, FRAMES - 2))
    assert find_cameras(trimmed, tell=lambda text: None).calibration == take.calibration
    assert last_found(replace(trimmed, height=1.5)).calibration == take.calibration
    (folder / "take.toml").write_text(take_text("height = 1.6"))
    with pytest.raises(AssertionError, match="found anew"):
        find_cameras(folder / "take.toml", tell=lambda text: None)


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
    monkeypatch.setattr(of_take, "_heard", lambda take: heard)
    take = find_cameras(tmp_path / "take.toml", tell=lambda text: None)
    found = read_found(cameras_file(tmp_path / "take.toml"))
    np.testing.assert_allclose((np.array(found.time_offsets) - found.time_offsets[0]) * 30.0, truth * 30.0, atol=0.25)
    assert turn_errors(found.rig).max() < 1.0 and any("Clocks by sound" in note for note in found.notes)
    assert [camera.time_offset for camera in take.cameras] == pytest.approx(found.time_offsets)


@pytest.mark.parametrize("known, asked, holds", [
    ("h all", "h all", True), ("h all", "h 3 9", True), ("h 3 9", "h 4 9", True), ("h 3 9", "h 2 9", False),
    ("h 3 9", "h all", False), ("h all", "g all", False), ("h", "h 3 9", False),
])  # fmt: skip
def test_cameras_of_more_steps_hold_for_fewer(known, asked, holds):
    assert _holds_for(known, asked) == holds
