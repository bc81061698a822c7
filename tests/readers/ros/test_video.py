"""Images of topics as videos: encodings, times, what is refused."""

import numpy as np
import pytest
from benchmarks.bags import START, Bag

from kinefit.errors import FileError, ObservationError
from kinefit.readers.videos.video import Video

pytest.importorskip("rosbags.rosbag2")
pytest.importorskip("mcap_ros2")

RGB = np.array([np.add.outer(np.arange(6), np.arange(8))[..., None] * (5, 9, 3) + 10 * k for k in range(4)], np.uint8)
GREY = RGB[..., 0]


@pytest.mark.parametrize(("encoding", "images", "expected", "within"), [
    ("rgb8", RGB, RGB, 0), ("bgr8", RGB[..., ::-1], RGB, 0), ("mono8", GREY, np.repeat(GREY[..., None], 3, -1), 0),
    ("rgba8", np.pad(RGB, ((0, 0), (0, 0), (0, 0), (0, 1))), RGB, 0), ("jpeg", RGB, RGB, 12),
])  # fmt: skip
def test_images_of_every_encoding(tmp_path, encoding, images, expected, within):
    file = Bag().images("/front/color", encoding, images).write(tmp_path / "bag")
    with Video(file / "front" / "color") as video:
        assert len(video) == 4 and video.size == (8, 6) and video.rate == pytest.approx(10.0)
        for i in (0, 3, 1, 2):
            assert np.abs(video.read(i).astype(int) - expected[i]).max() <= within


@pytest.mark.parametrize(("pattern", "first"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))])
def test_a_red_wall_stays_red_through_a_bayer_pattern(tmp_path, pattern, first):
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[first[0] :: 2, first[1] :: 2] = 200  # red is seen by every fourth pixel
    file = Bag().images("/c", f"bayer_{pattern}8", [mosaic] * 2).write(tmp_path / "bag")
    with Video(file) as video:
        assert video.read(0)[3:5, 3:5].reshape(-1, 3).mean(axis=0) == pytest.approx((200, 0, 0), abs=1)


def test_an_image_that_was_dropped_is_shown_by_its_neighbour_and_the_clock_goes_on(tmp_path):
    bag = Bag()
    for k in (0, 1, 2, 4):
        bag.images("/c", "mono8", [GREY[min(k, 3)]], start=START + k * 10**8)
    with Video(bag.write(tmp_path / "bag")) as video:
        assert [int(video.read(i)[0, 0, 0]) for i in range(5)] == [GREY[k][0, 0] for k in (0, 1, 2, 2, 3)]


def test_videos_of_one_recording_are_in_step(tmp_path):
    bag = Bag().images("/a", "mono8", GREY).images("/b", "mono8", GREY[1:], start=START + 10**8)
    file = bag.write(tmp_path / "bag")
    with Video(file / "a") as a, Video(file / "b") as b:
        assert len(a) == len(b) == 4 and np.array_equal(a.times, b.times)
        assert np.array_equal(b.read(2), a.read(2))


def test_what_is_no_video_is_told(tmp_path):
    depth = np.full((6, 8), 1000, np.uint16)
    bag = Bag().images("/a", "mono8", GREY).images("/b", "mono8", GREY).images("/d", "16UC1", [depth])
    late = START + 3 * 10**9
    file = bag.images("/late", "mono8", GREY, start=late).images("/odd", "yuv422", RGB[..., :2]).write(tmp_path / "bag")
    for topic, error, told in (
        ("", ObservationError, "3 topics have images in colour or grey: /a, /b, /late"),
        ("c", ObservationError, r"no topic /c; .*: /a, /b, /late"),
        ("d", ObservationError, "/d has images of 16UC1, no image"), ("odd", ObservationError, "images of yuv422"),
        ("late", ObservationError, r"no image on the topic /late from 0.00 to 3.00 s"),
    ):  # fmt: skip
        with pytest.raises(error, match=told):
            Video(file / topic)
    with pytest.raises(FileError, match="no such video"):
        Video(tmp_path / "nothing.mcap")
