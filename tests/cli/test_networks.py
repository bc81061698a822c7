"""`kinefit detect --network` with small ONNX networks on drawn videos, and what `kinefit track` makes of it."""

import av
import numpy as np
import pytest
from click.testing import CliRunner

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from benchmarks.accuracy.detection.onnx_networks import (
    constant_network,
    draw,
    heatmap_network,
    simcc_network,
    yolox_network,
)

from kinefit.cli import main
from kinefit.cli.detect import detect
from kinefit.errors import FileError, KinefitError, TakeError
from kinefit.observations import MEDIAPIPE_33
from kinefit.readers.landmarks.detections import detections_file, detections_key, read_detections
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.landmarks.networks import read_sigma
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.preparing import detecting
from kinefit.takes.preparing.take import with_detections

CAMERAS = ("cam01", "cam02", "cam03", "cam04")
FRAMES = 24


def truth_of(take, camera):
    """(F, 17, 2) [px] COCO's points of the drawn take."""
    places = {"L": "left_", "R": "right_"}
    names = [f"{places[n[0]]}{n[1:].lower()}" if n != "Nose" else "nose" for n in KEYPOINT_SETS["COCO_17"]]
    landmarks = np.load(take.with_name(f"mediapipe_{camera}.npy"))
    return landmarks[:FRAMES, [MEDIAPIPE_33.index(n) for n in names], :2]


@pytest.fixture(scope="module")
def drawn(copy_take, tmp_path_factory):
    """A take of videos in which a person's joints are coloured discs, and a detector of people; not to be changed."""
    take = copy_take(tmp_path_factory.mktemp("discs"))
    for camera in CAMERAS:
        with av.open(str(take.with_name(f"{camera}.mkv")), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = 544, 960, "bgr0"
            for points in truth_of(take, camera):
                image = draw(points, (544, 960), 9)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24").reformat(format="bgr0")))
            container.mux(stream.encode())
    text = take.read_text()
    text = text[: text.index("[[keypoints]]")].replace(".mp4", ".mkv")
    take.write_text(text)
    box = np.concatenate([truth_of(take, c) for c in CAMERAS]).reshape(-1, 2)
    low, high = box.min(axis=0) / 6, box.max(axis=0) / 6  # 960 px are 160
    yolox_network(take.with_name("people.onnx"), (*(low + high) / 2, *(high - low)))
    return take


@pytest.fixture
def take(drawn, tmp_path):
    import shutil

    shutil.copytree(drawn.parent, tmp_path / "take")
    return tmp_path / "take" / drawn.name


def run(*args):
    told = CliRunner().invoke(detect, [str(arg) for arg in args])
    if told.exception and not isinstance(told.exception, SystemExit | KinefitError):
        raise told.exception
    return told


def off(take, camera):
    """(F, 17) [px] of the first person's points from the drawn ones."""
    found = read_detections(detections_file(take, camera))
    return np.linalg.norm(found.points[:, 0] - truth_of(take, camera), axis=-1)


def test_a_take_is_detected_and_tracked_by_a_network_of_its_own(take, tmp_path, monkeypatch):
    monkeypatch.setattr("kinefit.takes.preparing.detecting.detector_models", lambda progress: pytest.fail("fetched"))
    network = simcc_network(take.with_name("own.onnx"))
    given = "--network", network, "--detector", take.with_name("people.onnx"), "--people", 1
    told = run(take, *given)
    assert told.exit_code == 0, told.output
    assert "No masks are added to the points of own.onnx" in told.stderr
    assert f"cam03: {FRAMES} images, person 1 in {FRAMES}\n" in told.stdout
    for camera in CAMERAS:
        assert np.median(off(take, camera)) < 3.0
    found = read_detections(detections_file(take, "cam01"))
    assert found.network == str(network) and found.keypoint_set == "COCO_17" and found.lifted is None
    key = detections_key(detections_file(take, "cam01"))
    assert run(take, *given).stdout.count("(existing results)") == 4
    out = tmp_path / "out"
    args = ["track", str(take), "--no-overlays", "--no-report", "--formats", "motion", "--out", str(out)]
    assert CliRunner().invoke(main, args).exit_code == 0
    motion = read_motion(out / "motion.npz")
    assert len(motion) == FRAMES and motion.quality.mean() > 0.8
    assert detections_key(detections_file(take, "cam01")) == key, "the fit takes what the network found"
    seen = load_observations(with_detections(read_take(take)))
    assert {k.keypoint_set for k in seen.keypoints} == {"COCO_17"}
    network.with_suffix(".toml").write_text('colours = "RGB"\n')
    assert run(take, *given).stdout.count("(existing results)") == 0, "described otherwise"
    network.with_name(f"{network.name}.data").write_bytes(b"other weights")
    assert run(take, *given).stdout.count("(existing results)") == 0, "with other weights beside it"


def test_what_is_stale_is_redone_with_the_same_network(take, monkeypatch):
    network = heatmap_network(take.with_name("own.onnx"))
    files = take.with_name("cam01.mkv"), take.with_name("cam02.mkv")
    for file in files:
        assert run(file, "--network", network, "--detector", take.with_name("people.onnx")).exit_code == 0

    class Asked(Exception):
        """Which networks are wanted."""

    def networks(progress, tell, quality):
        raise Asked(quality)

    monkeypatch.setattr(detecting, "networks", networks)
    job = detecting.DetectionJob("cam02", files[0], take.with_name("cam02-detect.npz"))  # of another video
    with pytest.raises(Asked) as wanted:
        detecting.detect([job], tell=print)
    assert wanted.value.args == (network,)


def test_confidence_is_calibrated_and_used(take):
    network = simcc_network(take.with_name("own.onnx"))
    given = "--network", network, "--detector", take.with_name("people.onnx"), "--people", 1
    told = run(take, *given, "--calibrate")
    assert told.exit_code == 0, told.output
    assert "Written, from" in told.stdout and "own.sigma.toml" in told.stdout
    sigma = read_sigma(network)
    assert 0 < min(sigma.sigma) <= max(sigma.sigma) < 0.05 and set(sigma.points) == set(KEYPOINT_SETS["COCO_17"])
    calibrated = load_observations(with_detections(read_take(take))).keypoints[0]
    raw = load_observations(with_detections(read_take(take)), calibrated=False).keypoints[0]
    assert raw.sigma is None and 0.1 < calibrated.sigma < 10.0
    assert not np.array_equal(raw.confidence, calibrated.confidence)
    again = run(take, *given, "--calibrate")
    assert again.exit_code == 0 and read_sigma(network) == sigma, "of raw confidences, not of its own result"
    from kinefit.bodies import load_body
    from kinefit.fitting.tracking.take_recording import recording_of

    prepared = with_detections(read_take(take))
    recording = recording_of(prepared, load_observations(prepared), load_body("humanoid"))[0]
    assert recording.sigma["cam01 COCO_17"] == calibrated.sigma


def test_what_cannot_be_calibrated_is_told(take):
    network, people = simcc_network(take.with_name("own.onnx")), take.with_name("people.onnx")
    assert "give --network too" in run(take, "--calibrate").stderr
    assert "not videos alone" in run(take.with_name("cam01.mkv"), "--calibrate", "--network", network).stderr
    text = take.read_text()
    for camera in CAMERAS[2:]:
        text = text.replace(f'video = "{camera}.mkv"\n', "")
    take.write_text(text)
    told = run(take, "--network", network, "--detector", people, "--calibrate")
    assert isinstance(told.exception, TakeError) and "2 cameras see somebody" in str(told.exception)


def test_a_network_of_another_kind_is_told_before_a_video_is_read(take):
    zeros = np.zeros((1, 56, 8400), np.float32)
    other = constant_network(take.with_name("own.onnx"), {"output0": zeros})
    told = run(take, "--network", other, "--detector", take.with_name("people.onnx"))
    assert isinstance(told.exception, FileError) and "YOLO-pose" in str(told.exception)
    assert not take.with_name("take-detect").exists()
    told = run(take, "--network", heatmap_network(other), "--detector", other)
    assert isinstance(told.exception, FileError) and "no detector of people" in str(told.exception)


def test_silhouettes_need_a_network_with_masks(take):
    network = simcc_network(take.with_name("own.onnx"))
    assert run(take, "--network", network, "--detector", take.with_name("people.onnx")).exit_code == 0
    entry = '[[{}]]\ncamera = "cam01"\nformat = "detect"\nfile = "take-detect/cam01.npz"\n'
    take.write_text(take.read_text() + entry.format("keypoints") + entry.format("silhouette"))
    with pytest.raises(TakeError, match="has no silhouettes.*built-in detector"):
        load_observations(read_take(take))
