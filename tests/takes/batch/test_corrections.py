"""Corrections of a take by its user: what each writes, that it acts, and that it can be undone."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import ExportError, FileError, KinefitError, ObservationError, TakeError
from kinefit.findings import Edit
from kinefit.fitting.multiview.people import PersonTrack
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.observations import ClickFrame
from kinefit.observations.recordings import mirror_name
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.batch.corrections import (
    add_click,
    can_undo,
    choose_person,
    corrections_of,
    exchange_sides,
    exclude_view,
    set_height,
    trim,
    undo,
    write_edits,
)
from kinefit.takes.track import track_take


@pytest.fixture
def take(copy_take, tmp_path):
    path = copy_take(tmp_path / "take")
    path.write_text("# of Tuesday\n" + path.read_text())
    return path


def files_in(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.suffix in (".toml", ".json", ".txt")}


EDITS = {
    "trim": lambda take: trim(take, 10, 40),
    "exclude_view": lambda take: exclude_view(take, "cam02", 10, 20),
    "exchange_sides": lambda take: exchange_sides(take, "cam02", 10, 11),
    "choose_person": lambda take: choose_person(take, 2),
    "set_height": lambda take: set_height(take, 1.75),
    "add_click": lambda take: add_click(take, 12, "cam02", "r_knee", (320.0, 200.5)),
}
SENTENCES = {
    "trim": "Only steps 10 to 39 are used.", "exclude_view": "Camera cam02 is excluded in steps 10 to 19.",
    "exchange_sides": "Camera cam02 has left and right exchanged in step 10.",
    "choose_person": "Person 2 is tracked.", "set_height": "The person is 1.75 m tall.",
    "add_click": "r_knee is placed by hand in camera cam02 at step 12.",
}  # fmt: skip


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_is_listed_and_undone(edit, take):
    before, files = corrections_of(take), files_in(take.parent)
    EDITS[edit](take)
    assert set(corrections_of(take)) - set(before) == {SENTENCES[edit]}
    assert take.read_text().startswith("# of Tuesday\n# A simulated figure")
    assert undo(take) and files_in(take.parent) == files
    assert not undo(take) and files_in(take.parent) == files


def test_several_edits_are_undone_one_by_one(take):
    texts = []
    for edit in (*EDITS.values(), lambda take: add_click(take, 12, "cam02", "r_knee", (1.0, 2.0))):
        texts.append(files_in(take.parent))
        edit(take)
    assert [undo(take) and files_in(take.parent) for _ in texts] == texts[::-1]


@pytest.mark.parametrize(("edit", "error", "words"), [
    (lambda take: trim(take, 40, 10), TakeError, "frames"),
    (lambda take: exclude_view(take, "cam02", 20, 10), TakeError, "excluded has \\[20, 10\\]"),
    (lambda take: exclude_view(take, "cam02", -5, 10), TakeError, "excluded has \\[-5, 10\\]"),
    (lambda take: exchange_sides(take, "cam02", 10, 10), TakeError, "swapped has \\[10, 10\\]"),
    (lambda take: exchange_sides(take, "cam09", 1, 2), TakeError, "cam09"),
    (lambda take: choose_person(take, 0), TakeError, "number from 1"),
    (lambda take: set_height(take, 175.0), TakeError, "height = 1.75"),
    (lambda take: add_click(take, 12, "cam09", "r_knee", (1.0, 2.0)), TakeError, "cam09"),
    (lambda take: add_click(take, 12, "cam02", "r_kneee", (1.0, 2.0)), TakeError, "r_knee"),
    (lambda take: add_click(take, -1, "cam02", "r_knee", (1.0, 2.0)), FileError, "step -1"),
    (lambda take: add_click(take, 12, "cam02", "r_knee", (np.nan, 2.0)), FileError, "not a pixel position"),
])  # fmt: skip
def test_what_cannot_be_is_refused_and_nothing_is_written(edit, error, words, take):
    files = files_in(take.parent)
    with pytest.raises(error, match=words) as caught:
        edit(take)
    assert files_in(take.parent) == files and f".{take.stem}-" not in str(caught.value)


def test_a_form_that_cannot_be_edited_is_refused(take):
    _, _, rest = take.read_text().partition("[calibration]")
    take.write_text(f'take = {{ rate = 30.0, up = "z" }}\n[calibration]{rest}')
    files = files_in(take.parent)
    with pytest.raises(KinefitError, match="take"):
        trim(take, 1, 5)
    assert read_take(take).frames is None and files_in(take.parent) == files


def test_ranges_of_steps_are_joined_and_sides_exchanged_back(take):
    def ranges(key):
        return next(getattr(entry, key) for entry in read_take(take).keypoints if entry.camera == "cam02")

    for first, stop in ((10, 20), (30, 40), (15, 30), (50, 51)):
        exclude_view(take, "cam02", first, stop)
    assert ranges("excluded") == ((10, 40), (50, 51))
    exchange_sides(take, "cam02", 10, 30)
    exchange_sides(take, "cam02", 20, 40)
    assert ranges("swapped") == ((10, 20), (30, 40))
    exchange_sides(take, "cam02", 10, 20)
    exchange_sides(take, "cam02", 30, 40)
    assert ranges("swapped") == () and "swapped" not in take.read_text()


def test_the_same_joint_clicked_again_replaces_the_former(take):
    add_click(take, 12, "cam02", "r_knee", (1.0, 2.0))
    add_click(take, 12, "cam01", "r_knee", (3.0, 4.0))
    add_click(take, 5, "cam02", "l_knee", (5.0, 6.0))
    add_click(take, 12, "cam02", "r_knee", (7.0, 8.0))
    read = read_take(take)
    assert read.pose is None and read.clicks == take.with_name("clicks.json") and read.click_sigma == 1.0
    assert json.loads(read.clicks.read_text()) == [
        {"step": 5, "points": {"cam02": {"l_knee": [5.0, 6.0]}}},
        {"step": 12, "points": {"cam02": {"r_knee": [7.0, 8.0]}, "cam01": {"r_knee": [3.0, 4.0]}}},
    ]
    other = take.with_name("other.toml")
    other.write_text(take.read_text().partition("[start]")[0])
    add_click(other, 12, "cam02", "r_knee", (1.0, 2.0))
    assert read_take(other).clicks == take.with_name("other-clicks.json")


def test_person_and_height_are_taken_away_again(take):
    text = take.read_text()
    choose_person(take, 1)
    choose_person(take, None)
    set_height(take, 1.8)
    set_height(take, None)
    assert take.read_text() == text and len(list(Path(f"{take.with_suffix('')}-before").glob("*.txt"))) == 4


def without_keypoints(take):
    """The take as it is where the built-in detector looks through its videos."""
    take.write_text(take.read_text().partition("[[keypoints]]")[0])
    return take


def test_a_take_of_the_detector_gets_its_tables(take):
    without_keypoints(take)
    exclude_view(take, "cam02", 10, 20)
    entries = read_take(take).keypoints
    assert [(k.camera, k.format, k.file, k.set, k.excluded) for k in entries] == [
        (f"cam0{c}", "detect", None, None, ((10, 20),) if c == 2 else ()) for c in (1, 2, 3, 4)
    ]
    assert undo(take) and not read_take(take).keypoints


def test_cameras_in_which_nobody_is_seen_and_faces_are_as_the_detector_leaves_them(take, monkeypatch):
    from types import SimpleNamespace

    from kinefit.takes.batch import corrections

    without_keypoints(take)
    take.write_text(take.read_text().replace('"humanoid"', '"humanoid_face"'))
    folder = take.with_name("take-detect")
    folder.mkdir()
    for camera in ("cam01", "cam02", "cam03"):
        (folder / f"{camera}.npz").touch()
    monkeypatch.setattr(corrections, "read_detections", lambda file: SimpleNamespace(
        seen=np.full((3, 1), file.stem != "cam01"), has_faces=file.stem == "cam03"))  # fmt: skip
    exchange_sides(take, "cam03", 1, 2)
    found = [(k.camera, k.set, k.swapped) for k in read_take(take).keypoints]
    assert found == [("cam02", None, ()), ("cam03", None, ((1, 2),)), ("cam03", "MEDIAPIPE_478", ((1, 2),)),
                     ("cam04", None, ())]  # fmt: skip
    with pytest.raises(TakeError, match="cam01"):
        exclude_view(take, "cam01", 1, 2)


# What the edits do to a fit


@pytest.fixture(scope="module")
def fitted(copy_take, tmp_path_factory):
    """The take of 24 steps as it is, and its motion."""
    path = copy_take(tmp_path_factory.mktemp("fitted"))
    trim(path, 0, 24)
    return path, track_take(path)[0]


@pytest.fixture
def short(fitted, copy_take, tmp_path):
    path = copy_take(tmp_path / "short")
    trim(path, 0, 24)
    return path


def test_a_click_moves_its_joint_and_nothing_far_away(fitted, short):
    plain = fitted[1]
    camera = load_observations(read_take(short)).rig["cam02"]
    knee, step, offset = plain.body.landmarks.select(("r_knee",)), 12, np.array([24.0, 32.0])
    add_click(short, step, "cam02", "r_knee", camera.project(plain.positions(knee)[step, 0]) + offset)
    moved, _ = track_take(short)
    uv = [camera.project(m.positions(m.body.landmarks.select(("r_knee",)))[:, 0]) for m in (plain, moved)]
    along = (uv[1] - uv[0]) @ offset / 40.0  # [px] towards the click, which is 40 px off
    assert 20.0 < along[step] < 42.0 and np.abs(along[[0, 1, 22, 23]]).max() < 4.0
    apart = np.linalg.norm(plain.joint_centres - moved.joint_centres, axis=2)
    assert apart[[0, 1, 2, 21, 22, 23]].max() < 0.01 and apart[:, plain.body.tree.segment("hand_l")].max() < 0.02
    assert "clicks cam02" in moved.residuals
    trim(short, 0, 10)  # the click is of none of these steps
    assert not load_observations(read_take(short)).clicks


def test_an_excluded_view_counts_for_nobody_in_its_steps(short):
    before = load_observations(read_take(short)).keypoints[1]
    exclude_view(short, "cam02", 5, 9)
    exclude_view(short, "cam02", 20, 1000)
    after = load_observations(read_take(short)).keypoints[1]
    off = np.r_[5:9, 20:24]
    assert np.isnan(after.points[off]).all() and not after.confidence[off].any()
    on = np.setdiff1d(np.arange(24), off)
    np.testing.assert_array_equal(after.points[on], before.points[on])


def exchanged_file(take, camera, steps):
    """Keypoints of a camera in whose file the detector took left for right."""
    record = next(k for k in load_observations(read_take(take)).keypoints if k.camera == camera)
    path = take.with_name(f"mediapipe_{camera}.npy")
    values, order = np.load(path), [record.names.index(mirror_name(name)) for name in record.names]
    values[steps] = values[steps][..., order, :]
    np.save(path, values)


def test_sides_that_the_user_exchanges_are_not_exchanged_back(fitted, short):
    """The fit exchanges a view whose sides contradict the others, but not where the user has said which they are."""
    steps = slice(6, 14)
    exchange_sides(short, "cam02", steps.start, steps.stop)  # the detector was right, and the user is wrong
    stated = track_take(short)[0].residuals["cam02"]
    assert not stated.swapped.any() and np.nanmedian(np.abs(stated.values[steps])) > 5.0
    exchange_sides(short, "cam02", steps.start, steps.stop)
    exchanged_file(short, "cam02", steps)
    found = track_take(short)[0].residuals["cam02"]
    assert found.swapped[steps].all() and not found.swapped[14:].any()


def test_sides_that_all_views_exchange_are_set_right_by_the_user(fitted, short):
    for camera in ("cam01", "cam02", "cam03", "cam04"):
        exchanged_file(short, camera, slice(6, 14))
        exchange_sides(short, camera, 6, 14)
    motion, _ = track_take(short)
    apart = np.linalg.norm(motion.joint_centres - fitted[1].joint_centres, axis=2)
    assert apart.max() < 0.005


def test_a_click_is_of_the_person_with_the_nearest_keypoint(take):
    add_click(take, 12, "cam02", "r_knee", (0.0, 0.0))
    seen, read, body = load_observations(read_take(take)), read_take(take), load_body("humanoid")
    one = seen.keypoints[1].points[12, 0, 0]
    two = [replace(k, points=np.concatenate([k.points, k.points + [200.0, 0.0]], axis=1),
                   confidence=np.repeat(k.confidence, 2, axis=1)) for k in seen.keypoints]  # fmt: skip
    count = len(two[0])
    people = [PersonTrack((np.full(count, p),) * 4, np.full(count, 4), 1.0, 0.0, 300.0, np.zeros(3)) for p in (0, 1)]
    for offset, owner in ((-20.0, 1), (220.0, 2)):
        add_click(take, 12, "cam02", "r_knee", one + [offset, 0.0])
        seen = replace(load_observations(read_take(take)), keypoints=tuple(two))
        for person in (1, 2):
            recording, _ = recording_of(replace(read, person=person), seen, body, people)
            (click,) = (f for f in recording.steps(12) if isinstance(f, ClickFrame))
            assert np.isfinite(click.ends).all() == np.isfinite(click.ends).any() == (person == owner)
    assert not recording.sees_more  # clicks part nobody


def test_a_finding_is_written_into_its_camera(take):
    before = read_take(take).cameras
    late = Edit("camera", "time_offset", "0.0109", "cam02")
    write_edits(take, [late, late])
    assert [entry.time_offset for entry in read_take(take).cameras] == [0.0, 0.0109, 0.0, 0.0]
    with pytest.raises(TakeError, match="cam9"):
        write_edits(take, [Edit("camera", "time_offset", "0.1", "cam9")])
    assert undo(take) and read_take(take).cameras == before


def test_files_of_others_among_the_kept_texts_are_left_alone(copy_take, tmp_path):
    take = copy_take(tmp_path)
    before, original = tmp_path / "take-before", take.read_bytes()
    before.mkdir()
    for name in ("notes.txt", "v1.2.txt", "0003"):
        (before / name).write_text("no take")
    (before / "0007.txt").mkdir()
    assert not can_undo(take) and not undo(take)
    set_height(take, 1.8)
    assert (before / "0001.txt").read_bytes() == original and undo(take) and take.read_bytes() == original


@pytest.mark.parametrize("content", [b"no take", b"\xff\xfe\x00", b"[camera]\n"])
def test_a_kept_text_that_is_no_take_is_not_put_back(copy_take, tmp_path, content):
    take = copy_take(tmp_path)
    original = take.read_bytes()
    (tmp_path / "take-before").mkdir()
    (tmp_path / "take-before" / "0004.txt").write_bytes(content)
    with pytest.raises(KinefitError, match="take-before.*0004.txt"):
        undo(take)
    assert take.read_bytes() == original


WRITES = {
    "a step and its cut": [Edit("camera", "time_offset", "0.1", "cam01"), Edit("take", "frames", "[0, 30]")],
    "names of two cameras": [
        Edit(table, key, f'"{new}"', old)
        for old, new in (("cam01", "cam03"), ("cam03", "cam01"))
        for table, key in (("camera", "name"), ("keypoints", "camera"))
    ],
}  # fmt: skip


@pytest.mark.parametrize("edits", WRITES)
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_edits_are_written_together_and_undone_byte_for_byte(edits, ends, take):
    take.write_bytes(b"\xef\xbb\xbf" * (ends == "\r\n") + take.read_text().replace("\n", ends).encode())
    before, videos = take.read_bytes(), {c.video.stem: c.name for c in read_take(take).cameras if c.video}
    assert write_edits(take, WRITES[edits]).read_bytes() == before
    now = read_take(take)
    if "names" in edits:
        assert {c.video.stem: c.name for c in now.cameras if c.video} == {**videos, "cam01": "cam03", "cam03": "cam01"}
        assert next((k.camera, k.file.stem) for k in now.keypoints) == ("cam03", "mediapipe_cam01")
    else:
        assert now.frames == (0, 30) and now.cameras[0].time_offset == 0.1
    assert undo(take) and take.read_bytes() == before


REFUSED = {
    "contradicting": ([Edit("take", "up", '"y"'), Edit("take", "up", '"x"')], TakeError, 'up = "y" and up = "x"'),
    "contradicting, of a camera": (
        [Edit("camera", "image", '"scaled"', "cam02"), Edit("camera", "image", None, "cam02")], TakeError,
        r'\[\[camera\]\] cam02: two edits contradict each other: image = "scaled" and no image',
    ),
    "by name and by number": (
        [Edit("camera", "rotation", "90", 1), Edit("camera", "rotation", "180", "cam02")], TakeError, "contradict",
    ),
    "invalid": ([Edit("camera", "rotation", "45", "cam02")], TakeError, "rotation"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_edits_that_cannot_be_leave_everything_as_it_was(case, take):
    edits, error, words = REFUSED[case]
    files = files_in(take.parent)
    with pytest.raises(error, match=words) as caught:
        write_edits(take, edits)
    assert caught.value.file == take and files_in(take.parent) == files
    assert not take.with_name("take-before").exists()


def test_a_take_that_is_read_only_or_was_changed_in_the_meantime_is_left_alone(take):
    before, edit = take.read_bytes(), Edit("take", "up", '"y"')
    set_height(take, 1.7)  # as in the window, while a check runs
    files = files_in(take.parent)
    with pytest.raises(TakeError, match="changed by another program"):
        write_edits(take, [edit], over=before)
    take.chmod(0o444)
    with pytest.raises(ExportError, match="read-only"):
        write_edits(take, [edit])
    assert files_in(take.parent) == files
    take.chmod(0o644)
    write_edits(take, [edit], over=take.read_bytes())
    assert read_take(take).up == "y" and read_take(take).height == 1.7


@pytest.mark.parametrize("text", ["1.75", "1,75", "175", "175 cm"])
def test_a_height_is_written_in_metres_however_it_was_typed(take, text):
    set_height(take, text)
    assert read_take(take).height == 1.75
    set_height(take, "")
    assert read_take(take).height is None
    with pytest.raises(ObservationError, match="1.75 or 175"):
        set_height(take, "tall")
