"""`kinefit detect`: what it leaves, what it does not do twice, and what it says when it cannot."""

import shutil
import threading
from types import SimpleNamespace

import av
import click
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit.cli import main
from kinefit.cli.detect import detect
from kinefit.errors import AssetError, FileError, KinefitError, ObservationError, TakeError
from kinefit.exporters.motion_file import write_detections
from kinefit.images.detectors.box_detector import DetectedPerson
from kinefit.images.detectors.layouts import BLAZEPOSE
from kinefit.images.detectors.roi import SIZE, PersonLandmarks
from kinefit.observations import Detections
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.preparing import detecting
from kinefit.takes.preparing.take import ensure_detections, with_detections
from kinefit.takes.track import track_take

CAMERAS = ("cam01", "cam02", "cam03", "cam04")


class Networks:
    """See one person in the middle of every picture that is not quite black; count the pictures."""

    pictures, layout = 0, BLAZEPOSE
    lock = threading.Lock()

    def __init__(self, folder, threads=1, landmarks=None, *, mirrored=False):
        pass

    def find_people(self, image):
        height, width = image.shape[:2]
        middle = np.array([width / 2, height / 2])
        painted = (image == 128).all(axis=2).any()
        return [] if painted or not image.any() else [DetectedPerson(np.array([middle, middle - (0, height / 4)]), 0.9)]

    def search(self, image):
        return []

    def pose(self, crop, *, mask=True):
        with self.lock:
            Networks.pictures += 1
        inside = np.zeros((SIZE, SIZE), np.float32)
        inside[64:192, 64:192] = 1
        middle = np.array([128.0, 128.0])
        one, lifted = np.ones(33), np.zeros((33, 3))
        seen = inside if mask else None
        return PersonLandmarks(np.full((33, 2), 128.0), one, one, middle, middle - (0, 102.4), 1.0, seen, lifted)


def write_video(path, frames):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 544, 960, "yuv420p"
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((960, 544, 3), 250, np.uint8), "rgb24")))
        container.mux(stream.encode())


@pytest.fixture(scope="module")
def white_video(tmp_path_factory):
    path = tmp_path_factory.mktemp("white") / "white.mp4"
    write_video(path, 12)
    return path


@pytest.fixture
def take(take, white_video):
    """The drawn take with short white videos in place of its own."""
    for camera in CAMERAS:
        shutil.copy(white_video, take.with_name(f"{camera}.mp4"))
    return take


@pytest.fixture(autouse=True)
def networks(monkeypatch, tmp_path):
    monkeypatch.setattr("kinefit.images.detectors.box_detector.Models", Networks)
    monkeypatch.setattr(
        detecting, "networks", lambda progress, tell, quality: detecting.Networks(
            tmp_path, tmp_path, detecting._name_of(quality)
        ),
    )
    monkeypatch.setattr(Networks, "pictures", 0)
    return Networks


def run(*args):
    """The command as it stands; an error of kinefit's becomes exit code 2 and a message, as the group makes it."""
    told = CliRunner().invoke(detect, [str(arg) for arg in args])
    if told.exception and not isinstance(told.exception, SystemExit | KinefitError):
        raise told.exception
    return told


def test_only_the_take_s_frames_are_looked_through(take, networks, change):
    change(take, "[take]\n", "[take]\nframes = [2, 5]\n")
    ensure_detections(read_take(take), masks=True)
    first = networks.pictures
    assert 4 * 5 <= first < 4 * 8  # one more at both ends; the first picture is looked at twice
    found = read_detections(detections_file(take, "cam03"))
    assert len(found) == 12 and np.flatnonzero(found.seen[:, 0]).tolist() == [1, 2, 3, 4, 5]
    assert found.mask(5, 0).any() and found.mask(6, 0) is None and found.mask(0, 0) is None
    change(take, "[2, 5]", "[3, 4]")
    ensure_detections(read_take(take))
    assert networks.pictures == first
    change(take, "[3, 4]", "[3, 9]")
    ensure_detections(read_take(take))
    assert networks.pictures >= first + 4 * 8


def test_every_video_of_a_take_is_looked_through_once(take, networks):
    told = run(take)
    assert told.exit_code == 0, told.output
    assert {path.name for path in (take.parent / "take-detect").iterdir()} == {f"{c}.npz" for c in CAMERAS}
    assert "cam03: 12 images, person 1 in 12\n" in told.stdout
    found = read_detections(detections_file(take, "cam03"))
    assert len(found) == 12 and found.rate == 30 and found.size == (544, 960) and found.mask(5, 0).any()
    done = networks.pictures
    again = run(take)
    assert again.exit_code == 0 and networks.pictures == done
    assert again.stdout.count("(existing results)") == 4
    assert run(take, "--force").exit_code == 0 and networks.pictures == 2 * done


def test_another_video_or_setting_is_done_anew_and_only_that(take, networks):
    run(take)
    write_video(take.with_name("cam02.mp4"), 9)
    told = run(take)
    assert told.stdout.count("(existing results)") == 3
    assert "cam02: 9 images, person 1 in 9\n" in told.stdout
    assert run(take, "--people", 1).stdout.count("(existing results)") == 0
    assert run(take, "--people", 1, "--no-masks").stdout.count("(existing results)") == 0
    assert read_detections(detections_file(take, "cam02")).mask(0, 0) is None
    before = networks.pictures
    assert set(ensure_detections(read_take(take))) == set(CAMERAS)
    assert networks.pictures == before, "whoever does not care about the settings takes what is there"


def test_what_was_interrupted_goes_on_with_the_others(take, networks, monkeypatch):
    monkeypatch.setattr(detecting, "cores", lambda: 1)

    def stop(camera, done, total):
        if camera == "cam02" and done == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # of a worker here: it stops the others as an error does
        ensure_detections(read_take(take), masks=True, progress=stop)
    assert [path.name for path in (take.parent / "take-detect").iterdir()] == ["cam01.npz"]
    told = run(take)
    assert told.exit_code == 0 and told.stdout.count("(existing results)") == 1


def test_ctrl_c_says_how_much_is_kept(take, monkeypatch):
    def interrupted(futures, return_when):
        futures[0].result()
        raise KeyboardInterrupt

    monkeypatch.setattr(detecting, "cores", lambda: 1)
    monkeypatch.setattr(detecting, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt, match=r"[1-4] of 4 videos are done"):
        ensure_detections(read_take(take))
    assert detections_file(take, "cam01").is_file()


def test_one_damaged_video_stops_all_and_leaves_whole_files_only(take):
    path = take.with_name("cam02.mp4")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 7 // 10])
    with pytest.raises(FileError, match=r"cam02\.mp4"):
        ensure_detections(read_take(take))
    folder = take.parent / "take-detect"
    assert all(read_detections(file).seen.all() for file in (folder.iterdir() if folder.exists() else ()))


def see_nobody_in(monkeypatch, *videos):
    """Let the pictures of some videos be black."""
    from kinefit.readers.videos.video import Video

    frames = Video.frames

    def black(self, *args):
        return (image * (self.path.name not in videos) for image in frames(self, *args))

    monkeypatch.setattr(Video, "frames", black)


def test_a_camera_that_sees_nobody_is_left_out_with_a_note(take, monkeypatch):
    see_nobody_in(monkeypatch, "cam02.mp4")
    told = run(take)
    assert told.exit_code == 0
    assert "cam02: 12 images, no person" in told.stdout
    assert "finds no person in camera cam02 (12 images)" in told.stderr and "not used" in told.stderr
    with pytest.warns(UserWarning, match="no person in camera cam02"):  # in Python
        assert set(ensure_detections(read_take(take))) == {"cam01", "cam03", "cam04"}


def test_nobody_at_all_is_an_error_that_names_the_cameras(take, monkeypatch):
    see_nobody_in(monkeypatch, *(f"{name}.mp4" for name in CAMERAS))
    told = run(take)
    assert isinstance(told.exception, ObservationError)
    assert "finds no person in cam01 (12 images), cam02" in str(told.exception) and told.exception.remedy


def test_videos_alone_go_beside_themselves_or_where_they_are_wanted(take, tmp_path):
    videos = [take.with_name("cam01.mp4"), take.with_name("cam02.mp4")]
    assert run(*videos).exit_code == 0
    assert take.with_name("cam01-detect.npz").is_file() and take.with_name("cam02-detect.npz").is_file()
    assert run(*videos, "--out", tmp_path / "there").exit_code == 0
    assert {path.name for path in (tmp_path / "there").iterdir()} == {"cam01-detect.npz", "cam02-detect.npz"}


def test_a_take_reads_what_was_found(take):
    run(take)
    text, _, _ = take.read_text().partition("[[keypoints]]")
    entries = [f'[[keypoints]]\ncamera = "{c}"\nformat = "detect"\nfile = "take-detect/{c}.npz"\n' for c in CAMERAS]
    take.write_text("\n".join([text, *entries]))
    keypoints = load_observations(read_take(take)).keypoints
    assert [k.camera for k in keypoints] == list(CAMERAS)
    assert all(k.points.shape == (12, 1, 33, 2) and k.keypoint_set == "MEDIAPIPE_33" for k in keypoints)
    assert np.allclose(keypoints[0].points[3, 0], read_detections(detections_file(take, "cam01")).points[3, 0])


@pytest.mark.parametrize(
    ("args", "error", "message"),
    [
        (("none.toml",), FileError, "no such take"),
        (("none.mp4",), FileError, "none.mp4.*cannot be read"),
        (("take.toml", "more.mp4"), click.UsageError, "give one take without --out"),
        (("a/x.mp4", "b/x.mp4", "--out", "c"), click.UsageError, "two videos have the same name"),
    ],
)
def test_wrong_inputs_are_told(args, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told = run(*args)
    assert told.exit_code != 0
    if issubclass(error, KinefitError):
        assert isinstance(told.exception, error)
        with pytest.raises(error, match=message):
            raise told.exception
    else:
        assert told.exit_code == 2 and message in told.stderr


def test_a_take_without_videos_is_told(take):
    lines = take.read_text().splitlines()
    take.write_text("\n".join(line for line in lines if not line.startswith("video")))
    told = run(take)
    assert isinstance(told.exception, TakeError) and "no camera of the take has a video" in str(told.exception)


def test_the_missing_extra_is_told_before_anything_is_fetched(monkeypatch):
    monkeypatch.undo()
    import sys

    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    monkeypatch.setattr("kinefit.takes.preparing.detecting.detector_models", lambda progress: pytest.fail("fetched"))
    with pytest.raises(ObservationError, match=r"pip install 'kinefit\[detect\]'"):
        detecting.networks(None, pytest.fail)


def test_the_licence_is_shown_when_the_networks_are_fetched(monkeypatch, tmp_path):
    monkeypatch.undo()
    pytest.importorskip("ai_edge_litert")

    def fetch(progress):
        progress(0, 36_000_000)
        progress(36_000_000, 36_000_000)
        return tmp_path

    monkeypatch.setattr("kinefit.takes.preparing.detecting.detector_models", fetch)
    steps, said = [], []
    assert detecting.networks(lambda *step: steps.append(step), said.append).folder == tmp_path
    assert len(said) == 1 and "Apache-2.0" in said[0] and "MediaPipe" in said[0]
    assert steps == [("download MB", 0, 36), ("download MB", 36, 36)]
    monkeypatch.setattr("kinefit.takes.preparing.detecting.detector_models", lambda progress: tmp_path)
    detecting.networks(None, pytest.fail)  # nothing is said when they are there already


@pytest.mark.parametrize(("quality", "file"), [("balanced", "full"), ("auto", "heavy"), ("best", "heavy")])
def test_a_quality_is_a_landmark_network(monkeypatch, tmp_path, quality, file):
    monkeypatch.undo()
    pytest.importorskip("ai_edge_litert")
    monkeypatch.setattr("kinefit.takes.preparing.detecting.detector_models", lambda progress: tmp_path / "pip")
    monkeypatch.setattr("kinefit.takes.preparing.detecting.landmark_models", lambda progress: tmp_path / "npm")
    found = detecting.networks(None, pytest.fail, quality)
    assert (found.folder, found.landmarks.name, found.name) == (
        tmp_path / "pip", f"pose_landmark_{file}.tflite", quality
    )  # fmt: skip
    assert found.landmarks.parent.name == ("pip" if quality == "balanced" else "npm")


def test_where_the_large_network_cannot_be_had_the_other_stands_in_and_says_so(monkeypatch, tmp_path):
    monkeypatch.undo()
    pytest.importorskip("ai_edge_litert")

    def offline(progress):
        raise AssetError("npm could not fetch @mediapipe/pose", remedy="Check the network.")

    monkeypatch.setattr("kinefit.takes.preparing.detecting.detector_models", lambda progress: tmp_path)
    monkeypatch.setattr("kinefit.takes.preparing.detecting.landmark_models", offline)
    said = []
    found = detecting.networks(None, said.append, "best")
    assert found.name == "balanced" and found.landmarks == tmp_path / "pose_landmark_full.tflite"
    assert len(said) == 1 and "npm could not fetch" in said[0] and "'balanced'" in said[0]


def test_another_quality_is_looked_through_anew_and_none_keeps_what_is_there(take, networks, tmp_path):
    assert run(take, "--quality", "balanced").exit_code == 0
    first = networks.pictures
    assert run(take).exit_code == 0 and run(take, "--quality", "balanced").exit_code == 0
    assert networks.pictures == first
    assert run(take, "--quality", "best").exit_code == 0 and networks.pictures == 2 * first
    own = tmp_path / "own.tflite"
    own.write_bytes(b"a network")
    for times in (3, 3):  # the same file: done already
        assert run(take, "--network", own).exit_code == 0 and networks.pictures == times * first
    own.write_bytes(b"another network")
    assert run(take, "--network", own).exit_code == 0 and networks.pictures == 4 * first


def test_one_video_alone_at_best_is_looked_at_mirrored_too(take, networks, monkeypatch):
    asked = []
    monkeypatch.setattr(detecting, "_look_through", lambda job, files, *more: asked.append(files.mirrored))
    run(take.with_name("cam01.mp4"), "--quality", "best")
    run(take.with_name("cam01.mp4"), "--quality", "balanced")
    run(take, "--quality", "best")
    assert asked == [True, False] + [False] * 4


def test_hands_are_looked_for_where_they_are_asked_for_and_kept(take, networks, monkeypatch):
    class NoHands:
        def __init__(self, folder, threads=1):
            pass

        def find_palms(self, image):
            return []

        def landmarks(self, image, roi):
            return SimpleNamespace(presence=0.1)

    monkeypatch.setattr("kinefit.takes.preparing.detecting.HandModels", NoHands)
    file = detections_file(take, "cam01")
    assert run(take).exit_code == 0 and read_detections(file).hands is None
    first = networks.pictures
    told = run(take, "--hands")
    assert told.exit_code == 0 and "a left hand in 0, a right one in 0" in told.output
    found = read_detections(file)
    assert networks.pictures == 2 * first and found.hands.shape[2:] == (2, 21, 2) and (found.hand_confidence == 0).all()
    assert run(take).exit_code == 0 and run(take, "--hands").exit_code == 0 and networks.pictures == 2 * first
    assert run(take, "--no-hands").exit_code == 0 and read_detections(file).hands is None
    assert run(take, "--people", "0").exit_code == 2


def test_faces_are_looked_for_where_they_are_asked_for_and_kept(take, networks, monkeypatch):
    class NoFaces:
        def __init__(self, folder, threads=1):
            pass

        def landmarks(self, image, roi):
            return SimpleNamespace(presence=0.1)

    monkeypatch.setattr("kinefit.takes.preparing.detecting.FaceModels", NoFaces)
    file = detections_file(take, "cam01")
    assert run(take).exit_code == 0 and read_detections(file).face is None
    told = run(take, "--face")
    assert told.exit_code == 0 and "a face in 0" in told.output
    pictures = networks.pictures
    assert read_detections(file).face.shape[2:] == (478, 2)
    assert run(take).exit_code == 0 and run(take, "--face").exit_code == 0 and networks.pictures == pictures
    take.write_text(take.read_text() + '[[keypoints]]\ncamera = "cam01"\nformat = "detect"\nset = "MEDIAPIPE_478"\n')
    with pytest.raises(ObservationError, match="no face is found"):
        load_observations(with_detections(read_take(take)))
    assert run(take, "--no-face").exit_code == 0 and read_detections(file).face is None
    with pytest.raises(ObservationError, match="faces were not detected"):
        load_observations(read_take(take))


def test_a_network_that_is_not_there_and_two_wishes_at_once_are_told(take, tmp_path):
    told = run(take, "--network", tmp_path / "none.tflite")
    assert isinstance(told.exception, FileError) and "none.tflite" in str(told.exception)
    told = run(take, "--network", tmp_path / "own.tflite", "--quality", "best")
    assert told.exit_code == 2 and "not both" in told.stderr


def test_networks_that_cannot_be_had_are_told(monkeypatch, take):
    def offline(progress, tell, quality):
        raise AssetError("pip could not fetch mediapipe 0.10.21")

    monkeypatch.setattr(detecting, "networks", offline)
    with pytest.raises(AssetError, match="mediapipe"):
        ensure_detections(read_take(take))
    assert not take.with_name("take-detect").exists()


@pytest.fixture
def drawn(drawn_take, tmp_path):
    """The drawn take without keypoints, and a detector that finds those that it had."""
    shutil.copytree(drawn_take.parent, tmp_path / "drawn")
    take = tmp_path / "drawn" / "take.toml"
    text = take.read_text()
    take.write_text(text[: text.index("[[keypoints]]")])
    return take


def look(job, networks, settings, key, tell, threads):
    landmarks = np.load(job.video.with_name(f"mediapipe_{job.camera}.npy"))[:, None]
    points = np.where(landmarks[..., 2:] > 0, landmarks[..., :2], 0.5)
    nothing = np.zeros(0, np.uint32), np.zeros(len(points) + 1, int)
    found = Detections(job.camera, 30.0, (544, 960), points, landmarks[..., 2], *nothing)
    write_detections(found, job.file, key=key)


def test_python_detects_where_a_take_names_no_keypoints_as_the_command_does(drawn, monkeypatch, tmp_path):
    monkeypatch.setattr(detecting, "_look_through", look)
    steps = []
    motion, seen = track_take(drawn, progress=lambda what, done, total: steps.append(what))
    assert {path.name for path in (drawn.parent / "take-detect").iterdir()} == {f"{c}.npz" for c in CAMERAS}
    assert len(motion) == 60 and motion.quality.mean() > 0.9 and "frames" in steps
    assert [k.camera for k in seen.keypoints] == list(CAMERAS)
    monkeypatch.setattr(detecting, "_look_through", lambda *args: pytest.fail("done twice"))
    args = ["track", str(drawn), "--no-overlays", "--no-report", "--formats", "motion", "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(main, args).exit_code == 0
    same = read_motion(tmp_path / "out" / "motion.npz")
    np.testing.assert_array_equal(same.angles, motion.angles)


def test_outlines_are_made_where_a_take_follows_them_and_missing_ones_are_told(take, networks):
    text = take.read_text().replace("[take]\n", "[take]\nframes = [0, 10]\n", 1)
    wanted = text + '\n[[keypoints]]\ncamera = "cam01"\nformat = "detect"\n'
    take.write_text(wanted)
    with_detections(read_take(take))
    assert read_detections(detections_file(take, "cam01")).mask(5, 0) is None
    take.write_text(wanted + '\n[[silhouette]]\ncamera = "cam01"\nformat = "detect"\n')
    with pytest.raises(TakeError, match="has no silhouettes.*kinefit detect"):
        load_observations(read_take(take))
    with_detections(read_take(take))
    assert read_detections(detections_file(take, "cam01")).mask(5, 0).any()
    assert len(load_observations(read_take(take)).of_kind("silhouette")) == 1
