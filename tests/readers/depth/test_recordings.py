"""Recordings of depth: every format gives the same frames, and what is wrong with one is said."""

import json
import re
import struct
import sys
import types
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from kinefit.errors import CalibrationError, FileError, KinefitError, ObservationError
from kinefit.observations import DepthVideo
from kinefit.observations.videos import CloudVideo
from kinefit.readers.depth.recordings import is_unordered, read_clouds, read_depth

SIZE = (64, 48)
COUNTS = np.random.default_rng(0).integers(800, 3000, (5, 48, 64)).astype(np.uint16)
COUNTS[:, :5] = 0
METRES = COUNTS * np.float32(0.001)


def png(folder, names=("f8.png", "f9.png", "f10.png", "f11.png", "f12.png"), counts=COUNTS):
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(names, counts):
        cv2.imwrite(str(folder / name), image)
    return folder


def raw(folder):
    folder.mkdir()
    (folder / "README.txt").write_text("not depth")
    for i, image in enumerate(COUNTS):
        image.astype("<u2").tofile(folder / f"depth-{8 + i}")
    return folder


def pages(path):
    assert cv2.imwritemulti(str(path), list(COUNTS))
    return path


def npz(path, **more):
    np.savez(path, **{"depth": COUNTS, **more})
    return path


def cloud(path, points, width, height=1):
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {width}\nHEIGHT {height}\n"
    data = points.astype("<f4").tobytes()
    path.write_bytes(f"{head}VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n".encode() + data)


def organised(folder):
    folder.mkdir()
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    for i, z in enumerate(METRES):
        x = np.stack([(u - 31.5) / 60 * z, (v - 23.5) / 60 * z, z], axis=-1).reshape(-1, 3)
        x[x[:, 2] == 0] = np.nan
        cloud(folder / f"{i}.pcd", x, 64, 48)
    return folder


def ffv1(path, counts=COUNTS):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = counts.shape[2], counts.shape[1], "gray16le"
        for image in counts:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray16le")))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    "make",
    [
        lambda p: read_depth(png(p / "a")),
        lambda p: read_depth(png(p / "a", [f"x{i}.tiff" for i in range(5)])),
        lambda p: read_depth(pages(p / "a.tiff")),
        lambda p: read_depth(png(p / "a", [f"{i}.tif" for i in range(5)], METRES)),
        lambda p: read_depth(raw(p / "a"), size=SIZE),
        lambda p: read_depth(raw(p / "a") / "depth-*", size=SIZE),
        lambda p: read_depth(npz(p / "a.npz")),
        lambda p: read_depth(npz(p / "a.npz", depth=METRES)),
        lambda p: read_depth(npz(p / "a.npz", unit=0.001, times=np.arange(5) / 30)),
        lambda p: read_depth(organised(p / "a")),
        lambda p: read_depth(ffv1(p / "a.mkv")),
    ],
)
def test_every_format_gives_the_same_frames_in_order(tmp_path, make):
    video = make(tmp_path)
    assert (len(video), video.size, video.rate) == (5, SIZE, pytest.approx(30))
    np.testing.assert_allclose(video.times, np.arange(5) / 30, atol=6e-4)
    for i in (0, 3, 4, 1, -1):
        frame = video.frame(i)
        np.testing.assert_allclose(frame.depth, METRES[i], atol=1e-6)
        assert (frame.sensor, frame.time) == ("a" if video.sensor == "a" else "depth-*", video.times[i])


def test_a_raw_file_may_hold_all_frames(tmp_path):
    COUNTS.astype("<u2").tofile(tmp_path / "all.raw")
    video = read_depth(tmp_path / "all.raw", size=SIZE, sensor="s", unit=0.002, rate=10, time_offset=1.5)
    np.testing.assert_allclose(video.frame(3).depth, 2 * METRES[3], rtol=1e-6)
    np.testing.assert_allclose(video.times, 1.5 + np.arange(5) / 10)


CALIBRATION = {"CalibrationInformation": {"Cameras": [{
    "Location": "CALIBRATION_CameraLocationD0", "SensorWidth": 1024, "SensorHeight": 1024,
    "Intrinsics": {"ModelParameterCount": 14, "ModelParameters": [
        0.51, 0.52, 0.49, 0.48, 0.55, -0.02, -0.003, 0.89, 0.086, -0.014, 0, 0, -7e-5, 2e-5]},
}]}}  # fmt: skip


def azure(path, counts, calibration=CALIBRATION, depth="DEPTH"):
    """As the recorder writes it: depth and infrared as big-endian packets under the four letters b16g, in VFW mode."""
    height, width = counts.shape[1:]
    with av.open(str(path), "w", options={"allow_raw_vfw": "1"}) as container:
        streams = []
        for title in ("COLOR", depth, "IR"):
            stream = container.add_stream("rawvideo", rate=30)
            stream.width, stream.height, stream.pix_fmt, stream.metadata["title"] = width, height, "gray16be", title
            streams.append(stream)
        if calibration is not None:
            container.add_attachment("calibration.json", "application/octet-stream", json.dumps(calibration).encode())
        for i, image in enumerate(counts):
            for k, stream in zip((1, 0, 2), streams):
                packet = av.Packet((image + 100 * k).astype(">u2").tobytes())
                packet.pts = packet.dts = i
                packet.time_base, packet.stream, packet.is_keyframe = Fraction(1, 30), stream, True
                container.mux(packet)
    header = struct.pack("<IiiHHI", 40, width, -height, 1, 16, 0)
    data = path.read_bytes()
    assert data.count(header) == 3
    path.write_bytes(data.replace(header, struct.pack("<IiiHH4s", 40, width, height, 1, 16, b"b16g")))
    return path


@pytest.mark.skipif(not hasattr(av.container.OutputContainer, "add_attachment"), reason="this PyAV cannot attach")
def test_an_azure_kinect_recording(tmp_path):
    counts = np.random.default_rng(1).integers(500, 4000, (6, 288, 320)).astype(np.uint16)
    video = read_depth(azure(tmp_path / "a.mkv", counts), sensor="kinect")
    assert (len(video), video.size, video.rate) == (6, (320, 288), 30.0)
    for i in (0, 1, 5, 2, 3):
        np.testing.assert_allclose(video.frame(i).depth, counts[i] * 1e-3, rtol=1e-6)
    K = [[0.49 * 512, 0, 0.51 * 512 - 96.5], [0, 0.48 * 512, 0.52 * 512 - 90.5], [0, 0, 1]]
    np.testing.assert_allclose(video.camera.matrix, K)
    np.testing.assert_allclose(video.camera.distortion, [0.55, -0.02, 2e-5, -7e-5, -0.003, 0.89, 0.086, -0.014])
    assert read_depth(azure(tmp_path / "b.mkv", counts, None)).camera is None
    with pytest.raises(FileError, match="no depth track; its video tracks: COLOR, RANGE, IR"):
        read_depth(azure(tmp_path / "c.mkv", counts, depth="RANGE"))
    with pytest.raises(CalibrationError, match="cannot be understood"):
        read_depth(azure(tmp_path / "d.mkv", counts, {"CalibrationInformation": {"Cameras": []}}))
    with pytest.raises(CalibrationError, match="no depth mode"):
        read_depth(azure(tmp_path / "e.mkv", counts[:, :200]))


def test_a_colour_video_or_rubbish_is_no_depth(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
        container.mux(stream.encode())
    with pytest.raises(ObservationError, match="mpeg4 yuv420p, not depth"):
        read_depth(tmp_path / "a.mp4")
    (tmp_path / "b.mkv").write_bytes(b"nothing" * 100)
    with pytest.raises(FileError, match="not a readable video"):
        read_depth(tmp_path / "b.mkv")


def test_realsense_without_its_library_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(FileError, match=r"kinefit\[realsense\]"):
        read_depth(tmp_path / "a.bag")


class FakeRealsense(types.ModuleType):
    """As much of Intel's library as is used: plays five frames, once, and begins anew when it is started."""

    class distortion:
        brown_conrady, inverse = "brown", "inverse"

    class stream:
        depth = "depth"

    coeffs = (0.0,) * 5

    def config(self):
        return types.SimpleNamespace(enable_device_from_file=lambda file, repeat_playback: None)

    def pipeline(self):
        told = types.SimpleNamespace(
            fx=60.0, fy=61.0, ppx=31.0, ppy=23.0, width=64, height=48, model="inverse", coeffs=self.coeffs
        )
        stream = types.SimpleNamespace(get_intrinsics=lambda: told)
        video = types.SimpleNamespace(as_video_stream_profile=lambda: stream)
        device = types.SimpleNamespace(
            as_playback=lambda: types.SimpleNamespace(set_real_time=lambda on: None),
            first_depth_sensor=lambda: types.SimpleNamespace(get_depth_scale=lambda: 0.001),
        )
        frames = iter(enumerate(COUNTS))

        def wait(timeout):
            i, image = next(frames, (None, None))
            frame = types.SimpleNamespace(get_timestamp=lambda: 5000 + i * 1000 / 30, get_data=lambda: image)
            return i is not None, types.SimpleNamespace(get_depth_frame=lambda: frame)

        profile = types.SimpleNamespace(get_stream=lambda kind: video, get_device=lambda: device)
        return types.SimpleNamespace(start=lambda config: profile, stop=lambda: None, try_wait_for_frames=wait)


def test_a_realsense_recording(tmp_path, monkeypatch):
    fake = FakeRealsense("pyrealsense2")
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    (tmp_path / "a.bag").touch()
    video = read_depth(tmp_path / "a.bag")
    np.testing.assert_allclose(video.times, np.arange(5) / 30, atol=1e-9)
    for i in (0, 1, 4, 2, 3):
        np.testing.assert_allclose(video.frame(i).depth, METRES[i], rtol=1e-6)
    np.testing.assert_array_equal(video.camera.matrix, [[60, 0, 31], [0, 61, 23], [0, 0, 1]])
    fake.coeffs = (0.1, 0, 0, 0, 0)
    with pytest.raises(CalibrationError, match="lens model inverse"):
        read_depth(tmp_path / "a.bag")


def test_times_from_names_and_their_gaps(tmp_path):
    png(tmp_path / "a", [f"cam2_{t}.png" for t in (1_000_033, 1_000_066, 1_000_100, 1_000_200, 1_000_233)])
    video = read_depth(tmp_path / "a", time_unit=0.001, time_offset=2.0)
    np.testing.assert_allclose(video.times, [2.0, 2.033, 2.067, 2.167, 2.2])
    assert video.rate == pytest.approx(30, rel=0.02)
    assert video.gaps.tolist() == [3]
    with pytest.raises(ObservationError, match=r"give 29\.85 Hz, not 15 Hz"):
        read_depth(tmp_path / "a", time_unit=0.001, rate=15)
    with pytest.raises(ObservationError, match="its rate is not stated"):
        read_depth(tmp_path / "a", default_rate=None)


@pytest.mark.parametrize(("times", "frame"), [([0, 1, 1, 2, 3], 2), ([0, 3, 2, 4, 5], 2), ([0, 1, 2, np.nan, 4], 3)])
def test_times_that_do_not_increase_name_the_frame(tmp_path, times, frame):
    with pytest.raises(ObservationError, match="do not increase") as caught:
        read_depth(npz(tmp_path / "a.npz", times=np.array(times, float)))
    assert caught.value.place == f"frame {frame}"


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: read_depth(p / "nothing"), "no such file or folder"),
        (lambda p: read_depth(p), "it holds no files"),
        (lambda p: read_depth(png(p / "a"), unit=1.0), r"probably millimetres.*unit = 0.001"),
        (lambda p: read_depth(npz(p / "a.npz", depth=METRES), unit=0.001), r"0.001 m a count is wrong.*unit = 1 "),
        (lambda p: read_depth(png(p / "a"), unit=-1), "a unit of -1 m"),
        (lambda p: read_depth(png(p / "a"), range=(5, 9)), r"nothing lies within.*depths go from 0\.8\d* to 2\.9"),
        (lambda p: read_depth(png(p / "a"), range=(3, 2)), "range 3 to 2 m"),
        (lambda p: read_depth(png(p / "a", counts=0 * COUNTS)), "no frame has a depth value"),
        (lambda p: read_depth(png(p / "a", counts=COUNTS // 256 * 0 + 65535)), "no frame has a depth value"),
        (lambda p: read_depth(npz(p / "a.npz", depth=METRES * np.nan)), "no frame has a depth value"),
        (lambda p: read_depth(png(p / "a", counts=COUNTS.astype(np.uint8))), "8 bits in 1 channel"),
        (lambda p: read_depth(raw(p / "a")), "without a stated image size"),
        (lambda p: read_depth(raw(p / "a"), size=(64, 50)), "6144 bytes, but 64x50 px of 16 bits are 6400"),
        (lambda p: read_depth(npz(p / "a.npz", depth=np.zeros(4))), r"`depth` has shape \(4,\)"),
        (lambda p: read_depth(npz(p / "a.npz", times=np.arange(4))), r"\(4,\) times for 5 frames"),
        (lambda p: read_depth(npz(p / "a.npz", unit=np.ones(2))), "`unit` is not a number"),
        (lambda p: read_depth(npz(p / "a.npz"), rate=0.0 - 3), "rate -3 Hz"),
        (lambda p: read_depth(npz(p / "a.npz"), time_offset=np.nan), "offset nan s"),
        (lambda p: read_depth(png(p / "a", ["a.png", "b.png", "c.tif"])), "several kinds: .png, .tif"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, make, words):
    with pytest.raises(KinefitError, match=words) as caught:
        make(tmp_path)
    assert caught.value.file is not None and caught.value.remedy


def test_one_damaged_or_odd_frame_is_named_when_it_is_asked_for(tmp_path):
    folder = png(tmp_path / "a", [f"{i:02}.png" for i in range(9)], [*COUNTS, *COUNTS[:4]])
    video = read_depth(folder)
    (folder / "01.png").write_bytes((folder / "01.png").read_bytes()[:40])
    cv2.imwrite(str(folder / "03.png"), COUNTS[0][:20])
    with pytest.raises(FileError, match=r"01\.png"):
        video.frame(1)
    with pytest.raises(ObservationError, match=r"frame 3 of a: the image has \(64, 20\) px, its camera \(64, 48\)"):
        video.frame(3)
    np.testing.assert_allclose(video.frame(2).depth, METRES[2], rtol=1e-6)


def test_the_range_is_gated_and_empty_frames_are_frames():
    images = np.array([[[0.3, 1.0, 5.0, np.nan]], [[0, 0, 0, 0]]])
    video = DepthVideo("s", 30.0, [0, 1 / 30], (4, 1), lambda i: images[i], near=0.5, far=2.0)
    np.testing.assert_array_equal(video.frame(0).depth, [[0, 1, 0, 0]])
    np.testing.assert_array_equal(video.frame(1).depth, [[0, 0, 0, 0]])
    with pytest.raises(IndexError):
        video.frame(2)


def test_a_body_that_is_seldom_there_is_enough(tmp_path):
    counts = np.zeros((30, 48, 64), np.uint16)
    counts[17, 20:30, 20:30] = 2000
    video = read_depth(png(tmp_path / "a", [f"{i}.png" for i in range(30)], counts))
    assert video.frame(17).depth.max() == 2.0 and not video.frame(0).depth.any()


def test_every_frame_counts_at_one_step_alone():
    slow = DepthVideo("s", 15.0, 0.01 + np.arange(6) / 15, (1, 1), lambda i: np.ones((1, 1)))
    assert [slow.at_step(step, 30.0) for step in range(-1, 12)] == [
        None, 0, None, 1, None, 2, None, 3, None, 4, None, 5, None]  # fmt: skip
    fast = DepthVideo("s", 60.0, np.arange(6) / 60, (1, 1), lambda i: np.ones((1, 1)))
    assert [fast.at_step(step, 30.0) for step in range(4)] == [0, 2, 4, 5]
    assert [slow.nearest(t) for t in (-0.1, 0.0, 0.05, 0.2, 0.5)] == [0, 0, 1, 3, 5]


def test_the_background_must_fit():
    empty = DepthVideo("s", 30.0, [0], (2, 2), lambda i: np.ones((2, 2)), source="empty")
    with pytest.raises(ObservationError, match=r"background of s has \(2, 2\) px"):
        DepthVideo("s", 30.0, [0], (4, 1), lambda i: np.ones((1, 4)), background=empty)


def test_clouds_without_order(tmp_path):
    x = np.random.default_rng(2).normal(size=(50, 3)) + (0, 0, 3)
    for i in range(3):
        cloud(tmp_path / f"{i}.pcd", 1000 * (x + (i, 0, 0)), 50)
    assert is_unordered(tmp_path) and not is_unordered(organised(tmp_path / "o"))
    with pytest.raises(ObservationError, match="without the rows of an image"):
        read_depth(tmp_path)
    with pytest.raises(ObservationError, match="probably millimetres"):
        read_clouds(tmp_path)
    T = np.eye(4)
    T[:3, 3] = (0, 0, 7)
    clouds = read_clouds(tmp_path, unit=0.001, sensor="s", T_world_sensor=T, range=(0, 4.5))
    assert isinstance(clouds, CloudVideo) and len(clouds) == 3
    frame, kept = clouds.frame(1), np.linalg.norm(x + (1, 0, 0), axis=1) <= 4.5
    np.testing.assert_allclose(frame.points, (x + (1, 0, 7))[kept], atol=1e-5)
    np.testing.assert_array_equal(frame.viewpoint, (0, 0, 7))
    with pytest.raises(FileError, match="no clouds"):
        read_clouds(png(tmp_path / "p"))


def test_real_recordings(data_dir):
    folder = data_dir("depth_sr305_upperbody") / "20210326-231615"
    video = read_depth(folder, unit=0.000125, time_unit=1 / 60)
    assert len(video) == 11 and video.size == (640, 480)
    np.testing.assert_allclose(video.times * 60, [0, 20, 40, 60, 80, 100, 140, 160, 180, 200, 220])
    assert video.gaps.tolist() == [6]  # the one that the recording leaves out
    assert 0.5 < np.median(video.frame(0).depth[video.frame(0).depth > 0]) < 1.0
    with pytest.raises(ObservationError, match="nothing lies within the range"):
        read_depth(folder, unit=0.000125, range=(2, 4))


WALL = np.tile(np.linspace(2.0, 3.0, 64), (48, 1))  # [m]


@pytest.mark.parametrize(("counts", "unit", "said"), [
    (1000 * WALL, 0.001, ""),
    (8 * np.rint(1000 * WALL), 0.000125, "multiples of 8.*8 mm would be 0.001"),
    (8 * np.rint(1000 * WALL) + (np.arange(64) > 50) * 3, 0.000125, "multiples of 8"),  # a person's number
    (5000 * WALL, 0.001, "median is 12.5 m.*A hall looks so.*0.0002"),
])  # fmt: skip
def test_a_unit_that_no_file_states_is_found_or_doubted(tmp_path, counts, unit, said):
    video = read_depth(png(tmp_path / "d", [f"{i}.png" for i in range(3)], np.rint([counts] * 3).astype(np.uint16)))
    assert np.allclose(video.frame(0).depth, np.rint(counts) * unit, rtol=1e-5)
    assert re.search(said, " ".join(video.notes)) and bool(said) == bool(video.notes)
    assert not read_depth(tmp_path / "d", unit=0.0002).notes  # stated


def test_a_list_beside_states_the_unit_and_names_are_times(tmp_path):
    names = [f"1305031102.{k}60407.png" for k in range(1, 5)]
    png(tmp_path / "depth", names, np.rint([5000 * WALL] * 4).astype(np.uint16))
    (tmp_path / "depth.txt").write_text("# timestamp filename\n1305031102.160407 depth/1305031102.160407.png\n")
    video = read_depth(tmp_path / "depth", rate=30.0)  # of the camera, of which every third frame is there
    assert np.allclose(video.frame(0).depth, WALL, atol=1e-3) and np.allclose(np.diff(video.times), 0.1, atol=1e-5)
    assert abs(video.rate - 10.0) < 0.01 and "unit = 0.0002 is taken" in " ".join(video.notes)
    assert np.allclose(read_depth(tmp_path / "depth", time_unit=1.0).times, 0.1 * np.arange(4))
    with pytest.raises(ObservationError, match="give 10 Hz, not 25 Hz"):
        read_depth(tmp_path / "depth", rate=25.0)


@pytest.mark.parametrize(("kind", "said"), [("<f2", "float16"), ("<f4", "float32"), ("<u2", "")])
def test_raw_numbers_are_counts_or_metres(tmp_path, kind, said):
    (tmp_path / "d").mkdir()
    for i in range(3):
        (WALL if "f" in kind else 1000 * WALL).astype(kind).tofile(tmp_path / "d" / f"{i}.bin")
    video = read_depth(tmp_path / "d", size=SIZE)
    assert np.allclose(video.frame(2).depth, WALL, atol=2e-3)
    assert said in " ".join(video.notes) and bool(said) == bool(video.notes)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_one_numpy_file_a_frame(tmp_path, scale):
    for i in range(3):
        np.save(tmp_path / f"{5 * i}.npy", (scale * WALL).astype(np.float32 if scale == 1.0 else np.uint16))
    video = read_depth(tmp_path)
    assert np.allclose(video.frame(2).depth, WALL, atol=1e-3) and np.allclose(video.times, np.arange(3) / 6.0)
    np.save(tmp_path / "9.npy", np.zeros(4))
    with pytest.raises(ObservationError, match=r"shape \(4,\).*\(height, width\)"):
        read_depth(tmp_path / "9.npy")


def test_noise_is_doubted_and_clouds_step_too(tmp_path):
    assert "infrared" in " ".join(read_depth(png(tmp_path / "a")).notes)
    for i in (0, 3, 6):
        cloud(tmp_path / f"c{i}.pcd", np.random.default_rng(i).normal((0, 0, 2), 0.1, (20, 3)), 20)
    clouds = read_clouds(tmp_path / "c*.pcd", rate=30.0)
    assert np.allclose(clouds.times, [0.0, 0.1, 0.2]) and "step by 3" in clouds.notes[0]
