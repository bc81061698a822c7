"""Networks of ONNX files: what is recognised, how outputs become points, what is wrong with others."""

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from benchmarks.accuracy.detection.onnx_networks import (
    COLOURS,
    constant_network,
    draw,
    heatmap_network,
    simcc_network,
    yolox_network,
)

from kinefit.errors import FileError, ObservationError, PluginError
from kinefit.images.detectors.detection import Follower, detect_people
from kinefit.images.detectors.layouts import BLAZEPOSE, PointLayout
from kinefit.images.detectors.networks import CropInput, TopDownModels
from kinefit.observations import Detections
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.landmarks.networks import (
    NETWORKS,
    NetworkFormat,
    NetworkSigma,
    open_people,
    open_points,
    read_description,
    read_sigma,
    write_sigma,
)

NETWORKS_OF = {"simcc": simcc_network, "heatmaps": heatmap_network}
POINTS = np.array([[30.0 + 40 * (k % 4), 25.0 + 48 * (k // 4)] for k in range(17)])  # in a crop of 192 x 256 px


@pytest.fixture(params=NETWORKS_OF)
def network(request, tmp_path):
    return NETWORKS_OF[request.param](tmp_path / "own.onnx")


def test_points_are_found_and_named_by_their_number(network):
    find, layout = open_points(network)
    points, confidence = find(draw(POINTS, (192, 256), 5))
    assert layout.keypoint_set == "COCO_17" and layout.names[:2] == ("Nose", "LEye") and layout.size == (192, 256)
    assert np.abs(points - POINTS).max() < 2.1, "half a cell of 4 px"
    assert (confidence > 0.8).all() and (confidence <= 1).all()
    assert (find(np.zeros((256, 192, 3), np.uint8))[1] < 0.05).all()


def test_simcc_has_its_bins_between_pixels(tmp_path):
    find, _ = open_points(simcc_network(tmp_path / "own.onnx"))
    points, _ = find(draw(POINTS, (192, 256), 5))
    assert np.abs(points - POINTS).max() < 0.6 and (points % 1 == 0.5).any()


@pytest.mark.parametrize("count", [17, 19])
def test_halves_and_inputs_of_any_size(tmp_path, count):
    file = simcc_network(tmp_path / "own.onnx", count, size=("width", "height"), half=True)
    names = [f"point_{k}" for k in range(count)]
    with pytest.raises(FileError, match="no size of its own") as told:
        open_points(file)
    assert "size = [width, height]" in told.value.remedy and "own.toml" in told.value.remedy
    file.with_suffix(".toml").write_text(f"size = [96, 128]\npoints = {names}".replace("'", '"'))
    find, layout = open_points(file)
    assert layout.size == (96, 128) and layout.keypoint_set == "" and layout.names == tuple(names)
    points = np.array([[10.0 + 20 * (k % 4), 12.0 + 24 * (k // 4)] for k in range(count)])
    assert np.abs(find(draw(points, (96, 128), 4))[0] - points).max() < 0.6


def test_what_the_file_beside_it_states_counts(tmp_path):
    file = heatmap_network(tmp_path / "own.onnx", 19)
    with pytest.raises(FileError, match="19 points, of which nothing tells the names"):
        open_points(file)
    file.with_suffix(".toml").write_text('points = "COCO_17"\nmapping = { LWrist = 18, Nose = 3 }\ncolours = "RGB"')
    find, layout = open_points(file)
    assert layout.names == ("Nose", "LWrist") and layout.keypoint_set == "COCO_17"
    there = np.vstack([POINTS, [[40.0, 225.0], [120.0, 225.0]]])
    assert np.abs(find(draw(there, (192, 256), 5))[0] - there[[3, 18]]).max() < 2.1
    file.with_suffix(".toml").write_text('points = "COCO_17"\nmapping = { LWrist = 18 }\ncolours = "BGR"')
    assert open_points(file)[0](draw(there[:1] * np.nan, (192, 256), 5))[1] < 0.1


@pytest.mark.parametrize(("text", "message"), [
    ('points = "COCO_71"', "COCO_71"), ('points = ["a", "b"]', "2 different names for a network of 17"),
    ('mapping = { Nose = 17 }', "Nose is point 17 of 17"), ('mapping = { Tail = 1 }', "Tail"),
    ("size = [0, 3]", "size"), ('colour = "BGR"', "colour"), ("std = [1, 0, 1]", "std"), ("points = [", "own.toml"),
    ('output = ["none"]', "cannot be run"),
])  # fmt: skip
def test_a_wrong_description_is_told(tmp_path, text, message):
    file = simcc_network(tmp_path / "own.onnx")
    file.with_suffix(".toml").write_text(text)
    with pytest.raises(FileError) as told:
        open_points(file)
    assert message in str(told.value) and told.value.remedy


def test_pixels_are_normalised_as_stated():
    image = np.array([[[10, 20, 30]]], np.uint8)
    rgb = CropInput((10.0, 10.0, 10.0), (2.0, 5.0, 10.0))(image)
    np.testing.assert_allclose(rgb.ravel(), [0.0, 2.0, 2.0])
    bgr = CropInput((0.0, 0.1, 0.0), (1.0, 1.0, 1.0), "BGR", 0.01)(image, np.float16)
    assert bgr.dtype == np.float16 and bgr.shape == (1, 3, 1, 1)
    np.testing.assert_allclose(bgr.ravel(), [0.3, 0.1, 0.1], atol=1e-3)


def zeros(*shape):
    return np.zeros(shape, np.float32)


@pytest.mark.parametrize(("outputs", "message"), [
    ({"a": zeros(1, 21, 256, 192)}, "segments images"), ({"a": zeros(1, 56, 8400)}, "YOLO-pose"),
    ({"dets": zeros(1, 5, 5), "points": zeros(1, 5, 17, 3)}, "RTMO"), ({"a": zeros(1, 8400, 85)}, "detector of boxes"),
    ({"a": zeros(1, 21, 64, 48)}, "one hand"), ({"a": zeros(1, 1000)}, "no known network"),
    ({"x": zeros(1, 17, 384), "y": zeros(1, 17, 500)}, "no known network"),
    ({"dets": zeros(1, 5, 5), "labels": np.zeros((1, 5), np.int64)}, "detector of boxes"),
])  # fmt: skip
def test_other_kinds_of_networks_are_named(tmp_path, outputs, message):
    with pytest.raises(FileError, match=message) as told:
        open_points(constant_network(tmp_path / "own.onnx", outputs))
    assert told.value.remedy and "own.onnx" in str(told.value)


def test_files_that_are_no_networks_are_named(tmp_path):
    file, outputs = tmp_path / "own.onnx", {"a": zeros(1, 17, 64, 48)}
    with pytest.raises(FileError, match="no such network"):
        open_points(file)
    with file.open("wb") as zeroed:
        zeroed.truncate(10**9)
    with pytest.raises(FileError, match="not an ONNX file"):
        open_points(file)
    file.write_bytes(b"\x08 this is text")
    with pytest.raises(FileError, match="not a network that onnxruntime runs"):
        open_points(file)
    with pytest.raises(FileError, match=r"onnxruntime runs .*Absent"):
        open_points(simcc_network(file, domain="of.nobody"))
    for given, message in (
        ({"shape": [1, 256, 192, 3]}, "not one image"), ({"shape": [4, 3, 256, 192]}, "not one image"),
        ({"kind": 11}, "its input is a tensor"), ({"shape": [1, 3, 99999, 192]}, "an input of"),
    ):  # fmt: skip
        with pytest.raises(FileError, match=message):
            open_points(_of_kind(file, outputs, given))


def _of_kind(file, outputs, given):
    """A network without operators on its input, of any type."""
    from benchmarks.accuracy.detection.onnx_networks import save
    from onnx import helper, numpy_helper

    image = helper.make_tensor_value_info("image", given.get("kind", 1), given.get("shape", [1, 3, 256, 192]))
    infos = [helper.make_tensor_value_info(name, 1, value.shape) for name, value in outputs.items()]
    nodes = [helper.make_node("Identity", [f"{name}_value"], [name]) for name in outputs]
    weights = [numpy_helper.from_array(value, f"{name}_value") for name, value in outputs.items()]
    return save(helper.make_graph(nodes, "any", [image], infos, weights), file)


def test_the_missing_extra_is_told(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ObservationError, match=r"pip install 'kinefit\[onnx\]'"):
        open_points(tmp_path / "own.onnx")


def test_yolox_and_rtmdet_find_people(tmp_path):
    image = np.full((320, 320, 3), 255, np.uint8)
    (person,) = open_people(yolox_network(tmp_path / "y.onnx", (80, 70, 60, 120)), aspect=4 / 3)(image)
    np.testing.assert_allclose(person.points, [[160, 140], [160, 140 - 120]], atol=1e-3)  # twice the network's size
    assert person.score == pytest.approx(0.9)
    assert open_people(yolox_network(tmp_path / "y.onnx", (80, 70, 60, 120)), aspect=4 / 3)(image * 0) == []
    boxes = np.array([[[50, 10, 110, 130, 0.8], [52, 12, 111, 131, 0.7], [1, 1, 9, 9, 0.9], [0, 0, 9, 9, 0.1]]])
    outputs = {"dets": boxes.astype(np.float32), "labels": np.array([[0, 0, 56, 0]], np.int64)}
    found = open_people(constant_network(tmp_path / "r.onnx", outputs, (160, 160)), aspect=1.0)(image)
    assert len(found) == 1, "one of two boxes of a person; no chair, nothing unsure"
    np.testing.assert_allclose(found[0].points, [[160, 140], [160, 20]])
    with pytest.raises(FileError, match="no detector of people"):
        open_people(heatmap_network(tmp_path / "h.onnx"))


def people_video(count, step=2.0, turns=0):
    """Images of a person of 17 discs that walks, and their points (F, 17, 2) [px]."""
    truth = POINTS * 1.5 + np.array([[60.0, 40.0]]) + step * np.arange(count)[:, None, None] * [1.0, 0.0]
    images = [np.ascontiguousarray(np.rot90(draw(points, (640, 480), 8), turns)) for points in truth]
    return images, truth


def models_of(tmp_path, file, **more):
    find, layout = open_points(file)
    people = open_people(yolox_network(tmp_path / "y.onnx", (45, 60, 60, 100)), aspect=4 / 3)
    return TopDownModels(find, layout, people, **more)


@pytest.mark.parametrize("mirrored", [False, True])
def test_people_are_followed_without_masks_and_points_in_space(network, tmp_path, mirrored):
    images, truth = people_video(20)
    found = detect_people(images, models_of(tmp_path, network, mirrored=mirrored), camera="c", rate=10.0)
    assert found.points.shape == (20, 1, 17, 2) and found.seen.all() and found.lifted is None
    assert found.keypoint_set == "COCO_17" and found.names == KEYPOINT_SETS["COCO_17"] and found.mask(3, 0) is None
    assert np.median(np.abs(found.points[:, 0] - truth)) < 4.0
    assert found.confidence.mean() > 0.6
    keypoints = found.keypoints()
    assert keypoints.keypoint_set == "COCO_17" and keypoints.lifted is None
    assert detect_people([image * 0 for image in images], models_of(tmp_path, network), camera="c",
                         rate=10.0).points.shape[1] == 0  # fmt: skip


def test_a_second_look_exchanges_left_and_right():
    layout = PointLayout("COCO_WHOLEBODY_133", KEYPOINT_SETS["COCO_WHOLEBODY_133"], (192, 256))
    names = [layout.names[k] for k in layout.mirror]
    assert names[:3] == ["Nose", "REye", "LEye"] and "".join(names).count("LHand") == 21
    pairs = {"Face0": "Face16", "Face8": "Face8", "Face17": "Face26", "Face27": "Face27", "Face36": "Face45",
             "Face41": "Face46", "Face48": "Face54", "Face60": "Face64", "Face66": "Face66"}  # fmt: skip
    assert {a: names[layout.names.index(a)] for a in pairs} == pairs
    assert sorted(layout.mirror) == list(range(133)) and [layout.mirror[k] for k in layout.mirror] == list(range(133))
    assert [BLAZEPOSE.names[k] for k in BLAZEPOSE.sides("wrist")] == ["left_wrist", "right_wrist"]
    assert BLAZEPOSE.head == list(range(11))
    assert [layout.names[k] for k in layout.sides("wrist")] == ["LWrist", "RWrist"]


def test_two_people_have_columns_of_their_own(network, tmp_path):
    class TwoPeople:
        """Regions of both, whatever is painted over."""

        def __init__(self, layout):
            self.layout = layout

        def __call__(self, image):
            from kinefit.images.detectors.box_detector import DetectedPerson

            return [DetectedPerson(np.array([[u, 240.0], [u, 60.0]]), 0.9) for u in (150.0, 470.0)]

        search = __call__

    find, layout = open_points(network)
    models = TopDownModels(find, layout, TwoPeople(layout))
    points = np.concatenate([POINTS * 1.5 + [10, 40], POINTS * 1.5 + [330, 40]])
    image = draw(points[:17], (640, 480), 8) + draw(points[17:], (640, 480), 8)
    follower = Follower(models, 10.0, people=3)
    for _ in range(8):
        people = follower.update(image)
    assert [p.column for p in people] == [0, 1] and all(p.lifted is None and not len(p.runs) for p in people)
    for person, truth in zip(people, (points[:17], points[17:])):
        assert np.median(np.abs(person.points - truth)) < 4.0


def test_sigma_is_read_and_makes_confidences(tmp_path):
    sigma = NetworkSigma(confidence=[0.2, 0.6, 0.9], sigma=[0.08, 0.02, 0.01], points={"RShoulder": 2.0})
    assert write_sigma(sigma, tmp_path / "own.onnx").name == "own.sigma.toml"
    assert read_sigma(tmp_path / "own.onnx") == sigma and read_sigma(tmp_path / "other.onnx") is None
    from kinefit.observations import Keypoints

    points = np.tile(POINTS * 2.0, (3, 1, 1, 1))
    confidence = np.full((3, 1, 17), 0.6)
    confidence[..., 0], confidence[..., 1], confidence[..., 2] = 0.95, 0.0, 0.4
    made = sigma.calibrated(Keypoints("c", "COCO_17", KEYPOINT_SETS["COCO_17"], 10.0, points, confidence), 17)
    assert made.sigma == pytest.approx(0.01 * 2 * 192.0)  # the extent of the points, 192 px in the crop
    np.testing.assert_allclose(made.confidence[0, 0, :4], [1.0, 0.0, 0.04, 0.25])
    assert made.confidence[0, 0, 6] == pytest.approx(0.25 / 4.0), "its own factor"
    np.testing.assert_allclose(made.sigma / np.sqrt(made.confidence[0, 0, 3]), 0.02 * 2 * 192.0)
    for text in ("confidence = [0.5]\nsigma = [0.1, 0.2]", "confidence = [0.5, 0.7]\nsigma = [0.1, 0.2]", "sigma = 1"):
        (tmp_path / "own.sigma.toml").write_text(text)
        with pytest.raises(FileError, match="own.sigma.toml"):
            read_sigma(tmp_path / "own.onnx")


def test_a_plug_in_reads_files_of_its_own(tmp_path, monkeypatch):
    (tmp_path / "own.pt").touch()
    layout = PointLayout("COCO_17", KEYPOINT_SETS["COCO_17"], (192, 256))
    load = lambda path, threads: (lambda crop: (path, 1), layout)
    own = NetworkFormat(summary="PyTorch", suffixes=(".pt",), load=load)
    monkeypatch.setattr(type(NETWORKS), "names", lambda self: ("torch",))
    monkeypatch.setattr(type(NETWORKS), "get", lambda self, name: own)
    find, found = open_points(tmp_path / "own.pt")
    assert found is layout and find(None) == (tmp_path / "own.pt", 1)
    assert read_description(tmp_path / "own.pt").points is None and len(COLOURS) == 19
    assert issubclass(PluginError, Exception)


def test_hands_and_faces_are_looked_for_by_the_points_that_a_network_has():
    from kinefit.images.detectors.faces import around_head, around_wrist

    layout = PointLayout("COCO_17", KEYPOINT_SETS["COCO_17"], (192, 256))
    points = np.zeros((17, 2))
    of = {name: k for k, name in enumerate(layout.names)}
    points[[of["LElbow"], of["LWrist"]]] = (100.0, 100.0), (200.0, 100.0)
    points[[of["LShoulder"], of["RShoulder"]]] = (140.0, 160.0), (60.0, 160.0)
    head = [of[name] for name in ("Nose", "LEye", "REye", "LEar", "REar")]
    points[head] = (100, 50), (108, 42), (92, 42), (118, 46), (82, 46)
    hand, face = around_wrist(points, 0, layout), around_head(points, layout)
    assert hand.centre[0] > 210 and hand.centre[1] == pytest.approx(100) and hand.turn == pytest.approx(np.pi / 2)
    assert np.linalg.norm(face.centre - [100, 46]) < 5 and face.turn == pytest.approx(0.0)
    few = PointLayout("", ("r_heel", "l_heel"), (192, 256))
    assert around_head(points[:2], few) is None and few.mirror == [1, 0] and few.head == [0, 1]


@pytest.mark.parametrize(("name", "whole"), [
    ("COCO_17", "COCO_WHOLEBODY_133"), ("HALPE_26", "COCO_WHOLEBODY_133"), ("BODY_25", "BODY_25_HANDS"),
    ("MEDIAPIPE_33", "MEDIAPIPE_75"),
])  # fmt: skip
def test_hands_join_the_set_that_has_them(name, whole):
    K = len(KEYPOINT_SETS[name])
    hands = np.arange(2 * 2 * 21 * 2, dtype=float).reshape(2, 1, 2, 21, 2)
    found = Detections(
        "c", 10.0, (640, 480), np.full((2, 1, K, 2), 50.0), np.ones((2, 1, K)), np.zeros(0, np.uint32),
        np.zeros(3, int), hands=hands, hand_confidence=np.ones((2, 1, 2, 21)), keypoint_set=name,
        names=KEYPOINT_SETS[name],
    )  # fmt: skip
    keypoints = found.keypoints()
    assert keypoints.keypoint_set == whole and len(keypoints.names) == K + 42 == keypoints.points.shape[2]
    right_wrist = "right_hand_wrist" if name == "MEDIAPIPE_33" else "RHandWrist"
    at = keypoints.names.index(right_wrist)
    assert set(keypoints.names[K:]) <= set(KEYPOINT_SETS[whole])
    np.testing.assert_array_equal(keypoints.points[1, 0, at], hands[1, 0, 1, 0])


def test_names_of_no_set_are_landmarks_of_the_body():
    from kinefit.bodies import load_body
    from kinefit.sensors.channels import make_channels
    from kinefit.simulation import studio_rig

    rig, body, names = studio_rig(cameras=2), load_body("humanoid"), ("r_heel", "l_heel")
    records = [
        Detections(
            camera, 10.0, (640, 480), np.full((2, 1, 2, 2), 50.0), np.ones((2, 1, 2)), np.zeros(0, np.uint32),
            np.zeros(3, int), keypoint_set="", names=names,
        ).keypoints()
        for camera in rig.names
    ]  # fmt: skip
    channels = make_channels(body, rig, records, [8.0, 8.0])
    assert channels.points.names == names and channels.uv.shape == (2, 4, 2)
