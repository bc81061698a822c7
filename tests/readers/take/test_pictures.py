"""Single pictures of a take's videos: the right one of the right camera, none where there is none."""

import cv2
import numpy as np
import pytest
from tests.readers.two_people import COUNT, write_take

from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.take.videos import TakePictures


@pytest.fixture
def take(tmp_path):
    """Cameras start 0.1 s late; two have videos, of an eighth of the calibration's size, whose grey is the frame."""
    path = write_take(tmp_path)
    rig = load_observations(read_take(path)).rig
    text = path.read_text().replace("[take]\n", "[take]\nframes = [10, 30]\n")
    for camera in rig:
        name = camera.name
        with_video = name in rig.names[:2]
        if with_video:
            (tmp_path / f"v{name}").mkdir()
            for f in range(COUNT):
                image = np.full((camera.size[1] // 8, camera.size[0] // 8, 3), 5 * f, np.uint8)
                cv2.imwrite(str(tmp_path / f"v{name}" / f"{f:03d}.png"), image)
        video = f'video = "v{name}"\nimage = "scaled"\n' if with_video else ""
        keypoints = 'frame = "calibration"\n' if with_video else ""
        camera_entry = f'[[camera]]\nname = "{name}"\n'
        text = text.replace(camera_entry, f"{camera_entry}time_offset = 0.1\n{video}")
        text = text.replace(f'[[keypoints]]\ncamera = "{name}"\n', f'[[keypoints]]\ncamera = "{name}"\n{keypoints}')
    path.write_text(text)
    return read_take(path)


def test_the_picture_is_that_of_the_keypoints(take):
    seen = load_observations(take)
    first, _, third = seen.rig.names[:3]
    with TakePictures(take, seen) as pictures:
        for frame in (0, 13):  # frame 0 is step 10, of which the video's frame 7 is
            image, own = pictures(first, frame)
            assert image.mean() == pytest.approx(5 * (frame + 7), abs=1)
            width, height = seen.rig[first].size
            np.testing.assert_allclose(own.from_calibration([width, height]), image.shape[1::-1], atol=1.0)
        assert pictures(third, 0) is None and pictures(first, 1000) is None


def test_a_video_that_cannot_be_read_is_no_picture(take):
    seen = load_observations(take)
    name = seen.rig.names[0]
    for image in seen.videos[name].glob("*.png"):
        image.write_bytes(b"no picture")
    with TakePictures(take, seen) as pictures:
        assert pictures(name, 0) is None and pictures(name, 1) is None
