"""Sizes of images by their headers: as the decoder has them, and before the decoder is called."""

import io
import struct
import zlib

import av
import cv2
import numpy as np
import pytest
from benchmarks.scenes.bags import Bag
from benchmarks.scenes.large_images import jpeg, png

from kinefit._image_headers import MAX_IMAGE_PIXELS, image_sizes
from kinefit._pictures import read_picture
from kinefit.errors import CalibrationError, FileError
from kinefit.geometry.camera import Camera
from kinefit.readers.depth.recordings import read_depth
from kinefit.readers.videos.video import Video
from kinefit.sensors.kinds.silhouettes import read_silhouettes
from kinefit.studio.live.cameras import SessionClock
from kinefit.studio.live.folders import ImageFolderStream

PICTURE = np.random.default_rng(0).integers(0, 255, (19, 37, 3), np.uint8)
KINDS = [
    (".png", []), (".jpg", []), (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]), (".bmp", []), (".gif", []),
    (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]), (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]), (".ppm", []), (".pgm", []),
    (".pbm", []), (".tiff", []), (".tiff", [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_LZW]),
]  # fmt: skip


def encoded(ending, options=()):
    image = PICTURE[..., 0] if ending in (".pgm", ".pbm") else PICTURE
    return cv2.imencode(ending, image, list(options))[1].tobytes()


@pytest.mark.parametrize(("ending", "options"), KINDS)
def test_sizes_are_those_of_the_decoder_and_no_cut_header_raises(tmp_path, ending, options):
    data = encoded(ending, options)
    assert image_sizes(io.BytesIO(data)) == [(37, 19)]
    (tmp_path / f"a{ending}").write_bytes(data)
    assert read_picture(tmp_path / f"a{ending}").shape == (19, 37, 3)
    for length in range(min(len(data), 1200)):
        assert image_sizes(io.BytesIO(data[:length])) in ([], [(37, 19)])


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_every_page_of_a_tiff_has_its_size(order, big):
    word, count, head = ("Q", "Q", 16) if big else ("I", "H", 8)
    data = bytearray((b"II" if order == "<" else b"MM") + struct.pack(order + "H", 43 if big else 42))
    data += struct.pack(order + "HHQ", 8, 0, head) if big else struct.pack(order + "I", head)
    sizes = [(5, 7), (70_000, 3)]
    for i, (width, height) in enumerate(sizes):
        data += struct.pack(order + count, 2)
        for tag, value in ((256, width), (257, height)):
            data += struct.pack(order + "HH" + 2 * word, tag, 4, 1, 0)[: -struct.calcsize(word)]
            data += struct.pack(order + "I", value) + bytes(4 * big)
        data += struct.pack(order + word, 0 if i else len(data) + struct.calcsize(word))
    assert image_sizes(io.BytesIO(data)) == sizes
    data[-struct.calcsize(word) :] = struct.pack(order + word, head)  # pages in a circle
    assert image_sizes(io.BytesIO(data)) == []


def test_tiles_count_where_they_are_larger_than_the_image():
    tags = [(256, 4), (257, 4), (322, 60_000), (323, 50_000)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    data = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)
    assert image_sizes(io.BytesIO(data)) == [(60_000, 50_000)]


@pytest.fixture
def no_decoder(monkeypatch):
    """Decoders that fail the test where they are asked for pixels."""
    for name in ("imdecode", "imread", "imreadmulti"):
        monkeypatch.setattr(cv2, name, lambda *_, **__: pytest.fail("a decoder would reserve gigabytes"))


SIDE = 12_000
LARGE = f"{SIDE} x {SIDE} px, more than {MAX_IMAGE_PIXELS // 10**6} million"


def _tiff(side):
    data = bytearray(cv2.imencode(".tiff", np.zeros((16, 16), np.uint16))[1].tobytes())
    for tag in (256, 257):
        struct.pack_into("<HII", data, data.find(struct.pack("<HH", tag, 3)) + 2, 4, 1, side)
    return bytes(data)


BOMBS = [("0.png", png), ("0.jpg", jpeg), ("0.tif", _tiff)]


@pytest.mark.parametrize(("name", "make"), BOMBS)
def test_no_reader_decodes_an_image_that_is_too_large(tmp_path, no_decoder, name, make):
    path = tmp_path / name
    path.write_bytes(make(SIDE))
    reads = [
        lambda: read_silhouettes(path, camera="a", rate=30.0, size=(64, 48)).image(0),
        lambda: read_picture(path, cv2.IMREAD_UNCHANGED),
    ]  # fmt: skip
    if name.endswith((".png", ".tif")):
        reads.append(lambda: read_depth(path))
    if name.endswith((".png", ".jpg")):
        reads.append(lambda: Video(tmp_path, rate=30.0))
    for read in reads:
        with pytest.raises(FileError, match=LARGE) as error:
            read()
        assert error.value.file == path and error.value.remedy
    if name.endswith((".png", ".jpg")):
        stream = ImageFolderStream("a", tmp_path, (64, 48), SessionClock())
        assert stream.read(path, 0.0) is None  # dropped, as every image of a live folder that cannot be read


def test_later_pages_count_too(tmp_path, no_decoder):
    pages = cv2.imencodemulti(".tiff", [np.full((16, 16), 1000, np.uint16)] * 2)[1].tobytes()
    data = bytearray(pages)
    second = data.rfind(struct.pack("<HH", 256, 3))
    for place in (second, second + 12):
        struct.pack_into("<HII", data, place + 2, 4, 1, SIDE)
    assert image_sizes(io.BytesIO(data)) == [(16, 16), (SIDE, SIDE)]
    (tmp_path / "a.tiff").write_bytes(data)
    with pytest.raises(FileError, match=LARGE):
        read_depth(tmp_path / "a.tiff")


def test_compressed_images_of_a_recording_count_too(tmp_path, no_decoder):
    pytest.importorskip("rosbags.rosbag2")
    pytest.importorskip("mcap_ros2")
    bag = Bag()
    for k in range(2):
        message = bag.image("jpeg", np.zeros((16, 16, 3), np.uint8), 10**9 + k * 10**8)
        message.data = np.frombuffer(jpeg(SIDE), np.uint8)
        bag.messages.append(("/a/image", message, 10**9 + k * 10**8))
        counts = bag.image("16UC1 png", np.zeros((16, 16), np.uint16), 10**9 + k * 10**8)
        counts.data = np.concatenate([np.zeros(12, np.uint8), np.frombuffer(png(SIDE, 16), np.uint8)])
        bag.messages.append(("/b/depth", counts, 10**9 + k * 10**8))
    file = bag.write(tmp_path / "bag")
    for read in (lambda: Video(file / "a/image"), lambda: read_depth(file / "b/depth")):
        with pytest.raises(FileError, match=LARGE):
            read()


def test_images_of_other_kinds_are_refused_by_name(tmp_path, no_decoder):
    for head in (b"\0\0\0\x0cjP  \r\n\x87\n", b"#?RADIANCE\n", b"\x59\xa6\x6a\x95", b"text"):
        (tmp_path / "a.png").write_bytes(head + bytes(100))
        with pytest.raises(FileError, match="kinefit reads PNG, JPEG"):
            read_picture(tmp_path / "a.png")


def _video(path, codec, kind, frames=3):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, kind
        shape, dtype = ((48, 64), np.uint16) if kind == "gray16le" else ((48, 64, 3), np.uint8)
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full(shape, 1000 % 256, dtype), format=kind)))
        container.mux(stream.encode())
    return path


def test_a_video_whose_header_states_frames_that_are_too_large_is_refused(tmp_path):
    path = _video(tmp_path / "a.avi", "ffv1", "gray16le")
    data = path.read_bytes()
    assert data.count(struct.pack("<ii", 64, 48)) >= 1
    path.write_bytes(data.replace(struct.pack("<ii", 64, 48), struct.pack("<ii", SIDE, SIDE)))
    for read in (Video, read_depth):
        with pytest.raises(FileError, match="more than 110 million"):
            read(path)


def test_a_frame_that_is_larger_than_the_video_states_is_not_decoded(tmp_path):
    path = _video(tmp_path / "a.avi", "png", "rgb24")
    data, good = path.read_bytes(), path.read_bytes()
    at = data.rfind(b"IHDR")  # of the last frame: its header says another size, its sum is right
    head = b"IHDR" + struct.pack(">II", SIDE, SIDE) + data[at + 12 : at + 17]
    path.write_bytes(data[:at] + head + struct.pack(">I", zlib.crc32(head)) + good[at + 21 :])
    with Video(path) as video:
        assert video.size == (64, 48)
        with pytest.raises(FileError, match="frame 2"):
            video.read(2)


def test_a_camera_of_more_pixels_than_any_image_is_refused():
    K = [[50, 0, 32], [0, 50, 24], [0, 0, 1]]
    with pytest.raises(CalibrationError, match=r"image size \(1048576, 1048576\)"):
        Camera("a", (2**20, 2**20), K)


@pytest.mark.parametrize("offset", [1_700_000_000_000_000_000, 2**63, 2**64 - 1])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_page_of_a_bigtiff_beyond_all_files_is_no_image(offset, order):
    start = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HHHQ", 43, 8, 0, offset)
    assert image_sizes(io.BytesIO(start)) == []
