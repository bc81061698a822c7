"""Silhouettes in files and in takes."""

import re

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.errors import FileError, ObservationError, TakeError
from kinefit.geometry.camera import ImageFrame
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.sensors.kinds.silhouettes import read_silhouettes
from kinefit.takes.track import track_take


def write_masks(folder, size=(64, 48), count=3, value=255):
    folder.mkdir(exist_ok=True)
    for i in range(count):
        mask = np.zeros(size[::-1], np.uint8)
        mask[10:30, 10 + 5 * i : 25 + 5 * i] = value
        cv2.imwrite(str(folder / f"{i:03d}.png"), mask)
    return folder


@pytest.mark.parametrize("value", [255, 1])
def test_masks_in_a_folder(tmp_path, value):
    video = read_silhouettes(
        write_masks(tmp_path / "m", value=value), camera="c", rate=30.0, size=(64, 48), time_offset=0.5
    )
    assert len(video) == 3 and video.times[0] == 0.5
    frame = video.frame(1)
    assert (frame.sensor, frame.size, frame.mask.max()) == ("c", (64, 48), 255)
    assert frame.mask[20, 20] and not frame.mask[20, 12]
    assert video.at_step(16, 30.0) == 1 and video.at_step(2, 30.0) is None


def test_masks_of_a_letterboxed_picture_are_put_back(tmp_path):
    frame = ImageFrame.letterboxed((64, 48), (64, 60))
    mask = np.zeros((60, 64), np.uint8)
    mask[16:36, 10:25] = 255
    (tmp_path / "m").mkdir()
    cv2.imwrite(str(tmp_path / "m" / "0.png"), mask)
    video = read_silhouettes(tmp_path / "m", camera="c", rate=30.0, size=(64, 48), image_frame=frame)
    v, u = np.nonzero(video.frame(0).mask)
    assert (v.min(), v.max(), u.min(), u.max()) == (10, 29, 10, 24)


def test_wrong_masks_are_told(tmp_path):
    folder = write_masks(tmp_path / "m")
    cv2.imwrite(str(folder / "001.png"), np.zeros((10, 10), np.uint8))
    (folder / "002.png").write_bytes(b"no picture")
    video = read_silhouettes(folder, camera="c", rate=30.0, size=(64, 48))
    with pytest.raises(ObservationError, match="10x10"):
        video.frame(1)
    with pytest.raises(FileError, match="damaged"):
        video.frame(2)
    (tmp_path / "none").mkdir()
    with pytest.raises(FileError, match="no images"):
        read_silhouettes(tmp_path / "none", camera="c", rate=30.0, size=(64, 48))


CALIBRATION = """[cam1]
name = "cam1"
size = [64.0, 48.0]
matrix = [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 3.0]
fisheye = false
"""


def take(folder, silhouette, head=""):
    (folder / "calibration.toml").write_text(CALIBRATION)
    text = f'[take]\nrate = 30.0\n{head}\n[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam1"\n'
    path = folder / "take.toml"
    path.write_text(text + silhouette)
    return path


def test_a_take_with_silhouettes_alone(tmp_path):
    write_masks(tmp_path / "m")
    path = take(tmp_path, '[[silhouette]]\ncamera = "cam1"\nfile = "m"\nsigma = 2.0\n')
    told = read_take(path)
    assert told.sensors["silhouette"][0].sigma == 2.0
    seen = load_observations(told)
    assert (seen.rate, seen.frames, len(seen.of_kind("silhouette"))) == (30.0, (0, 3), 1)
    (video,) = seen.of_kind("silhouette")
    with pytest.warns(FutureWarning, match="'silhouettes' is Observations.of_kind"):
        assert seen.silhouettes == (video,)
    with pytest.warns(FutureWarning, match="'silhouettes' is Take.sensors"):
        assert told.silhouettes == told.sensors["silhouette"]
    assert not hasattr(seen, "no_such_attribute") and not hasattr(told, "no_such_attribute")
    assert video.frame(0).mask[20, 12] == 255


def test_silhouettes_with_nothing_to_begin_with_are_refused(tmp_path):
    write_masks(tmp_path / "m")
    with pytest.raises(TakeError, match=r"\[\[silhouette\]\]: it alone does not determine the first pose"):
        track_take(take(tmp_path, '[[silhouette]]\ncamera = "cam1"\nfile = "m"\n'))


@pytest.mark.parametrize(
    ("silhouette", "head", "message"),
    [
        ('[[silhouette]]\ncamera = "cam9"\nfile = "m"\n', "", "cam1"),
        ('[[silhouette]]\ncamera = "cam1"\n', "", "no file of masks"),
        ('[[silhouette]]\ncamera = "cam1"\nfile = "m"\nsigma = 0\n', "", "sigma"),
        ('[[silhouette]]\ncamera = "cam1"\nformat = "background"\n', "", "video"),
        ('[[silhouette]]\ncamera = "cam1"\nfile = "m"\n[[silhouette]]\ncamera = "cam1"\nfile = "m"\n', "", "two"),
        ('[[silhouette]]\ncamera = "cam1"\nfile = "m"\nformat = "outline"\n', "", "masks"),
        ('[[silhouette]]\ncamera = "cam1"\nfile = "m"\nkind = 1\n', "", "kind"),
    ],
)
def test_what_cannot_be_in_a_take_is_told(tmp_path, silhouette, head, message):
    write_masks(tmp_path / "m")
    with pytest.raises(TakeError) as told:
        read_take(take(tmp_path, silhouette, head))
    assert message in str(told.value)


@pytest.mark.parametrize(("silhouette", "head"), [('file = "gone"', ""), ('file = "m"', 'start = "gone.npz"')])
def test_files_that_are_not_there_are_told(tmp_path, silhouette, head):
    write_masks(tmp_path / "m")
    with pytest.raises(FileError, match="gone"):
        read_take(take(tmp_path, f'[[silhouette]]\ncamera = "cam1"\n{silhouette}\n', head))


def test_keypoints_of_some_frames_only(tmp_path):
    array = np.ones((3, 33, 3))
    np.save(tmp_path / "k.npy", array)
    write_masks(tmp_path / "m")
    keypoints = '[[keypoints]]\ncamera = "cam1"\nfile = "k.npy"\nformat = "mediapipe"\nframes = [0, 1]\n'
    path = take(tmp_path, '[[silhouette]]\ncamera = "cam1"\nfile = "m"\n' + keypoints)
    (seen,) = load_observations(read_take(path)).keypoints
    assert np.isfinite(seen.points[0]).all() and (seen.confidence[0] > 0).all()
    assert np.isnan(seen.points[1:]).all() and (seen.confidence[1:] == 0).all()
    with pytest.raises(TakeError, match="frames"):
        read_take(take(tmp_path, keypoints.replace("[0, 1]", "[2, 1]")))


BODY = np.zeros((48, 64), np.uint8)
BODY[8:40, 20:36] = 255


@pytest.mark.parametrize(("image", "said"), [
    (np.where(BODY > 0, 2, 0).astype(np.uint8), "values 0 and 2"),
    (np.where(BODY > 0, np.arange(64) // 28 + 1, 0).astype(np.uint8), "values 0 and 1, 2"),  # two people
    (np.where(BODY > 0, 24, 0).astype(np.uint16), ""),
    (cv2.merge([BODY, BODY, BODY, np.full_like(BODY, 255)]), ""),  # opaque
    (cv2.merge([255 - BODY] * 3 + [BODY]), ""),  # the alpha channel is the mask
    (np.where(BODY[..., None] > 0, (0, 0, 128), 0).astype(np.uint8), r"\[0, 0, 0\]"),  # the palette of DAVIS
    (np.where(BODY[..., None] > 0, (30, 20, 200), 255).astype(np.uint8), r"\[255, 255, 255\]"),
    (cv2.GaussianBlur(BODY, (0, 0), 0.8), ""),
    (BODY[::2, ::2], "32x24 px: scaled to 64x48"),
])  # fmt: skip
def test_the_body_is_found_by_values_colours_and_size(tmp_path, image, said):
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image)
    video = read_silhouettes(tmp_path, camera="c", rate=30.0, size=(64, 48))
    assert np.mean((video.frame(1).mask > 127) != (BODY > 0)) < 0.03
    assert re.search(said, " ".join(video.notes)) and bool(said) == bool(video.notes)


@pytest.mark.parametrize(("image", "said"), [
    (255 - BODY, "white covers 83 %.*inverted"),
    (cv2.merge([255 - BODY] * 3 + [np.full_like(BODY, 255)]), "inverted"),
    (np.where(BODY > 0, 24, 7).astype(np.uint8), "labels of all"),
    (np.random.default_rng(0).integers(0, 255, (48, 64, 3)).astype(np.uint8), "photographs"),
    (np.random.default_rng(0).integers(0, 255, (48, 64)).astype(np.uint8), "grey values"),
    (BODY[:, 8:56], "48x48 px, not 64x48"),
])  # fmt: skip
def test_what_is_no_mask_is_named_when_it_is_loaded(tmp_path, image, said):
    cv2.imwrite(str(tmp_path / "0.png"), image)
    with pytest.raises(ObservationError, match=said):
        read_silhouettes(tmp_path, camera="c", rate=30.0, size=(64, 48))


def test_masks_of_some_frames_of_a_video_are_at_their_numbers(tmp_path):
    clock = np.arange(20) / 30.0
    for i in range(5, 14, 2):
        cv2.imwrite(str(tmp_path / f"{i:04d}.png"), BODY)
    video = read_silhouettes(tmp_path, camera="c", rate=30.0, size=(64, 48), clock=clock)
    np.testing.assert_allclose(video.times, clock[5:14:2])
    assert video.notes == ("5 masks of the video's 20 frames, by their numbers",)
    (tmp_path / "0005.png").rename(tmp_path / "0020.png")  # numbers that end with the video's count begin at 1
    video = read_silhouettes(tmp_path, camera="c", rate=30.0, size=(64, 48), clock=clock)
    np.testing.assert_allclose(video.times, clock[[6, 8, 10, 12, 19]])


def test_a_take_and_its_check_say_how_masks_were_read(tmp_path):
    write_masks(tmp_path / "m", value=2)
    for i in (2, 1):
        (tmp_path / "m" / f"{i:03d}.png").rename(tmp_path / "m" / f"{4 * i:03d}.png")
    path = take(tmp_path, '[[silhouette]]\ncamera = "cam1"\nfile = "m"\n')
    seen = load_observations(read_take(path))
    assert seen.frames == (0, 9)
    done = CliRunner().invoke(main, ["check", str(path)])
    told = " ".join(done.output.split())
    assert "cam1: the numbers of its masks step by 4" in told and "the values 0 and 2: all but 0 is taken" in told
