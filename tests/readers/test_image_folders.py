"""Folders of images as videos: order, rate, sizes, gaps, and a take that is made of them."""

import struct

import cv2
import numpy as np
import pytest

from kinefit.errors import FileError, ObservationError
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.videos.video import Video, common_frames


def draw(folder, numbers, ending=".png", size=(48, 32)):
    folder.mkdir(parents=True, exist_ok=True)
    for i in numbers:
        picture = np.full((size[1], size[0], 3), 0, np.uint8)
        picture[..., 2] = 5 * i  # red, as OpenCV orders channels
        assert cv2.imwrite(str(folder / f"img{i}{ending}"), picture)
    return folder


@pytest.mark.parametrize("ending", [".png", ".jpg", ".jpeg"])
def test_images_are_frames_by_their_number(tmp_path, ending):
    (draw(tmp_path / "cam01", range(8, 21), ending) / "notes.txt").write_text("no image")
    with Video(tmp_path / "cam01", rate=25.0) as video:
        assert (len(video), video.size, video.rate) == (13, (48, 32), 25.0)
        np.testing.assert_allclose(video.times, np.arange(13) / 25.0)
        for i in (12, 0, 5):
            red, green, _ = video.read(i)[16, 24]
            assert abs(int(red) - 5 * (8 + i)) <= 3 and green <= 3
        assert len(list(video.frames(2, 5))) == 3


ORIENTATIONS = {  # of Exif: what is shown of the stored image
    1: lambda image: image,
    2: np.fliplr,
    3: lambda image: np.rot90(image, 2),
    4: np.flipud,
    5: lambda image: image.transpose(1, 0, 2),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: np.rot90(image, 2).transpose(1, 0, 2),
    8: np.rot90,
}


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_photographs_are_upright_and_mirrored_as_they_state(tmp_path, orientation):
    stored = np.kron(np.random.default_rng(0).integers(0, 255, (4, 6, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    jpeg = cv2.imencode(".jpg", stored[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    tag = struct.pack(">4sIHHHIHHI", b"MM\0*", 8, 1, 0x112, 3, 1, orientation, 0, 0)
    exif = b"\xff\xe1" + struct.pack(">H", 8 + len(tag)) + b"Exif\0\0" + tag
    for i in range(2):
        (tmp_path / f"img{i}.jpg").write_bytes(jpeg[:2] + exif + jpeg[2:])
    expected = ORIENTATIONS[orientation](stored)
    with Video(tmp_path, rate=10.0) as video:
        assert video.size == expected.shape[1::-1]
        assert np.abs(video.read(1).astype(int) - expected).mean() < 10


def test_a_pattern_names_the_images_of_one_camera(tmp_path):
    draw(tmp_path, range(4))
    for i in range(4):
        (tmp_path / f"img{i}.png").rename(tmp_path / f"left_{i}.png")
    draw(tmp_path, range(6))
    assert len(Video(tmp_path / "left_*.png", rate=10.0)) == 4
    with pytest.raises(ObservationError, match=r"two images with one number.*pattern"):
        Video(tmp_path, rate=10.0)


def test_what_is_wrong_with_images_is_told(tmp_path):
    folder = draw(tmp_path / "cam", [0, 1, 2, 3])
    with pytest.raises(ObservationError, match=r"states no frame rate.*rate = .*\[take\]"):
        Video(folder)
    (folder / "img2.png").unlink()
    with pytest.raises(ObservationError, match="missing between img1.png and img3.png"):
        Video(folder, rate=30.0)
    draw(folder, [2], size=(20, 20))
    with Video(folder, rate=30.0) as video, pytest.raises(FileError, match=r"20x20 px, but the first image has 48x32"):
        video.read(2)
    (folder / "img2.png").write_bytes(b"\x89PNG")
    with Video(folder, rate=30.0) as video, pytest.raises(FileError, match="no image"):
        video.read(2)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="no images here"):
        Video(tmp_path / "empty", rate=30.0)


def test_folders_go_in_step(tmp_path):
    with Video(draw(tmp_path / "a", range(6)), rate=20.0) as a, Video(draw(tmp_path / "b", range(6)), rate=20.0) as b:
        first, _ = common_frames({"a": a.times, "b": b.times + 0.1}, 20.0, (2, 6))
        at = a.read(a.frame_at(first / 20.0)), b.read(b.frame_at(first / 20.0 - 0.1))
        assert [image[0, 0, 0] for image in at] == [10, 0]


def test_a_take_of_folders_has_the_rate_of_the_take(tmp_path):
    names = ("cam01", "cam02")
    for name in names:
        draw(tmp_path / name, range(5))
    cameras = "".join(f'[[camera]]\nname = "{name}"\nvideo = "{name}"\n' for name in names)
    calibration = "".join(
        f'[{name}]\nname = "{name}"\nsize = [48, 32]\nmatrix = [[50, 0, 24], [0, 50, 16], [0, 0, 1]]\n'
        f"distortions = [0, 0, 0, 0]\nrotation = [0, 0, {i}]\ntranslation = [{i}, 0, 3]\n"
        for i, name in enumerate(names)
    )
    (tmp_path / "calibration.toml").write_text(calibration)
    take = tmp_path / "take.toml"
    take.write_text('[take]\nrate = 12.5\n[calibration]\nfile = "calibration.toml"\n' + cameras)
    seen = load_observations(read_take(take))
    assert (seen.rate, seen.frames) == (12.5, (0, 5))
    take.write_text('[calibration]\nfile = "calibration.toml"\n' + cameras)
    with pytest.raises(ObservationError, match="states no frame rate"):
        load_observations(read_take(take))


def test_images_of_every_third_frame_take_their_time(tmp_path):
    with Video(draw(tmp_path / "cam", range(0, 15, 3)), rate=30.0) as video:
        np.testing.assert_allclose(video.times, np.arange(5) / 10.0)
        assert "step by 3" in video.unevenness and "rate = 90" in video.unevenness
        assert video.frame_at(0.21) == 2 and video.rate == 30.0
    for i in (0, 3, 6, 9, 12):
        (tmp_path / "cam" / f"img{i}.png").rename(tmp_path / "cam" / f"[b] {1700000000 + i / 10:.3f}.png")
    with Video(tmp_path / "cam" / "[b]*.png", rate=3.0) as video:  # brackets of a name, and times
        np.testing.assert_allclose(video.times, 0.3 * np.arange(5), atol=1e-5)
