"""Videos are read frame-exactly, upright and in step; damaged ones are refused with what can be read."""

from collections.abc import Mapping
from contextlib import ExitStack
from fractions import Fraction
from types import SimpleNamespace

import av
import numpy as np
import pytest

from kinefit.errors import FileError, ObservationError
from kinefit.readers.videos.video import Video, common_frames
from kinefit.readers.videos.video_files import _display_axes, first_image, stated_time_code

COUNT, WIDTH, HEIGHT = 40, 160, 96
MATRICES = {  # a, b, c, d of the display matrix: what FFmpeg 9 shows of it
    (1, 0, 0, 1): lambda image: image,
    (0, 1, -1, 0): lambda image: np.rot90(image, -1),
    (-1, 0, 0, -1): lambda image: np.rot90(image, 2),
    (0, -1, 1, 0): np.rot90,
    (-1, 0, 0, 1): np.fliplr,
    (1, 0, 0, -1): np.flipud,
    (0, 1, 1, 0): lambda image: image.transpose(1, 0, 2),
    (0, -1, -1, 0): lambda image: np.rot90(image, 2).transpose(1, 0, 2),
}


def picture(i):
    """Bars that spell the number `i` in binary from the left, the upper half dark."""
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    for bit in range(8):
        image[HEIGHT // 2 :, bit * 20 : bit * 20 + 20] = 230 if i >> bit & 1 else 90
    return image


def number(image):
    return sum(1 << bit for bit in range(8) if image[-20, bit * 20 + 10].mean() > 160)


def write(path, count=COUNT, rate=30, codec="mpeg4", **options):
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"} if "tags" in options else {}) as container:
        container.metadata.update(options.get("tags", {}))
        stream = container.add_stream(codec, rate=rate)
        if options.get("timecode"):
            stream.metadata["timecode"] = options["timecode"]
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, options.get("pixels", "yuv420p")
        stream.codec_context.gop_size = 12
        stream.codec_context.max_b_frames = options.get("b_frames", 2)
        pts = options.get("pts", range(count))
        stream.codec_context.time_base = Fraction(1, options.get("ticks", rate))
        for i, shown in enumerate(pts):
            frame = av.VideoFrame.from_ndarray(picture(options.get("first", 0) + i), format="rgb24")
            frame.pts = shown
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
def test_frames_by_number_in_any_order(tmp_path, suffix):
    with Video(write(tmp_path / f"v{suffix}", b_frames=0 if suffix == ".avi" else 2)) as video:
        assert (len(video), video.size) == (COUNT, (WIDTH, HEIGHT))
        assert video.rate == pytest.approx(30, rel=1e-3)
        assert [number(image) for image in video.frames()] == list(range(COUNT))
        order = [39, 0, 17, 16, 18, 30, 2, 39]
        assert [number(video.read(i)) for i in order] == order
        assert [number(image) for image in video.frames(11, 14)] == [11, 12, 13]
        np.testing.assert_allclose(np.diff(video.times), 1 / 30, atol=2e-3)
        with pytest.raises(ObservationError, match="0 to 39"):
            video.read(COUNT)


def test_webm_hidden_frames_are_not_counted(tmp_path):
    if "libvpx" not in av.codecs_available:
        pytest.skip("this FFmpeg cannot write VP8")
    with Video(write(tmp_path / "v.webm", codec="libvpx", b_frames=0)) as video:
        assert len(video) == COUNT
        assert number(video.read(COUNT - 1)) == COUNT - 1


@pytest.mark.parametrize("matrix", MATRICES)
def test_the_image_is_upright_and_mirrored_as_the_file_states(tmp_path, matrix):
    raw = write(tmp_path / "v.mp4").read_bytes()
    unity = np.array([65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30], ">i4").tobytes()
    a, b, c, d = (65536 * v for v in matrix)
    at = raw.index(unity, raw.index(b"tkhd"))
    turned = tmp_path / "turned.mp4"
    turned.write_bytes(raw[:at] + np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes() + raw[at + 36 :])
    with Video(tmp_path / "v.mp4") as plain, Video(turned) as video:
        assert video.size == ((WIDTH, HEIGHT) if a else (HEIGHT, WIDTH))
        np.testing.assert_array_equal(video.read(5), MATRICES[matrix](plain.read(5)))
    np.testing.assert_array_equal(first_image(turned), MATRICES[matrix](first_image(tmp_path / "v.mp4")))


def test_a_front_camera_s_mirrored_video(data_dir):
    with Video(data_dir("cases_of_users") / "video-mirrored-flag" / "cam.mp4") as video:
        image = video.read(0)
    assert (len(video), video.size) == (60, (320, 180))
    assert image[10, -10].argmax() == 0 and image[10, -10, 0] > 200  # red at the top right
    assert image[10, 10].argmax() == 2 and image[-10, 10].argmax() == 1


def test_missing_and_foreign_files(tmp_path):
    with pytest.raises(FileError, match="no such video"):
        Video(tmp_path / "none.mp4")
    text = tmp_path / "text.mp4"
    text.write_text("not a video, though it says so")
    with pytest.raises(FileError, match="not a readable video, 0 frames"):
        Video(text)
    (tmp_path / "empty.mp4").touch()
    with pytest.raises(FileError, match="0 frames"):
        Video(tmp_path / "empty.mp4")


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
def test_truncated_video_tells_what_can_be_read(tmp_path, suffix):
    path = write(tmp_path / f"v{suffix}", b_frames=0)
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) // 2])
    with pytest.raises(FileError, match=r"\b\d+( of \d+)? frames") as caught:
        Video(path)
    assert caught.value.file == path
    assert caught.value.remedy


def test_real_mp4_with_its_index_in_front_but_cut(data_dir, tmp_path):
    raw = (data_dir("video_balancing_4cam") / "videos" / "cam02.mp4").read_bytes()
    if raw.index(b"moov") > raw.index(b"mdat"):
        pytest.skip("its index is at the end")
    path = tmp_path / "cut.mp4"
    path.write_bytes(raw[: len(raw) // 2])
    with pytest.raises(FileError, match=r"truncated: \d+ of 100 frames"):
        Video(path)


def test_real_videos(data_dir):
    folder = data_dir("video_balancing_4cam") / "videos"
    paths = {f"cam0{i}": folder / f"cam0{i}.mp4" for i in (1, 2, 3, 4)}
    with ExitStack() as opened:
        videos = {name: opened.enter_context(Video(path)) for name, path in paths.items()}
        assert common_frames({name: video.times for name, video in videos.items()}, 60) == (0, 100)
        assert {video.rate for video in videos.values()} == {60}
        assert [video.size for video in videos.values()] == [(1080, 1920)] * 2 + [(1088, 1920)] * 2
        late = {name: video.read(57) for name, video in videos.items()}
        assert late["cam03"].shape == (1920, 1088, 3)
    with Video(paths["cam02"]) as video:
        in_order = list(video.frames(0, 58))[57]
    np.testing.assert_array_equal(late["cam02"], in_order)


def in_step(paths, offsets=(0.0, 0.0), frames=None):
    """Steps that all videos share, of the highest rate, and the numbers that each shows in them."""
    with ExitStack() as opened:
        videos = {name: opened.enter_context(Video(path)) for name, path in paths.items()}
        rate = max(video.rate for video in videos.values())
        clocks = {name: video.times + offset for (name, video), offset in zip(videos.items(), offsets, strict=True)}
        start, stop = common_frames(clocks, rate, frames)
        return (start, stop), [
            [number(video.read(video.frame_at(t - offset) or 0)) for video, offset in zip(videos.values(), offsets)]
            for t in np.arange(start, stop) / rate
        ]


def test_cameras_in_step_with_time_offsets(tmp_path):
    paths = {"a": write(tmp_path / "a.mp4"), "b": write(tmp_path / "b.mp4", first=0)}
    steps, shown = in_step(paths, (0.0, 0.1))  # b started three frames after a
    assert steps == (3, COUNT)
    assert shown == [[k + 3, k] for k in range(COUNT - 3)]


DROPPED = [i for i in range(40) if not (12 <= i < 26 and i % 2)]  # frames that a telephone kept


def test_empty_packets_of_avi_are_dropped_frames(data_dir):
    with Video(data_dir("cases_of_users") / "video-avi-dropped-frames" / "cam.avi") as video:
        np.testing.assert_allclose(video.times, np.r_[0:20, 25:60] / 30, atol=1e-9)
        assert video.unevenness.endswith("5 frames lacking between 0.633 and 0.833 s")
        assert video.read(54).shape == (180, 320, 3)


@pytest.mark.parametrize("codec", ["mjpeg", "mpeg4", "libx264"])
def test_avi_that_dropped_frames(tmp_path, codec):
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg cannot write {codec}")
    pixels = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    with Video(write(tmp_path / "v.avi", codec=codec, pixels=pixels, pts=DROPPED, b_frames=0)) as video:
        np.testing.assert_allclose(video.times, np.array(DROPPED) / 30, atol=1e-9)
        assert video.rate == pytest.approx(30) and "7 frames lacking" in video.unevenness
        assert [number(video.read(i)) for i in (20, 0, 32, 13)] == [20, 0, 32, 13]


def test_avi_whose_last_frames_were_dropped(tmp_path):
    path = write(tmp_path / "v.avi", b_frames=0)
    raw = bytearray(path.read_bytes())
    length = raw.index(b"strh") + 40  # number of frames of the stream
    assert raw[length : length + 4] == COUNT.to_bytes(4, "little")
    raw[length : length + 4] = (COUNT + 5).to_bytes(4, "little")
    path.write_bytes(raw)
    with Video(path) as video:
        assert len(video) == COUNT and not video.unevenness
    path.write_bytes(raw[:-2000])
    with pytest.raises(FileError, match="truncated"):
        Video(path)


def test_mp4_with_empty_packets(tmp_path):
    path = write(tmp_path / "v.mp4", codec="mjpeg", pixels="yuvj420p", b_frames=0)
    with av.open(str(path)) as container:
        at = [packet.pos for packet in container.demux(video=0) if packet.size]
    raw, removed = bytearray(path.read_bytes()), at[15] - at[12]
    sizes, chunks = raw.index(b"stsz") + 16, raw.index(b"stco") + 8
    raw[sizes + 4 * 12 : sizes + 4 * 15] = bytes(12)  # samples 12 to 14 have no size
    count = int.from_bytes(raw[chunks : chunks + 4], "big")
    for k in range(chunks + 4, chunks + 4 + 4 * count, 4):
        offset = int.from_bytes(raw[k : k + 4], "big")
        raw[k : k + 4] = (offset - removed * (offset > at[12])).to_bytes(4, "big")
    mdat = raw.index(b"mdat") - 4
    raw[mdat : mdat + 4] = (int.from_bytes(raw[mdat : mdat + 4], "big") - removed).to_bytes(4, "big")
    del raw[at[12] : at[15]]
    path.write_bytes(raw)
    with Video(path) as video:
        assert [number(image) for image in video.frames()] == [*range(12), *range(15, COUNT)]
        np.testing.assert_allclose(video.times, np.r_[0:12, 15:COUNT] / 30, atol=1e-6)
        assert "3 frames lacking between 0.367 and 0.5 s" in video.unevenness


def test_mpeg4_frames_that_repeat_the_one_before(tmp_path):
    """DivX and Xvid write a packet of a few bytes in place of a dropped frame."""
    path = tmp_path / "v.avi"
    with av.open(str(write(tmp_path / "whole.avi", b_frames=0))) as source, av.open(str(path), "w") as target:
        given = source.streams.video[0]
        copied = getattr(target, "add_stream_from_template", None)  # of PyAV 14 on
        stream = copied(given) if copied else target.add_stream(template=given)
        for packet in source.demux(given):
            if packet.size:
                if 21 <= packet.dts < 24:  # a predicted frame that is not coded: start, type, second, time, end
                    bits = f"0101{packet.dts:05b}10".ljust(15, "0") + "1"
                    dropped = av.Packet(b"\0\0\1\xb6" + int(bits, 2).to_bytes(2, "big"))
                    dropped.pts, dropped.dts, dropped.time_base = packet.pts, packet.dts, packet.time_base
                    packet = dropped
                packet.stream = stream
                target.mux(packet)
    with Video(path) as video:
        assert [number(image) for image in video.frames()] == [*range(21), *range(24, COUNT)]
        np.testing.assert_allclose(video.times, np.r_[0:21, 24:COUNT] / 30, atol=1e-9)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize("first", [0, 7])
def test_times_of_a_video_that_dropped_frames(tmp_path, suffix, first):
    with Video(write(tmp_path / f"v{suffix}", pts=[first + i for i in DROPPED], b_frames=0)) as video:
        np.testing.assert_allclose(video.times, np.array(DROPPED) / 30, atol=1e-3)  # mkv has milliseconds
        assert video.rate == pytest.approx(30, rel=2e-3)
        assert video.unevenness == "variable frame rate, 30 Hz nominal, 7 frames lacking between 0.4 and 0.867 s"
        assert number(video.read(20)) == 20
        assert [video.frame_at(i / 30) for i in DROPPED] == list(range(len(DROPPED)))
        assert video.frame_at(13.4 / 30) == DROPPED.index(14)  # the nearest where one is lacking
        assert (video.frame_at(-0.4 / 30), video.frame_at(-0.6 / 30)) == (0, None)
        assert (video.frame_at(39.4 / 30), video.frame_at(39.6 / 30)) == (len(DROPPED) - 1, None)


def test_times_of_a_rate_that_varies(tmp_path):
    pts = np.cumsum(np.r_[0, np.random.default_rng(0).integers(28, 39, 39)])
    with Video(write(tmp_path / "v.mp4", pts=pts.tolist(), ticks=1000, b_frames=0)) as video:
        np.testing.assert_allclose(video.times, pts / 1000, atol=1e-4)
        assert video.rate == pytest.approx(39 / (pts[-1] / 1000), rel=0.01)
        assert video.unevenness.startswith("variable frame rate, ") and "lacking" not in video.unevenness


def test_a_rate_of_the_header_that_the_times_contradict(tmp_path):
    path = write(tmp_path / "v.mp4", rate=25, pts=[i * 40 for i in range(39)] + [39 * 40], ticks=1000)
    with Video(path) as video:
        assert video.rate == pytest.approx(25, rel=1e-3) and not video.unevenness


def test_of_two_frames_at_one_time_the_first_is_shown(tmp_path):
    path = tmp_path / "v.mkv"
    with av.open(str(write(tmp_path / "one.mkv", b_frames=0))) as source, av.open(str(path), "w") as target:
        given = source.streams.video[0]
        copied = getattr(target, "add_stream_from_template", None)  # of PyAV 14 on
        stream = copied(given) if copied else target.add_stream(template=given)
        for packet in source.demux(given):
            if packet.size:
                if packet.pts >= 333:
                    packet.pts = packet.dts = max(packet.pts - 33, 300)
                packet.stream = stream
                target.mux(packet)
    with Video(path) as video:
        assert len(video) == COUNT - 1 and np.all(np.diff(video.times) > 0.0)
        assert [number(video.read(i)) for i in (8, 9, 10, 38)] == [8, 9, 11, 39]


def test_streams_of_different_length_or_rate(tmp_path):
    long, short = write(tmp_path / "long.mp4"), write(tmp_path / "short.mp4", count=25)
    with pytest.raises(ObservationError, match="a 40 frames, b 25 frames") as caught:
        in_step({"a": long, "b": short})
    assert "frames = [0, 25]" in caught.value.remedy
    assert [b for _, b in in_step({"a": long, "b": short}, frames=(5, 25))[1]] == list(range(5, 25))
    with pytest.raises(ObservationError, match=r"\[0, 30\]"):
        in_step({"a": long, "b": short}, frames=(0, 30))
    steps, shown = in_step({"a": long, "c": write(tmp_path / "c.mp4", rate=15, count=20)})
    assert steps == (0, 39)  # to the slow one's last frame
    assert [shown[i][1] for i in (0, 2, 10, 38)] == [0, 1, 5, 19]
    with pytest.raises(ObservationError, match="a 40 frames, c 79 frames of 30 Hz"):
        in_step({"a": long, "c": write(tmp_path / "c.mp4", rate=15)})


def test_common_frames_without_overlap():
    with pytest.raises(ObservationError, match="no time that all streams share"):
        common_frames({"a": np.arange(10) / 30, "b": np.arange(10) / 30 + 5.0}, 30.0)


class SideData(Mapping):
    """What stands beside a frame, as PyAV gives it: by name, but what it iterates over depends on its version."""

    def __init__(self, kept, over):
        self.kept, self.over = kept, over

    def __len__(self):
        return len(self.kept)

    def __iter__(self):
        return iter(self.kept.values() if self.over == "values" else [SimpleNamespace(name=name) for name in self.kept])

    def __getitem__(self, key):
        return self.kept[key]


@pytest.mark.parametrize("over", ["values", "keys"])
def test_rotation_is_found_whatever_the_side_data_iterates_over(over):
    matrix = np.array([0, -65536, 0, 65536, 0, 0, 0, 0, 1 << 30], np.int32).tobytes()
    kept = {"SEI_UNREGISTERED": b"x264", "DISPLAYMATRIX": matrix}
    assert _display_axes(SimpleNamespace(side_data=SideData(kept, over)), "v.mp4") == (True, False, True)
    del kept["DISPLAYMATRIX"]
    assert _display_axes(SimpleNamespace(side_data=SideData(kept, over)), "v.mp4") == (False, False, False)


def test_streams_that_began_when_they_liked_have_what_all_saw():
    clocks = {"a": np.arange(100) / 30.0, "b": np.arange(60) / 30.0 + 0.5}
    assert common_frames(clocks, 30.0, overlap=True) == (15, 75)
    with pytest.raises(ObservationError, match="streams of different length"):
        common_frames(clocks, 30.0)


@pytest.mark.parametrize(("stated", "rate", "said"), [("240.0", 240.0, "slow motion"), ("2", 2.0, "time lapse"),
                                                      ("30.0", 30.0, ""), ("fast", 30.0, ""),
                                                      ("60", 30.0, "in the dark and slow motion")])  # fmt: skip
def test_the_rate_of_the_capture_comes_before_that_of_playing(tmp_path, stated, rate, said):
    path = write(tmp_path / "v.mp4", 20, tags={"com.android.capture.fps": stated})
    with Video(path) as video:
        assert abs(video.rate - rate) < 1e-6 and np.allclose(video.times, np.arange(20) / rate)
        assert said in video.unevenness and bool(said) == bool(video.unevenness)
        assert number(video.read(7)) == 7


@pytest.mark.parametrize(("code", "rate", "seconds"), [
    ("10:00:00:15", 30, 36000.5), ("00:00:01:00", Fraction(30000, 1001), 1.001),
    ("00:10:00;00", Fraction(30000, 1001), 600.0 - 0.0006), ("00:01:00;02", Fraction(30000, 1001), 60.06),
    ("", 30, None),
])  # fmt: skip
def test_time_codes_are_seconds(tmp_path, code, rate, seconds):
    path = write(tmp_path / "v.mov", 5, rate=rate, timecode=code)
    found = stated_time_code(path, float(rate))
    assert found is None if seconds is None else (abs(found[0] - seconds) < 2e-3 and found[1] == code)
    assert stated_time_code(tmp_path, 30.0) is None  # a folder of images
