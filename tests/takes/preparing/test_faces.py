"""Faces are hidden in what shows the cameras' images: between searched frames, from keypoints, where nobody looked."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.exporters.pictures.drawing import hide_all
from kinefit.geometry.camera import ImageFrame
from kinefit.observations import Keypoints
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.readers.videos.video import Video
from kinefit.takes.preparing import faces
from kinefit.takes.preparing.faces import Heads, ensure_faces, shown_video


def heads(*found, searched=(0, 6, 12, 18, 24), small=(0, 24)):
    return Heads(np.array(searched), np.array(small), np.array(found, float).reshape(-1, 5))


def test_a_head_that_moves_is_hidden_on_its_way():
    circles = heads((6, 100, 50, 20, 0), (12, 130, 50, 20, 0)).at(9)
    assert [115, 50, 20] in circles.tolist() and [100, 50, 20] in circles.tolist()
    far = heads((6, 100, 50, 20, 0), (12, 400, 50, 20, 0)).at(9)
    assert far.tolist() == [[100, 50, 20], [400, 50, 20]]  # two heads, not one that flew


def test_a_head_that_was_missed_once_is_hidden_by_its_neighbours():
    seen = heads((0, 100, 50, 20, 0), (18, 104, 50, 20, 0))
    assert len(seen.at(8)) == 2 and len(seen.at(23)) == 1
    assert len(heads((0, 9, 9, 9, 1)).at(20)) == 1, "small heads are searched less often"


@pytest.mark.parametrize(("frame", "looked"), [(-7, False), (-6, True), (30, True), (31, False)])
def test_frames_that_nobody_looked_at_are_told(frame, looked):
    assert (heads().at(frame) is not None) == looked


class Finds:
    """A detector that sees a head in the middle of every image."""

    images = 0

    def __init__(self, folder, threads=1):
        pass

    def __call__(self, image, *, small=False):
        Finds.images += 1
        return np.array([[image.shape[1] / 2, image.shape[0] / 2, 30.0, 0.0]])


@pytest.fixture
def found(monkeypatch, tmp_path):
    monkeypatch.setattr("kinefit.takes.preparing.faces.FaceDetector", Finds)
    monkeypatch.setattr(faces, "networks", lambda progress, tell: SimpleNamespace(folder=tmp_path))
    monkeypatch.setattr(Finds, "images", 0)


@pytest.fixture
def noisy(tmp_path):
    """A take of one camera whose video is noise."""
    rng = np.random.default_rng(0)
    with av.open(str(tmp_path / "cam.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for _ in range(12):
            image = cv2.resize(rng.integers(0, 255, (48, 64, 3)).astype(np.uint8), (320, 240))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode())
    (tmp_path / "take.toml").write_text('[take]\nhide_faces = true\n[[camera]]\nname = "cam"\nvideo = "cam.mp4"\n')
    return read_take(tmp_path / "take.toml")


def seen(take, *keypoints):
    return SimpleNamespace(
        videos={"cam": take.cameras[0].video}, rate=30.0, keypoints=keypoints, images={"cam": ImageFrame.identity()}
    )


def test_circles_are_blurred_and_the_rest_is_as_it_was(noisy, found):
    with shown_video(noisy, seen(noisy), "cam") as hidden, Video(noisy.cameras[0].video) as video:
        mine, plain = hidden.read(5), video.read(5)
        assert [len(list(v.frames(2, 5))) for v in (hidden, video)] == [3, 3]
    v, u = np.mgrid[:240, :320]
    inside = np.hypot(u - 160, v - 120) < 25
    assert mine[inside].std() < 0.4 * plain[inside].std()
    outside = np.hypot(u - 160, v - 120) > 33
    np.testing.assert_array_equal(mine[outside], plain[outside])
    with shown_video(replace(noisy, hide_faces=False), seen(noisy), "cam") as open_faced:
        np.testing.assert_array_equal(open_faced.read(5), plain)


def test_heads_of_keypoints_are_hidden_too_in_the_video_s_image(noisy, found):
    points = np.full((12, 1, 2, 2), np.nan)
    points[5, 0] = [[40, 100], [50, 100]]
    keypoints = Keypoints("cam", "OWN", ("nose", "left_ear"), 30.0, points, np.ones(points.shape[:3]))
    half = seen(noisy, keypoints)
    half.images["cam"] = ImageFrame(np.diag([2.0, 2.0, 1.0]))
    with shown_video(noisy, half, "cam") as hidden, Video(noisy.cameras[0].video) as video:
        changed = [(hidden.read(k) != video.read(k)).any(axis=2) for k in (5, 6, 9)]
    assert [c[190:210, 80:100].mean() > 0.9 for c in changed] == [True, True, False]


def test_frames_outside_of_the_take_are_hidden_whole(noisy, found):
    take = replace(noisy, frames=(0, 4))
    with shown_video(take, seen(take), "cam") as hidden, Video(noisy.cameras[0].video) as video:
        assert hidden.read(11).std() < 0.5 * video.read(11).std()


def test_a_video_is_looked_through_once_and_another_anew(noisy, found):
    steps = []
    ensure_faces(noisy, lambda *step: steps.append(step))
    assert Finds.images == 5 and steps[-1] == ("faces cam", 5, 5)  # every third frame, and the last
    ensure_faces(noisy)
    assert Finds.images == 5
    ensure_faces(replace(noisy, frames=(0, 4)))
    assert Finds.images > 5


@pytest.mark.parametrize("how", ["option", "key"])
def test_overlays_and_report_of_a_track_show_no_face(how, copy_take, found, tmp_path):
    path = copy_take(tmp_path / "take")
    path.write_text(path.read_text().replace("rate = 30.0", "rate = 30.0\nframes = [0, 4]"))
    plain = run(path, tmp_path / "plain")
    if how == "key":
        path.write_text(path.read_text().replace("[take]", "[take]\nhide_faces = true"))
    hidden = run(path, tmp_path / "hidden", *["--hide-faces"] * (how == "option"))
    size = plain[0].shape
    middle = np.s_[size[0] // 2 - 10 : size[0] // 2 + 10, size[1] // 2 - 10 : size[1] // 2 + 10]
    assert (plain[0][middle] != hidden[0][middle]).any() and plain[1] != hidden[1]
    shutil.rmtree(path.with_name("take-detect"))
    page = tmp_path / "check.html"
    args = ["check", str(path), "-o", str(page), *["--hide-faces"] * (how == "option")]
    assert CliRunner().invoke(main, args).exit_code == 0 and Finds.images > 0
    assert path.with_name("take-detect").is_dir()


def test_a_scene_shows_no_face(copy_take, found, tmp_path):
    from kinefit.studio.viewers.viewed import gather

    path = copy_take(tmp_path / "take")
    shown = [gather((path,), None, hide_faces=hide).pictures.read("cam01", 0.5, 200) for hide in (False, True)]
    changed = (shown[0] != shown[1]).any(axis=2)
    assert changed.any() and changed.mean() < 0.2


def test_images_in_which_faces_were_not_looked_for_are_blurred_as_a_whole(copy_take, tmp_path):
    path = copy_take(tmp_path / "take")
    take = replace(read_take(path), hide_faces=True)
    seen = load_observations(take)
    with shown_video(take, seen, "cam01", find=False) as hidden, Video(seen.videos["cam01"]) as video:
        np.testing.assert_array_equal(hidden.read(0), hide_all(video.read(0)))
    assert not list(path.parent.rglob("*-faces.npz"))


def run(path, out, *more):
    """Overlay's frame 2 of the first camera, and the report's text."""
    told = CliRunner().invoke(main, ["track", str(path), "-o", str(out), "--formats", "motion", "--no-report", *more])
    assert told.exit_code == 0, told.output
    first = sorted((out / "overlays").iterdir())[0]
    with Video(first) as video:
        return video.read(2), (out / "montage.png").read_bytes()
