"""Depth sensors in a take: read with their cameras, in step with the rest, and every wrong line named."""

import cv2
import numpy as np
import pytest

from kinefit.errors import KinefitError, TakeError
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations

K = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
T = np.array([[0.0, -1, 0, 0.2], [0, 0, -1, 1.1], [1, 0, 0, 2.5], [0, 0, 0, 1]])
ALONE = "intrinsics = [60, 61, 31.5, 23.5]\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "depth").mkdir()
    for i in range(20):
        cv2.imwrite(str(tmp_path / "depth" / f"{i}.png"), np.full((48, 64), 1000 + i, np.uint16))
    (tmp_path / "empty").mkdir()
    cv2.imwrite(str(tmp_path / "empty" / "0.png"), np.full((48, 64), 4000, np.uint16))
    cameras = Camera("tof", (64, 48), K, T_camera_world=T), Camera("rgb", (640, 480), K * [[10], [10], [1]])
    write_calibration(Rig(cameras), tmp_path / "rig.toml")
    return tmp_path


def load(folder, depth, head="", more=""):
    entry = f'[[depth]]\nname = "tof"\nfile = "depth"\n{depth}' if depth is not None else ""
    (folder / "take.toml").write_text(f"[take]\n{head}\n{more}\n{entry}")
    return load_observations(read_take(folder / "take.toml"))


def test_a_sensor_alone_is_the_world(folder):
    seen = load(folder, ALONE + 'rate = 15\nrange = [0.5, 3]\nbackground = "empty"\nsigma = 0.02\non_body = true')
    assert (seen.rate, seen.frames, seen.rig.names, seen.notes) == (15.0, (0, 20), ("tof",), ())
    camera, video = seen.rig["tof"], seen.depth[0]
    np.testing.assert_array_equal(camera.T_camera_world, np.eye(4))
    np.testing.assert_array_equal(camera.matrix, [[60, 0, 31.5], [0, 61, 23.5], [0, 0, 1]])
    assert (camera.size, video.sensor, video.near, video.far, video.on_body) == ((64, 48), "tof", 0.5, 3.0, True)
    assert video.frame(7).depth[0, 0] == pytest.approx(1.007)
    assert (video.background.frame(0).depth == 4.0).all()  # the range does not gate it


def test_a_sensor_of_the_calibration_stands_where_it_says(folder):
    calibration = '[calibration]\nfile = "rig.toml"'
    seen = load(folder, "rate = 15\ntime_offset = 0.4", "frames = [12, 20]\nrate = 30", calibration)
    np.testing.assert_allclose(seen.rig["tof"].T_camera_world, T, atol=1e-12)
    assert (seen.rate, seen.frames) == (30.0, (12, 20))
    assert seen.notes == ("depth tof has 15 Hz, the take 30 Hz: each depth image counts at the step nearest to it",)
    assert seen.depth[0].times[0] == 0.4
    other = load(folder, "", "rate = 30", calibration + '\n[[depth]]\nname = "b"\ncamera = "tof"\nfile = "depth"')
    assert other.rig.names == ("b", "tof") and other.depth[0].rate == 30
    np.testing.assert_allclose(other.rig["b"].T_camera_world, T, atol=1e-12)


def test_frames_that_are_missing_are_told(folder):
    for i in (5, 6, 11):
        (folder / "depth" / f"{i}.png").unlink()
    seen = load(folder, ALONE + "time_unit = 0.04")
    assert seen.rate == pytest.approx(25)
    assert seen.notes == ("depth tof lacks frames in 2 places, the first before frame 5 (0.12 s instead of 0.04 s)",)
    assert [seen.depth[0].at_step(step, seen.rate) for step in (4, 5, 6, 7)] == [4, None, None, 5]


@pytest.mark.parametrize(
    ("depth", "head", "more", "words"),
    [
        ("", "rate = 30", "", "nothing states its intrinsics"),
        (ALONE, "", "", "its rate is not stated"),
        (ALONE + "unit = 1", "rate = 30", "", "depth tof: the median depth is 101"),
        (ALONE + "range = [2, 3]", "rate = 30", "", "depth tof: nothing lies within the range of 2 to 3 m"),
        (ALONE + "range = [3, 2]", "rate = 30", "", r"\[\[depth\]\] 1, tof: range has \[3.0, 2.0\]. Give the lesser"),
        (ALONE + "range = [3]", "rate = 30", "", "a list of 2 is expected, not of 1"),
        (ALONE + "sigma = 5", "rate = 30", "", "tof: sigma = 5. Give metres"),
        (ALONE + "unit = 0", "rate = 30", "", "unit = 0"),
        (ALONE + "size = [0, 3]", "rate = 30", "", r"size = \[0, 3\]"),
        ("intrinsics = [60, -61, 31, 23]", "rate = 30", "", "intrinsics = "),
        ("intrinsics = [60, 61, 310, 230]", "rate = 30", "", r"principal point \(310, 230\) outside of 64x48"),
        ("distortion = [0.1, 0, 0, 0]", "rate = 30", "", "distortion without intrinsics"),
        (ALONE + "distortion = [0.1]", "rate = 30", "", "1 distortion coefficients"),
        ('camera = "tof"', "rate = 30", "", r"no \[calibration\]"),
        (ALONE + "far = 3", "rate = 30", "", "no key 'far'; there are: name"),
        (ALONE, "rate = 30", '[calibration]\nfile = "rig.toml"', "intrinsics alone do not give"),
        ('camera = "nix"', "rate = 30", '[calibration]\nfile = "rig.toml"', "no calibration of camera 'nix'"),
        ('camera = "rgb"', "rate = 30", '[calibration]\nfile = "rig.toml"', r"64x48 px, its calibration is of \(640"),
        (ALONE, "rate = 30", '[[depth]]\nname = "tof"\nfile = "depth"', "two have this name"),
        (ALONE, "rate = 30\nframes = [40, 50]", "", r"frames are from 0 to 0.633 s"),
        (ALONE + 'background = "nix"', "rate = 30", "", "no such file or folder"),
        (None, "rate = 30", '[[depth]]\nname = "a"\nfile = "depth/*.tif"', "no such file or folder"),
        (None, "", "[depth]\nx = 1", r"'depth' is not a table \[\[depth\]\]"),
        (None, "rate = 30", '[[stereo]]\nleft = "a"\nright = "b"', "empty take|camera with a video"),
    ],
)
def test_every_wrong_line_is_named(folder, depth, head, more, words):
    with pytest.raises(KinefitError, match=words) as caught:
        load(folder, depth, head, more)
    assert caught.value.file is not None


def test_stereo_pairs_are_two_cameras_with_videos(folder):
    for name in ("l.mp4", "r.mp4"):
        (folder / name).touch()
    cameras = '[calibration]\nfile = "rig.toml"\n[[camera]]\nname = "tof"\nvideo = "l.mp4"\n[[camera]]\nname = "rgb"\n'
    pair = '[[stereo]]\nleft = "tof"\nright = "{}"\n{}\n'

    def read(right, more=""):
        video = 'video = "r.mp4"\n' if right == "rgb" else ""
        (folder / "take.toml").write_text(cameras + video + pair.format(right, more))
        return read_take(folder / "take.toml")

    (entry,) = read("rgb", "range = [1, 3]").stereo
    assert (entry.name, entry.range, entry.sigma) == ("tof-rgb", (1.0, 3.0), 0.5)
    for right, more, words in [
        ("tof", "", "are one camera"), ("nix", "", "no camera with a video 'nix'; there are: tof"),
        ("rgb", "sigma = 0", "sigma = 0. Give"), ("rgb", "range = [0, 2]", r"range = \[0, 2\]. Give .*positive"),
    ]:  # fmt: skip
        with pytest.raises(TakeError, match=words) as caught:
            read(right, more)
        assert "stereo" in caught.value.place and "tof-" in caught.value.place


def test_clouds_of_points_come_as_clouds(folder):
    x = np.random.default_rng(0).normal(size=(40, 3)) + (0, 0, 3)
    lines = "\n".join(f"{a} {b} {c}" for a, b, c in x)
    (folder / "c").mkdir()
    (folder / "c" / "1.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 40\nproperty float x\nproperty float y\nproperty float z\n"
        f"end_header\n{lines}\n"
    )
    more = '[calibration]\nfile = "rig.toml"\n[[depth]]\nname = "tof"\nfile = "c"'
    seen = load(folder, None, "rate = 10", more)
    assert seen.depth == () and seen.rig is None and seen.frames == (0, 1)
    frame = seen.clouds[0].frame(0)
    np.testing.assert_allclose(frame.points @ T[:3, :3].T + T[:3, 3], x, atol=1e-6)
    np.testing.assert_allclose(frame.viewpoint @ T[:3, :3].T + T[:3, 3], 0, atol=1e-12)


def test_depth_beside_video_keeps_the_cameras_first(folder, data_dir):
    trial = data_dir("video_balancing_4cam")
    sensor = Camera("tof", (64, 48), K)
    from kinefit.readers.calibration.read import read_calibration

    rig = read_calibration(trial / "Calib_refined_static.toml", unit="m")
    write_calibration(Rig((*rig, sensor)), folder / "all.toml")
    (folder / "take.toml").write_text(
        f'[calibration]\nfile = "all.toml"\n[[camera]]\nname = "cam03"\nvideo = "{trial}/videos/cam03.mp4"\n'
        f'[[depth]]\nname = "tof"\nfile = "depth"\n[[keypoints]]\ncamera = "cam03"\nformat = "mediapipe"\n'
        f'file = "{trial}/mediapipe_landmarks_cam03.npy"\n'
    )
    seen = load_observations(read_take(folder / "take.toml"))
    assert (seen.rig.names, seen.rate, seen.frames, seen.depth[0].rate) == (("cam03", "tof"), 60.0, (0, 100), 60.0)




def test_clouds_on_one_segment(folder):
    (folder / "c").mkdir()
    (folder / "c" / "1.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 1\n0.1 0 1\n"
    )
    more = '[[depth]]\nname = "tof"\nfile = "c"\nsegment = "forearm_l"\n'
    seen = load(folder, None, "rate = 10", more)
    frame = seen.clouds[0].frame(0)
    assert (frame.segment, frame.on_body, len(frame)) == ("forearm_l", True, 2)
    assert seen.recordings == seen.clouds
    with pytest.raises(TakeError, match="'background' has no use with clouds"):
        load(folder, None, "rate = 10", more + 'background = "empty"\n')
    with pytest.raises(TakeError, match="'segment' is for clouds of points"):
        load(folder, ALONE + 'rate = 15\nsegment = "forearm_l"\n')
