"""Face and hands by the colour of the skin, out of a take's video."""

import av
import cv2
import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import KinefitError, TakeError
from kinefit.fitting.tracking.take_recording import recording_of
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations

SKIN, WALL, SHIRT = (205, 150, 125), (130, 150, 140), (40, 60, 120)
LEFT, RIGHT = np.array([220, 150]), np.array([100, 150])
CALIBRATION = """[cam]
name = "cam"
size = [320.0, 240.0]
matrix = [[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 3.0]
fisheye = false
"""


def hands(k):
    turn = 0.3 * k
    circle = 15 * np.array([np.cos(turn), np.sin(turn)])
    return LEFT + circle, RIGHT - circle


def drawn(k):
    image = np.full((240, 320, 3), WALL, np.uint8)
    cv2.rectangle(image, (115, 95), (205, 240), SHIRT, -1)
    cv2.ellipse(image, (160, 65), (18, 25), 0, 0, 360, SKIN, -1)
    for hand in hands(k):
        cv2.ellipse(image, tuple(int(v) for v in hand), (11, 16), 20, 0, 360, SKIN, -1)
    return image


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("skin")
    (folder / "calibration.toml").write_text(CALIBRATION)
    with av.open(str(folder / "v.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.options = 320, 240, "yuv420p", {"crf": "12"}
        for k in range(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(drawn(k), format="rgb24")))
        container.mux(stream.encode())
    return folder


def load(folder, entry, camera=""):
    (folder / "take.toml").write_text(
        '[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam"\nvideo = "v.mp4"\n' + camera + entry
    )
    return load_observations(read_take(folder / "take.toml"))


SKIN_ENTRY = '\n[[keypoints]]\ncamera = "cam"\nformat = "skin"\n'
FACE = "face = [142, 40, 36, 50]\n"


def test_face_and_hands_are_keypoints_of_landmarks(folder):
    seen = load(folder, SKIN_ENTRY + FACE)
    (video,) = seen.skin
    assert seen.keypoints == () and (len(video), video.rate, video.sensor) == (20, 30.0, "cam")
    later = video.frame(12)  # asked for first: those before it are followed on the way
    assert later.names == ("nose_tip", "l_metacarpal_phalanx_3", "r_metacarpal_phalanx_3") and later.keypoint_set == ""
    for k in (4, 12, 19):
        frame = video.frame(k)
        left, right = hands(k)
        np.testing.assert_allclose(frame.uv, [(160, 65), left, right], atol=4)
        assert frame.confidence.min() > 0.3 and frame.time == pytest.approx(k / 30)
    np.testing.assert_array_equal(video.frame(12).uv, later.uv)


def test_some_frames_of_a_later_camera_by_wrists(folder):
    entry = SKIN_ENTRY + FACE + 'set = "WRISTS"\nframes = [5, 9]\n'
    (video,) = load(folder, entry, camera="time_offset = 0.1\n").skin
    np.testing.assert_allclose(video.times, 0.1 + np.arange(2, 6) / 30)
    assert video.names[1:] == ("l_wrist", "r_wrist") and video.at_step(5, 30.0) == 0 and video.at_step(9, 30.0) is None


def test_steps_without_a_frame_have_the_same_names(folder):
    """A smoother keeps the keypoints of all steps in one table."""
    entry = SKIN_ENTRY + FACE + "frames = [5, 9]\n"
    seen = load(folder, entry)
    recording, _ = recording_of(read_take(folder / "take.toml"), seen, load_body("humanoid"))
    frames = [recording.steps(i) for i in range(20)]
    assert all([f.names for f in step] == [frames[5][0].names] for step in frames)
    shown = [bool(np.isfinite(step[0].uv).any()) for step in frames]
    assert np.flatnonzero(shown).tolist() == [5, 6, 7, 8] and frames[15][0].time == pytest.approx(0.5)


def test_what_cannot_be_is_told(folder):
    with pytest.raises(TakeError, match="the place of the face is not stated"):
        load(folder, SKIN_ENTRY)
    with pytest.raises(KinefitError, match="no face at"):
        load(folder, SKIN_ENTRY + "face = [500, 40, 36, 50]\n").skin[0].frame(0)
    with pytest.raises(KinefitError, match="no larger than the image"):
        load(folder, SKIN_ENTRY + "face = [0, 0, 36, 1e308]\n")
    for keys, said in (
        ("face = [1, 2, 0, 4]\n", "face = "), (FACE + 'set = "BODY_25B"\n', "no keypoint set of skin 'BODY_25B'"),
        (FACE + "frames = [30, 40]\n", "none of its frames"), ("face = [1, 2, 3, nan]\n", "face = "),
    ):
        with pytest.raises(TakeError, match=said):
            load(folder, SKIN_ENTRY + keys)
    with pytest.raises(TakeError, match="no camera with a video"):
        (folder / "take.toml").write_text(
            '[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam"\n' + SKIN_ENTRY + FACE
        )
        read_take(folder / "take.toml")


@pytest.mark.parametrize(
    ("channels", "low", "high"),
    [
        ("rgb", [185, 130, 105], [225, 170, 145]), (None, [185, 130, 105], [225, 170, 145]),
        ("hsv", [5, 60, 180], [16, 130, 225]),
    ],
)
def test_silhouettes_by_colour(folder, channels, low, high):
    told = f'channels = "{channels}"\n' if channels else ""
    seen = load(folder, f'\n[[silhouette]]\ncamera = "cam"\nformat = "threshold"\nlow = {low}\nhigh = {high}\n{told}')
    (video,) = seen.of_kind("silhouette")
    assert (len(video), seen.frames) == (20, (0, 20))
    mask = video.frame(7).mask
    truth = cv2.inRange(drawn(7), (200, 145, 120), (210, 155, 130))
    assert np.count_nonzero((mask > 127) != (truth > 0)) < 0.08 * np.count_nonzero(truth)
    assert np.count_nonzero((mask > 20) & (mask < 235)) > 50  # an edge within pixels, by the Gaussian


def test_wrong_colours_are_told(folder):
    for keys, said in (
        ("low = [1, 2, 3]\n", "no colour"), ("low = [9, 0, 0]\nhigh = [1, 9, 9]\n", "lower ones first"),
        ("low = [0, 0, 0]\nhigh = [1, 9, 300]\n", "0 to 255"),
        ("low = [0, 0, 0]\nhigh = [9, 9, 9]\nsmooth = 0\n", "smooth"),
    ):
        with pytest.raises(TakeError, match=said):
            load(folder, f'\n[[silhouette]]\ncamera = "cam"\nformat = "threshold"\n{keys}')


def test_silhouettes_before_the_background(folder):
    entry = '\n[[silhouette]]\ncamera = "cam"\nformat = "background"\nfile = "{}.png"\n'
    cv2.imwrite(str(folder / "empty.png"), np.full((240, 320, 3), WALL[::-1], np.uint8))
    (video,) = load(folder, entry.format("empty")).of_kind("silhouette")
    truth = np.any(drawn(7) != WALL, axis=2)
    assert np.count_nonzero((video.frame(7).mask > 127) != truth) < 0.1 * np.count_nonzero(truth)
    cv2.imwrite(str(folder / "small.png"), np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(KinefitError, match="the background has") as caught:
        load(folder, entry.format("small"))
    assert caught.value.place == "silhouette of camera cam"
