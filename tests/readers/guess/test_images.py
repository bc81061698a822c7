"""A take file guessed from folders of images: colour or grey, a folder for each camera or one for all."""

import cv2
import numpy as np
import pytest

from kinefit.errors import TakeError
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.guess.folder import guess_take
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import cut, squat_and_wave, studio_rig

SIZE, FRAMES = (272, 480), 12


@pytest.fixture
def folder(tmp_path):
    rig = studio_rig(cut(squat_and_wave(), 0, 4), cameras=2, size=SIZE)
    write_calibration(rig, tmp_path / "calibration.toml")
    return tmp_path


def write_images(pattern, picture, frames=range(FRAMES)):
    """Numbered images "folder/name_{}.png" of one camera."""
    for i in frames:
        path = pattern.with_name(pattern.name.format(i))
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), picture)


PHOTO = np.tile(np.linspace(0, 255, SIZE[0]).astype(np.uint8), (SIZE[1], 1))
COLOUR = np.dstack([PHOTO, PHOTO[::-1], 255 - PHOTO])
MASK = np.where(PHOTO > 128, 255, 0).astype(np.uint8)


@pytest.mark.parametrize("picture", [COLOUR, PHOTO], ids=["colour", "grey"])
@pytest.mark.parametrize(
    ("pattern", "video"),
    [("{c}/img_{{}}.png", "{c}"), ("frames/{c}/{{}}.jpg", "frames/{c}"), ("{c}_{{}}.png", "{c}_*.png")],
)
def test_images_are_a_video(folder, pattern, video, picture):
    for camera in ("cam01", "cam02"):
        write_images(folder / pattern.format(c=camera), picture)
        write_images(folder / f"masks/{camera}/m{{}}.png", MASK)
    take = folder / "take.toml"
    text = guess_take(folder).text
    take.write_text(text.replace("# rate =", "rate = 30 #"))
    cameras = {c.name: c.video for c in read_take(take).cameras}
    assert cameras == {c: folder / video.format(c=c) for c in ("cam01", "cam02")}
    assert load_observations(read_take(take)).frames == (0, FRAMES)


def test_photographs_of_no_camera_are_named(folder):
    write_images(folder / "a{}.png", COLOUR)
    with pytest.raises(TakeError, match="after its camera: cam01, cam02"):
        guess_take(folder)


def test_photographs_some_of_which_are_missing_are_no_video(folder):
    write_images(folder / "left{}.png", COLOUR, [*range(9), *range(11, 16)])
    write_images(folder / "right{}.png", COLOUR)
    write_images(folder / "mask{}.png", MASK)
    with pytest.raises(TakeError, match="cam01, cam02") as told:
        guess_take(folder)
    assert "no videos, keypoints" not in str(told.value)  # the one that is whole is looked at
