"""The take file: the real trial loads with both detectors, and every wrong line is named."""

import json

import numpy as np
import pytest

from kinefit.errors import CalibrationError, FileError, ObservationError, TakeError
from kinefit.readers.take.file import find_take, read_take
from kinefit.readers.take.load import load_observations

CAMERAS = ("cam01", "cam02", "cam03", "cam04")


def balancing(data, kind, *, letterbox='image = "letterboxed"', head="", frame=None):
    """A take of the balancing trial with the keypoints of one detector."""
    text = f'[take]\nup = "z"\nheight = 1.75\n{head}\n'
    text += f'[calibration]\nfile = "{data}/Calib_refined_static.toml"\nunit = "m"\n'
    for camera in CAMERAS:
        picture = letterbox if camera in ("cam01", "cam02") else ""
        text += f'[[camera]]\nname = "{camera}"\nvideo = "{data}/videos/{camera}.mp4"\n{picture}\n'
        source = {
            "openpose": f'file = "{data}/openpose_json/{camera}"\nset = "BODY_25B"\n',
            "mediapipe": f'file = "{data}/mediapipe_landmarks_{camera}.npy"\nformat = "mediapipe"\nsigma = 11\n',
        }[kind]
        told = {"openpose": "calibration", "mediapipe": "video"}[kind] if frame is None else frame
        text += f'[[keypoints]]\ncamera = "{camera}"\n{source}' + (f'frame = "{told}"\n' if told else "")
    return text


def written(folder, text, name="take.toml"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(("kind", "count"), [("openpose", 25), ("mediapipe", 33)])
def test_the_balancing_trial(data_dir, tmp_path, kind, count):
    take = read_take(written(tmp_path, balancing(data_dir("video_balancing_4cam"), kind)))
    assert (take.name, take.up, take.height, take.body, take.rate) == ("take", "z", 1.75, "humanoid", None)
    assert [source.sigma for source in take.keypoints] == [8.0 if kind == "openpose" else 11.0] * 4
    seen = load_observations(take)
    assert (seen.rate, seen.frames, seen.rig.names, tuple(seen.videos)) == (60, (0, 100), CAMERAS, CAMERAS)
    assert [k.points.shape[0] for k in seen.keypoints] == [100] * 4
    assert [k.points.shape[2] for k in seen.keypoints] == [count] * 4
    T = [seen.images[camera].T_image_calibration for camera in CAMERAS]
    np.testing.assert_array_equal(T[2:], [np.eye(3)] * 2)
    assert T[0][1, 2] == pytest.approx(7.06, abs=0.01)


def test_keypoints_of_the_video_are_brought_to_the_calibrations_frame(data_dir, tmp_path):
    folder = data_dir("video_balancing_4cam")
    seen = load_observations(read_take(written(tmp_path, balancing(folder, "mediapipe"))))
    raw = np.load(folder / "mediapipe_landmarks_cam02.npy")[..., :2]
    np.testing.assert_allclose(seen.images["cam02"].from_calibration(seen.keypoints[1].points[:, 0]), raw)
    raw = np.load(folder / "mediapipe_landmarks_cam03.npy")[..., :2]
    np.testing.assert_array_equal(seen.keypoints[2].points[:, 0], raw)


def test_some_frames_keep_their_times(data_dir, tmp_path):
    text = balancing(data_dir("video_balancing_4cam"), "mediapipe", head="frames = [20, 50]")
    seen = load_observations(read_take(written(tmp_path, text)))
    assert seen.frames == (20, 50)
    for keypoints in seen.keypoints:
        np.testing.assert_allclose(keypoints.times, np.arange(20, 50) / 60)


def test_picture_of_another_size_than_the_calibration(data_dir, tmp_path):
    text = balancing(data_dir("video_balancing_4cam"), "openpose", letterbox="")
    with pytest.raises(CalibrationError, match="1080x1920 px, but the calibration is of 1088x1920") as caught:
        load_observations(read_take(written(tmp_path, text)))
    assert 'image = "letterboxed"' in caught.value.remedy
    assert caught.value.place == "camera cam01"


def test_keypoints_must_tell_their_frame_where_it_matters(data_dir, tmp_path):
    text = balancing(data_dir("video_balancing_4cam"), "mediapipe", frame="")
    with pytest.raises(TakeError, match='frame = "calibration" or frame = "video"') as caught:
        load_observations(read_take(written(tmp_path, text)))
    assert "cam01" in caught.value.place


# A small synthetic take, with pictures but no video files.

CALIBRATION = """
[{name}]
name = "{name}"
size = [{size}]
matrix = [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 3.0]
fisheye = false
"""


@pytest.fixture
def small(tmp_path):
    """Folder with a calibration of cameras a and b (640x480), and ten frames of json for each."""
    calibration = "".join(CALIBRATION.format(name=name, size="640.0, 480.0") for name in "ab")
    (tmp_path / "calibration.toml").write_text(calibration)
    for camera in "ab":
        (tmp_path / camera).mkdir()
        for i in range(10):
            people = [{"pose_keypoints_2d": [10.0 + i, 20, 0.9] * 17}]
            (tmp_path / camera / f"{camera}_{i:04d}.json").write_text(json.dumps({"people": people}))
    return tmp_path


def take_text(head="rate = 50", a="", b="", keys='set = "COCO_17"', more=""):
    return (
        f'[take]\n{head}\n[calibration]\nfile = "calibration.toml"\n'
        f'[[camera]]\nname = "a"\n{a}\n[[camera]]\nname = "b"\n{b}\n'
        f'[[keypoints]]\ncamera = "a"\nfile = "a"\n{keys}\n'
        f'[[keypoints]]\ncamera = "b"\nfile = "b"\nset = "COCO_17"\n{more}'
    )


def load(folder, text):
    return load_observations(read_take(written(folder, text)))


def test_paths_are_relative_to_the_take(small, monkeypatch):
    monkeypatch.chdir(small.parent)
    worn = '[[markers]]\nfile = "m.trc"\nset = "worn.toml"\n[[markers]]\nfile = "n.trc"\nset = "CMU_41"\n'
    path = written(small, take_text(head='rate = 50\nbody = "own.toml"') + worn)
    for name in ("own.toml", "worn.toml", "m.trc", "n.trc"):
        written(small, "", name)
    take = read_take(path.relative_to(small.parent))
    assert [entry.set for entry in take.markers] == [str(small / "worn.toml"), "CMU_41"]
    path = written(small, take_text(head='rate = 50\nbody = "own.toml"'))
    take = read_take(path.relative_to(small.parent))
    assert take.calibration.file == small / "calibration.toml"
    assert take.body == str(small / "own.toml")
    assert load_observations(take).keypoints[0].points.shape == (10, 1, 17, 2)


def test_time_offsets_cut_all_streams_to_the_same_times(small):
    seen = load(small, take_text(b="time_offset = 0.06"))
    assert seen.frames == (3, 10)
    np.testing.assert_allclose(seen.keypoints[0].times, np.arange(3, 10) / 50)
    np.testing.assert_allclose(seen.keypoints[1].times, np.arange(3, 10) / 50)
    assert seen.keypoints[0].points[0, 0, 0, 0] == 13
    assert seen.keypoints[1].points[0, 0, 0, 0] == 10


def test_streams_of_different_length(small):
    (small / "b" / "b_0009.json").unlink()
    with pytest.raises(ObservationError, match="keypoints a 10 frames, keypoints b 9 frames") as caught:
        load(small, take_text())
    assert "frames = [0, 9]" in caught.value.remedy
    assert len(load(small, take_text(head="rate = 50\nframes = [0, 9]")).keypoints[0]) == 9


def test_streams_of_different_rate(small):
    seen = load(small, take_text(keys='set = "COCO_17"\nrate = 60'))
    assert (seen.rate, seen.frames) == (50.0, (0, 8))  # of a the last point is at 0.15 s
    x = seen.keypoints[0].points[:, 0, 0, 0]
    np.testing.assert_allclose(x, 10 + np.arange(8) * 60 / 50)
    assert seen.keypoints[1].points[7, 0, 0, 0] == 17
    with pytest.raises(ObservationError, match="keypoints a 16 frames of 50 Hz, keypoints b 10 frames"):
        load(small, take_text(keys='set = "COCO_17"\nrate = 30'))


def test_keypoints_take_the_times_of_the_video_beside_them(small, write_frames):
    kept = [0, 1, 2, 4, 6, 8, 9, 10, 11, 13]  # steps of 50 Hz
    write_frames(small / "a.mp4", kept)
    write_frames(small / "b.mp4", range(7), rate=25)
    for i in (7, 8, 9):
        (small / "b" / f"b_{i:04d}.json").unlink()
    text = take_text(head="", a='video = "a.mp4"', b='video = "b.mp4"\ntime_offset = 0.02')
    seen = load(small, text)
    assert seen.rate == pytest.approx(50) and seen.frames == (1, 14)
    np.testing.assert_allclose(seen.keypoints[0].points[:, 0, 0, 0], 10 + np.interp(np.arange(1, 14), kept, range(10)))
    np.testing.assert_allclose(seen.keypoints[1].points[:, 0, 0, 0], 10 + np.arange(13) / 2, atol=1e-6)
    assert "video a: variable frame rate, 50 Hz nominal, 4 frames lacking between 0.04 and 0.26 s" in seen.notes
    assert seen.notes[-1] == "take 50 Hz, video a 50 Hz, video b 25 Hz: points are interpolated between frames"
    assert load(small, text.replace("[take]", "[take]\nrate = 25", 1)).frames == (0, 7)
    with pytest.raises(ObservationError, match="above that of every video: take 60 Hz, video a 50 Hz, video b 25 Hz"):
        load(small, text.replace("[take]", "[take]\nrate = 60", 1))
    with pytest.raises(ObservationError, match="the keypoints have 30 Hz, and the video of as many frames 50 Hz"):
        load(small, text.replace('set = "COCO_17"', 'set = "COCO_17"\nrate = 30', 1))


def test_nothing_tells_the_rate(small):
    with pytest.raises(TakeError, match="the rate is not stated"):
        load(small, take_text(head=""))


@pytest.mark.parametrize(
    ("picture", "uv"),
    [
        ('image = "scaled"\nsize = [320, 240]', (20.5, 40.5)),
        ("rotation = 90\nsize = [480, 640]", (20.0, 479 - 10.0)),
        ('image = "letterboxed"\nsize = [320, 300]', (20.5, 2 * (20 - 30) + 0.5)),
    ],
)
def test_pictures_that_differ_from_the_calibrations(small, picture, uv):
    seen = load(small, take_text(a=picture, keys='set = "COCO_17"\nframe = "video"'))
    np.testing.assert_allclose(seen.keypoints[0].points[0, 0, 0], uv)


@pytest.mark.parametrize(
    ("size", "remedy"),
    [("[480, 640]", "rotation = 90"), ("[1280, 960]", 'image = "scaled"'), ("[640, 400]", "letterboxed")],
)
def test_the_line_to_write_is_proposed(small, size, remedy):
    with pytest.raises(CalibrationError, match="the calibration is of 640x480") as caught:
        load(small, take_text(a=f"size = {size}"))
    assert remedy in caught.value.remedy


def test_a_camera_without_calibration(small):
    (small / "calibration.toml").write_text(CALIBRATION.format(name="a", size="640.0, 480.0"))
    with pytest.raises(CalibrationError, match="no calibration of camera 'b'; there are: a"):
        load(small, take_text())


def test_markers_alone(data_dir, tmp_path):
    file = next(data_dir("markers").rglob("*Eb015pr.c3d"))
    seen = load(tmp_path, f'[[markers]]\nfile = "{file}"\nsigma = 0.003\n')
    assert (seen.rig, seen.keypoints, seen.rate, seen.frames) == (None, (), 50, (0, 450))
    assert seen.markers[0].positions.shape == (450, 26, 3)


WRONG = {
    "unknown sensor": (take_text(more='[[lidar]]\nfile = "x"'), r"no sensor or table 'lidar'; there are: take, s"),
    "unknown key": (take_text(a='vidoe = "x.mp4"'), r"\[\[camera\]\] 1: no key 'vidoe'; there are: name, video"),
    "unknown key of take": (take_text(head="fps = 50"), r"\[take\]: no key 'fps'; there are: name, rate, up"),
    "unknown option": (take_text(a='image = "cropped"'), r"\[\[camera\]\] 1, a, image: .*'cropped'.*'scaled'"),
    "unknown up": (take_text(head='up = "up"'), r"\[take\] up: Invalid value 'up'.*'-z'"),
    "wrong type": (take_text(head='rate = "fast"'), r"\[take\] rate: a number is expected, not a text"),
    "file of wrong type": (take_text(a="video = 3"), r"\[\[camera\]\] 1, a, video: a file or folder must be a text"),
    "missing key": (take_text(more='[[keypoints]]\nfile = "a"'), r"\[\[keypoints\]\] 3: there is no `camera`"),
    "one camera as table": ('[camera]\nname = "a"', r"'camera' is not a table \[\[camera\]\]"),
    "camera list of texts": ('camera = ["a"]', r"\[\[camera\]\] 1: not a table"),
    "unknown camera": (take_text(more='[[keypoints]]\ncamera = "c"\nfile = "a"'), "no camera 'c'; there are: a, b"),
    "camera twice": (take_text(more='[[camera]]\nname = "a"'), "camera a: two have this name"),
    "empty": ("", "an empty take"),
    "empty with head": ('[take]\nname = "x"', "an empty take"),
    "one camera of no known place beside a sensor of the world": (
        '[[camera]]\nname = "a"\nsize = [640, 480]\n[[depth]]\nname = "tof"\nfile = "seen"\n'
        "intrinsics = [500.0, 500.0, 320.0, 240.0]", "cameras without calibration",
    ),
    "unknown set": (take_text(keys='set = "BODY_26"'), "no keypoint set 'BODY_26'; there are: BODY_25B"),
    "set of another detector": (
        take_text(keys='format = "mediapipe"\nset = "COCO_17"'), "no keypoint set of mediapipe 'COCO_17'"
    ),
    "frames": (take_text(head="frames = [9, 2]"), r"frames \[9, 2\]"),
    "height in cm": (take_text(head="height = 175"), r"\[take\]: height = 175. Give.* in metres: height = 1.75"),
    "rate": (take_text(head="rate = -1"), r"\[take\]: rate = -1. Give frames per second"),
    "nan": (take_text(a="time_offset = nan"), r"\[\[camera\]\] 1, a: time_offset = nan. Give seconds"),
    "sigma": (take_text(keys='sigma = 0'), r"\[\[keypoints\]\] 1, camera a: sigma = 0. Give a positive number"),
    "keypoints without file": (take_text(more='[[keypoints]]\ncamera = "a"'), "no file of openpose keypoints"),
    "marker unit": (take_text(more='[[markers]]\nfile = "a"\nunit = "ell"'), "no unit 'ell'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_takes(small, case):
    text, message = WRONG[case]
    path = written(small, text)
    with pytest.raises(TakeError, match=message) as caught:
        read_take(path)
    assert caught.value.file == path


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (take_text(a='video = "none.mp4"'), "camera a, video"),
        (take_text(more='[[markers]]\nfile = "none.c3d"'), "markers none.c3d"),
        (take_text(more='[[keypoints]]\ncamera = "a"\nfile = "none"'), "keypoints of camera a"),
        (take_text().replace("calibration.toml", "none.toml"), "[calibration] file"),
        (take_text(head='body = "none.toml"'), "[take] body"),
        (take_text(head='subject = "none.toml"'), "[take] subject"),
    ],
)
def test_missing_files(small, text, place):
    with pytest.raises(FileError, match="no such file or folder.*none") as caught:
        read_take(written(small, text))
    assert caught.value.place == place


def test_no_take_and_no_toml(tmp_path):
    with pytest.raises(FileError, match="no such take file"):
        read_take(tmp_path / "none.toml")
    with pytest.raises(FileError, match="not TOML.*line 2"):
        read_take(written(tmp_path, "[take]\nname = x"))
    (tmp_path / "take.toml").unlink()
    with pytest.raises(FileError, match="no take file in this folder.*kinefit init"):
        read_take(tmp_path)


def test_cameras_that_saw_nothing(small):
    with pytest.raises(TakeError, match="no video and no keypoints"):
        load(small, take_text().partition("[[keypoints]]")[0])


def test_detections_that_are_not_there_yet(small):
    text = take_text(more='[[keypoints]]\ncamera = "a"\nformat = "detect"')
    with pytest.raises(FileError, match="detect") as caught:
        load(small, text)
    assert "kinefit detect" in caught.value.remedy


def test_a_damaged_video_is_refused(small):
    (small / "a.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    with pytest.raises(FileError, match="0 frames"):
        load(small, take_text(a='video = "a.mp4"'))


def test_a_path_whose_backslashes_were_read_as_tabs_is_told(tmp_path):
    take = tmp_path / "take.toml"
    take.write_text('[calibration]\nfile = "C:\\temp\\new.toml"\n')
    with pytest.raises(TakeError, match=r"use forward slashes"):
        read_take(take)


@pytest.mark.parametrize(
    ("line", "told"),
    [('[take]\nrate = "30 Hz"', "without quotes and without its unit"),
     ("[[markers]]\nfile = 'm.c3d'\nunit = 0.001", 'unit = "mm"'), ('[take]\nsize = "no"', "true or false")],
)  # fmt: skip
def test_a_value_of_another_kind_says_how_to_write_it(tmp_path, line, told):
    take = tmp_path / "take.toml"
    take.write_text(line)
    with pytest.raises(TakeError, match=told):
        read_take(take)


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("Millimeter", 0.001), ("inch", 0.0254)])
def test_units_of_depth_may_be_names(tmp_path, unit, metres):
    (tmp_path / "depth").mkdir()
    take = tmp_path / "take.toml"
    text = f'[[depth]]\nname = "tof"\nfile = "depth"\nunit = "{unit}"\ntime_unit = "us"\n'
    take.write_text(text + "intrinsics = [500, 500, 320, 240]\n")
    depth = read_take(take).depth[0]
    assert (depth.unit, depth.time_unit) == (metres, 1e-6)


@pytest.mark.parametrize("unit", ['"MM"', '"millimetres"', "0.001"])
def test_units_of_calibrations_are_spelled_as_people_do(small, unit):
    far = load(small, take_text()).rig
    near = load(small, take_text().replace("[calibration]\n", f"[calibration]\nunit = {unit}\n")).rig
    np.testing.assert_allclose(near["a"].T_camera_world[:3, 3], 0.001 * far["a"].T_camera_world[:3, 3])


def test_paths_of_windows_are_those_of_every_system(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "m.trc").write_text("x")
    head = '[take]\nup = "y"\nrate = 30.0\n[[markers]]\n'
    assert read_take(written(tmp_path, f"{head}file = 'data\\m.trc'\n")).markers[0].file == tmp_path / "data" / "m.trc"
    with pytest.raises(FileError, match=r"data.gone.trc"):
        read_take(written(tmp_path, f"{head}file = 'data\\gone.trc'\n"))
    with pytest.raises(FileError, match=r'Write "data/m.trc"'):
        read_take(written(tmp_path, f'{head}file = "data\\m.trc"\n'))


def test_take_toml_in_any_case_and_what_is_no_take(tmp_path):
    written(tmp_path, '[take]\n[[markers]]\nfile = "m.trc"\n', "Take.TOML")
    written(tmp_path, '[take]\n[[markers]]\nfile = "m.trc"\n', "a.toml")
    assert find_take(tmp_path).name == "Take.TOML"
    for name, said in (("s.zip", "an archive"), ("v.MOV.icloud", "iCloud"), ("v.360", "360°")):
        with pytest.raises(FileError, match=said):
            find_take(tmp_path / name)
