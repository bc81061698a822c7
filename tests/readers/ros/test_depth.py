"""Depth in MCAP of ROS 2, written by rosbags, which shares no code with what reads it."""

import gc
import sys
import warnings

import numpy as np
import pytest
from benchmarks.scenes.bags import START, Bag

from kinefit.errors import CalibrationError, FileError, ObservationError
from kinefit.readers import read_depth

pytest.importorskip("rosbags.rosbag2")
pytest.importorskip("mcap_ros2")

COUNTS = np.array([np.arange(12).reshape(3, 4) * 100 + 1000 + k for k in range(4)], np.uint16)
K = [60.0, 0, 1.5, 0, 61.0, 1.0, 0, 0, 1]


@pytest.fixture
def record(tmp_path):
    """Write a recording of images {topic: (encoding, images)}; returns its file."""

    def write(images, infos=None, stamped=True):
        bag = Bag()
        for topic, (encoding, arrays) in images.items():
            bag.images(topic, encoding, arrays, stamped=stamped)
        for topic, (model, lens, *size) in (infos or {}).items():
            bag.info(topic, K, *(size or [(4, 3)]), model=model, lens=lens)
        return bag.write(tmp_path / "bag")

    return write


@pytest.mark.parametrize(("encoding", "images"), [
    ("16UC1", COUNTS), ("16UC1>", COUNTS), ("16UC1 png", COUNTS), ("32FC1", (COUNTS * 0.001).astype(np.float32)),
])  # fmt: skip
def test_depth_with_its_times_and_lens(record, encoding, images):
    colour = {"/front/color/image_raw": ("rgb8", np.zeros((1, 3, 12), np.uint8))}
    infos = {"/front/depth/camera_info": ("plumb_bob", (0.1, 0.01, 0, 0, 0)), "/camera_info": ("fisheye", ())}
    video = read_depth(record({"/front/depth/image_raw": (encoding, images), **colour}, infos), sensor="tof")
    assert video.size == (4, 3) and video.rate == pytest.approx(10.0)
    np.testing.assert_allclose(video.times, np.arange(4) * 0.1, atol=1e-9)
    for i in (0, 3, 1, 2):
        np.testing.assert_allclose(video.frame(i).depth, COUNTS[i] * 0.001, rtol=1e-6)
    np.testing.assert_array_equal(np.ravel(video.camera.matrix), K)
    assert video.camera.name == "tof" and list(video.camera.distortion)[:2] == [0.1, 0.01]


def test_times_of_the_recording_where_headers_tell_none(record):
    video = read_depth(record({"/depth": ("16UC1", COUNTS)}, stamped=False))
    np.testing.assert_allclose(video.times, np.arange(4) * 0.2, atol=1e-9)
    assert video.camera is None


def test_of_two_cameras_the_name_says_which(record):
    file = record({"/left/depth": ("16UC1", COUNTS), "/right/depth": ("16UC1", COUNTS[::-1])})
    np.testing.assert_allclose(read_depth(file, sensor="right").frame(0).depth, COUNTS[3] * 0.001, rtol=1e-6)
    with pytest.raises(ObservationError, match=r"2 topics have depth images .*: /left/depth, /right/depth"):
        read_depth(file)


def test_what_is_no_depth_is_told(record):
    with pytest.raises(ObservationError, match="no topic of it has depth images"):
        read_depth(record({"/infra": ("mono16", COUNTS)}))


@pytest.mark.parametrize("info", [("equidistant", (0.1, 0, 0, 0)), ("plumb_bob", (), (8, 6))])
def test_a_lens_that_is_not_its_own_is_told(record, info):
    with pytest.raises(CalibrationError, match="its images have 4x3 px"):
        read_depth(record({"/depth/image": ("16UC1", COUNTS)}, {"/depth/camera_info": info}))


def test_damaged_files_are_told(record, tmp_path, monkeypatch):
    whole = record({"/depth": ("16UC1", COUNTS)}).read_bytes()
    rng = np.random.default_rng(0)
    for k in range(60):
        data = bytearray(whole if k % 3 else whole[: rng.integers(len(whole))])
        for at in rng.integers(len(data), size=5) if data else ():
            data[at] = rng.integers(256)
        (tmp_path / "a.mcap").write_bytes(data)
        try:
            read_depth(tmp_path / "a.mcap")
        except (FileError, ObservationError, CalibrationError) as error:
            assert len(str(error)) < 600
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(FileError, match=r"kinefit\[ros\]"):
        read_depth(tmp_path / "a.mcap")


def test_a_forgotten_file_is_closed(record):
    file = record({"/depth": ("16UC1", COUNTS)})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(8):
            held = [read_depth(file)]
            gc.collect(0)
            held.append(held)  # as the frames of an exception that was raised within
            del held
            gc.collect()
    assert not said


METRES = (COUNTS * 0.001).astype(np.float32)


def test_inverse_depth_is_unpacked(record):
    video = read_depth(record({"/depth": ("32FC1 png", METRES)}))
    np.testing.assert_allclose(video.frame(2).depth, METRES[2], rtol=2e-4)  # steps of 1 in 10,000


def test_a_topic_is_named_in_the_path(record):
    file = record({"/left/depth": ("16UC1", COUNTS), "/right/depth": ("16UC1", COUNTS[::-1])})
    for place in (file / "right" / "depth", file.parent / "right" / "depth"):  # of the file, or of its folder
        np.testing.assert_allclose(read_depth(place).frame(0).depth, COUNTS[3] * 0.001, rtol=1e-6)
    with pytest.raises(ObservationError, match=r"no topic /front/depth; .*: /left/depth, /right/depth"):
        read_depth(file / "front" / "depth")


def test_a_topic_of_another_kind_or_encoding_is_told(record):
    colour = np.zeros((1, 3, 4, 3), np.uint8)
    file = record({"/depth": ("16UC1", COUNTS), "/color": ("rgb8", colour), "/odd": ("16UC1 rvl", COUNTS)})
    with pytest.raises(ObservationError, match="/color has images of rgb8, no depth"):
        read_depth(file / "color")
    with pytest.raises(ObservationError, match="16UC1, 32FC1"):
        read_depth(file / "odd")


def test_topics_of_one_recording_share_their_clock(tmp_path):
    bag = Bag().images("/a/depth", "16UC1", COUNTS).images("/b/depth", "16UC1", COUNTS, start=START + 25 * 10**6)
    file = bag.write(tmp_path / "bag")
    np.testing.assert_allclose(read_depth(file / "a/depth").times, np.arange(4) * 0.1, atol=1e-9)
    np.testing.assert_allclose(read_depth(file / "b/depth").times, 0.025 + np.arange(4) * 0.1, atol=1e-9)


def test_rectified_images_have_the_lens_of_p(tmp_path):
    P = np.array([[50.0, 0, 1, 0], [0, 51.0, 1, 0], [0, 0, 1, 0]])
    bag = Bag().images("/tof/image_rect", "16UC1", COUNTS).images("/raw/image_raw", "16UC1", COUNTS)
    for folder in ("tof", "raw"):
        bag.info(f"/{folder}/camera_info", K, (4, 3), lens=(0.1, 0.01, 0, 0, 0), P=P)
    file = bag.write(tmp_path / "bag")
    rectified, raw = (read_depth(file / topic).camera for topic in ("tof/image_rect", "raw/image_raw"))
    np.testing.assert_array_equal(rectified.matrix, P[:, :3])
    assert not len(rectified.distortion) and len(raw.distortion) == 5 and raw.matrix[0, 0] == 60.0


def test_sqlite_and_split_recordings_are_told(tmp_path):
    file = Bag().images("/depth", "16UC1", COUNTS).write(tmp_path / "bag", "SQLITE3")
    for place in (file, file.parent, file / "depth"):
        with pytest.raises(FileError, match="SQLite, which is not read.*bag convert"):
            read_depth(place)
    file = Bag().images("/depth", "16UC1", COUNTS).write(tmp_path / "two")
    (file.parent / "two_1.mcap").write_bytes(file.read_bytes())
    with pytest.raises(FileError, match="a recording in 2 files"):
        read_depth(file.parent)
