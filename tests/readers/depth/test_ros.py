"""Depth in MCAP of ROS 2, written by rosbags, which shares no code with what reads it."""

import sys

import cv2
import numpy as np
import pytest

from kinefit import read_depth
from kinefit.errors import CalibrationError, FileError, ObservationError

rosbag2 = pytest.importorskip("rosbags.rosbag2")
pytest.importorskip("mcap_ros2")

COUNTS = np.array([np.arange(12).reshape(3, 4) * 100 + 1000 + k for k in range(4)], np.uint16)
K = [60.0, 0, 1.5, 0, 61.0, 1.0, 0, 0, 1]


@pytest.fixture
def record(tmp_path):
    """Write a recording of images {topic: (encoding, images)}; returns its file."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types

    def header(ns):
        stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")

    def image(encoding, array, ns):
        if encoding.endswith("png"):
            data = np.concatenate([np.zeros(12, np.uint8), cv2.imencode(".png", array)[1].ravel()])
            kind = "16UC1; compressedDepth png"
            return types["sensor_msgs/msg/CompressedImage"](header=header(ns), format=kind, data=data)
        big = encoding.endswith(">")
        raw = array.astype(array.dtype.newbyteorder(">" if big else "<"))
        rows = raw.view(np.uint8).reshape(len(array), -1)
        rows = np.pad(rows, ((0, 0), (0, 4)))  # rows may be longer than the image
        return types["sensor_msgs/msg/Image"](
            header=header(ns), height=array.shape[0], width=array.shape[1], encoding=encoding.rstrip(">"),
            is_bigendian=int(big), step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip

    def info(model, lens, size=(4, 3)):
        roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return types["sensor_msgs/msg/CameraInfo"](
            header=header(0), height=size[1], width=size[0], distortion_model=model, d=np.array(lens, float),
            k=np.array(K), r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    def write(images, infos=None, stamped=True):
        folder = tmp_path / "bag"
        with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as out:
            for topic, (encoding, arrays) in images.items():
                messages = [image(encoding, a, 5 * 10**9 + k * 10**8 if stamped else 0) for k, a in enumerate(arrays)]
                connection = out.add_connection(topic, messages[0].__msgtype__, typestore=store)
                for k, message in enumerate(messages):
                    data = store.serialize_cdr(message, message.__msgtype__)
                    out.write(connection, 7 * 10**9 + k * 2 * 10**8, data)
            for topic, (model, lens, *size) in (infos or {}).items():
                message = info(model, lens, *size)
                connection = out.add_connection(topic, message.__msgtype__, typestore=store)
                out.write(connection, 7 * 10**9, store.serialize_cdr(message, message.__msgtype__))
        (file,) = folder.glob("*.mcap")
        return file

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
    with pytest.raises(ObservationError, match="2 topics have depth images: /left/depth, /right/depth"):
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
