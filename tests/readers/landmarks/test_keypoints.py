"""Keypoints of detectors: real folders and arrays, and every bad file named."""

import json
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import FileError, ObservationError
from kinefit.geometry.camera import ImageFrame
from kinefit.observations import Keypoints
from kinefit.readers.guess.files import find_keypoints
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS, keypoint_names
from kinefit.readers.landmarks.keypoints import (
    read_caliscope_csv,
    read_keypoints,
    read_mediapipe,
    read_openpose,
)
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig


def person(count=17, value=100.0, confidence=0.9):
    return {"pose_keypoints_2d": [value, value + 1, confidence] * count, "face_keypoints_2d": []}


def write(folder, frames, name="cam_{:012d}_keypoints.json"):
    folder.mkdir(exist_ok=True)
    for i, people in frames.items():
        (folder / name.format(i)).write_text(json.dumps({"version": 1.3, "people": people}))
    return folder


def read(folder, **options):
    return read_openpose(folder, camera="cam", rate=50, **{"keypoint_set": "COCO_17", **options})


def test_sets_have_the_detectors_sizes_and_unique_names():
    sizes = {name: len(names) for name, names in KEYPOINT_SETS.items()}
    assert sizes == {
        "BODY_25B": 25, "BODY_25": 25, "COCO_17": 17, "COCO_18": 18, "HALPE_26": 26, "MEDIAPIPE_33": 33,
        "BODY_25_HANDS": 67, "COCO_WHOLEBODY_133": 133, "MEDIAPIPE_75": 75, "MEDIAPIPE_478": 478,
    }
    assert all(len(set(names)) == len(names) for names in KEYPOINT_SETS.values())
    assert KEYPOINT_SETS["MEDIAPIPE_33"][23:26] == ("left_hip", "right_hip", "left_knee")
    assert KEYPOINT_SETS["MEDIAPIPE_33"][9:13] == ("mouth_left", "mouth_right", "left_shoulder", "right_shoulder")
    with pytest.raises(ObservationError, match="no keypoint set 'BODY_26'; there are: BODY_25B"):
        keypoint_names("BODY_26")


def test_real_openpose_folders(data_dir):
    folder = data_dir("video_balancing_4cam") / "openpose_json"
    people = {}
    for camera in ("cam01", "cam02", "cam03", "cam04"):
        keypoints = read_openpose(folder / camera, camera=camera, rate=60)
        people[camera] = keypoints.points.shape[1]
        assert keypoints.points.shape == (100, people[camera], 25, 2)
        assert np.isnan(keypoints.points[keypoints.confidence == 0]).all()
        assert np.isfinite(keypoints.points[keypoints.confidence > 0]).all()
        assert keypoints.times[-1] == pytest.approx(99 / 60)

        def distance(a, b, points=keypoints.points[:, 0], names=keypoints.names):
            return np.nanmedian(np.linalg.norm(points[:, names.index(a)] - points[:, names.index(b)], axis=-1))

        assert distance("LHeel", "LAnkle") < 40 < distance("LHeel", "RAnkle")  # the order of the names is right
        assert distance("UpperNeck", "LShoulder") < distance("HeadTop", "LShoulder")
    assert people == {"cam01": 3, "cam02": 2, "cam03": 1, "cam04": 1}


def test_static_trial_names_with_digits_in_front(data_dir):
    folder = data_dir("video_balancing_4cam") / "static_trial" / "pose" / "cam02_json"
    assert read_openpose(folder, camera="cam02", rate=60).points.shape[0] == 12


def test_people_frames_and_unseen_points(tmp_path):
    unseen = person()
    unseen["pose_keypoints_2d"][3:6] = [0, 0, 0]
    folder = write(tmp_path / "json", {8: [person(value=1)], 9: [], 10: [person(value=3), unseen], 11: [person()]})
    keypoints = read(folder, time_offset=0.5)
    assert keypoints.points.shape == (4, 2, 17, 2)
    np.testing.assert_array_equal(np.isfinite(keypoints.points[..., 0]).sum(axis=(1, 2)), [17, 0, 17 + 16, 17])
    assert np.isnan(keypoints.points[2, 1, 1]).all()
    assert keypoints.points[2, 0, 0].tolist() == [3, 4]
    part = read(folder, time_offset=0.5, frames=(2, 4))
    np.testing.assert_array_equal(part.points, keypoints.points[2:])
    np.testing.assert_allclose(part.times, keypoints.times[2:])
    with pytest.raises(ObservationError, match=r"frames \[2, 5\] of 4"):
        read(folder, frames=(2, 5))


@given(st.lists(st.tuples(*[st.floats(-5000, 5000)] * 2, st.floats(0.01, 1)), min_size=17, max_size=17))
def test_what_is_written_is_read(tmp_path_factory, rows):
    flat = [number for row in rows for number in row]
    folder = write(tmp_path_factory.mktemp("k") / "json", {0: [{"pose_keypoints_2d": flat}]})
    keypoints = read(folder)
    np.testing.assert_array_equal(keypoints.points[0, 0], np.array(rows)[:, :2])
    np.testing.assert_array_equal(keypoints.confidence[0, 0], np.array(rows)[:, 2])


BAD = {
    "broken json": '{"people": [{"pose_keypoints_2d": [1, 2',
    "broken json.*people": '{"version": 1.3}',
    "broken json.*recursion": '{"a": ' + "[" * 100_000,
    "NaN": json.dumps({"people": [person(value=float("nan"))]}),
    "NaN or infinity": json.dumps({"people": [person(value=float("inf"))]}),
    "broken json.*null": json.dumps({"people": [person(value=0) | {"pose_keypoints_2d": [None] * 51}]}),
    "75 numbers where COCO_17 has 17 x 3": json.dumps({"people": [person(count=25)]}),
    "0 numbers": json.dumps({"people": [person(count=0)]}),
}


@pytest.mark.parametrize("problem", BAD)
def test_a_bad_file_is_named(tmp_path, problem):
    folder = write(tmp_path / "json", {0: [person()], 1: [person()], 2: [person()]})
    bad = folder / "cam_000000000001_keypoints.json"
    bad.write_text(BAD[problem])
    with pytest.raises(ObservationError, match=problem) as caught:
        read(folder)
    assert caught.value.file == bad
    assert caught.value.remedy


def test_the_keypoint_set_that_fits_is_proposed(tmp_path):
    with pytest.raises(ObservationError, match="This number fits: HALPE_26"):
        read(write(tmp_path / "json", {0: [person(count=26)]}))


def test_missing_and_doubled_frames(tmp_path):
    folder = write(tmp_path / "json", {0: [person()], 1: [person()], 4: [person()]})
    with pytest.raises(ObservationError, match="frames are missing between .*1.* and .*4"):
        read(folder)
    other = write(tmp_path / "two", {0: [person()]})
    write(other, {0: [person()]}, name="other_{:03d}.json")
    with pytest.raises(ObservationError, match="two frames with one number.*one camera in each folder"):
        read(other)
    (tmp_path / "named").mkdir()
    (tmp_path / "named" / "all.json").write_text("{}")
    with pytest.raises(ObservationError, match="no frame number"):
        read(tmp_path / "named")


def test_nobody_and_nothing(tmp_path):
    with pytest.raises(ObservationError, match="no person is detected in any of the 3 frames of camera cam"):
        read(write(tmp_path / "json", {0: [], 1: [], 2: []}))
    with pytest.raises(FileError, match="no such folder"):
        read(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileError, match="no json files"):
        read(tmp_path / "empty")
    with pytest.raises(ObservationError, match="rate"):
        read_openpose(write(tmp_path / "one", {0: [person()]}), camera="c", rate=0, keypoint_set="COCO_17")


def test_mediapipe_of_a_letterboxed_video(data_dir):
    path = data_dir("video_balancing_4cam") / "mediapipe_landmarks_cam01.npy"
    image = ImageFrame.letterboxed((1088, 1920), (1080, 1920))
    keypoints = read_mediapipe(path, camera="cam01", rate=60, image_frame=image)
    raw = np.load(path)
    assert keypoints.points.shape == (100, 1, 33, 2)
    np.testing.assert_allclose(image.from_calibration(keypoints.points[:, 0]), raw[..., :2], atol=1e-9)
    assert 0.5 < np.median(keypoints.points[..., 0] / raw[:, None, :, 0]) / (1088 / 1080) < 1.001
    np.testing.assert_allclose((keypoints.points[:, 0, :, 1] - 959.5) / (raw[..., 1] - 959.5), 1088 / 1080)
    np.testing.assert_array_equal(keypoints.confidence[:, 0], raw[..., 2])
    part = read_mediapipe(path, camera="cam01", rate=60, frames=(10, 20))
    assert part.times[0] == pytest.approx(10 / 60)
    np.testing.assert_array_equal(part.points[:, 0], raw[10:20, :, :2])


def test_both_detectors_agree_in_the_calibrations_frame(data_dir):
    """Knees and elbows of the two detectors are nearer to each other with the letterbox undone than without."""
    folder = data_dir("video_balancing_4cam")
    openpose = read_openpose(folder / "openpose_json" / "cam01", camera="cam01", rate=60)
    image = ImageFrame.letterboxed((1088, 1920), (1080, 1920))
    apart = []
    for frame in (None, image):
        mediapipe = read_mediapipe(folder / "mediapipe_landmarks_cam01.npy", camera="cam01", rate=60, image_frame=frame)
        ours = mediapipe.points[:, 0, [mediapipe.names.index(n) for n in ("left_knee", "right_knee", "left_elbow")]]
        theirs = openpose.points[:, :, [openpose.names.index(n) for n in ("LKnee", "RKnee", "LElbow")]]
        distance = np.linalg.norm(theirs - ours[:, None], axis=-1)
        apart.append(np.nanmedian(np.fmin.reduce(distance, axis=1)))
    assert apart[1] < apart[0]
    assert apart[1] < 15


def test_mediapipe_bad_arrays(tmp_path):
    def of(array):
        np.save(tmp_path / "m.npy", array)
        return read_mediapipe(tmp_path / "m.npy", camera="c", rate=30)

    good = np.ones((5, 33, 3))
    gap = good.copy()
    gap[2] = np.nan
    assert np.isnan(of(gap).points[2]).all() and np.isfinite(of(gap).points[[0, 1, 3, 4]]).all()
    gap[3, 7, 0] = np.nan
    with pytest.raises(ObservationError, match="frame 3.*left_ear"):
        of(gap)
    with pytest.raises(ObservationError, match="no person"):
        of(0 * good)
    with pytest.raises(ObservationError, match=r"shape \(5, 32, 3\)"):
        of(good[:, :32])
    with pytest.raises(FileError, match="no such file"):
        read_mediapipe(tmp_path / "none.npy", camera="c", rate=30)
    (tmp_path / "cut.npy").write_bytes((tmp_path / "m.npy").read_bytes()[:300])
    with pytest.raises(FileError, match="not a numpy array"):
        read_mediapipe(tmp_path / "cut.npy", camera="c", rate=30)


@pytest.mark.parametrize("points", [468, 478])
def test_a_face_mesh_has_a_depth_in_place_of_a_visibility(tmp_path, points):
    mesh = np.random.default_rng(0).uniform(100.0, 600.0, (5, points, 3))
    mesh[..., 2] = -0.1
    mesh[1], mesh[2] = 0.0, np.nan
    np.save(tmp_path / "m.npy", mesh)
    seen = read_mediapipe(tmp_path / "m.npy", camera="c", rate=30)
    assert seen.keypoint_set == "MEDIAPIPE_478" and seen.points.shape == (5, 1, 478, 2)
    assert [seen.names[k] for k in (7, 33, 473)] == ["face_7", "right_face_eye_outer", "left_face_iris"]
    assert np.array_equal(seen.points[0, 0, :points], mesh[0, :, :2])
    assert np.array_equal(seen.confidence[:, 0, :468].all(axis=1), [True, False, False, True, True])
    assert seen.confidence[0, 0, 468:].all() == (points == 478)
    np.save(tmp_path / "shares.npy", mesh / 600.0)
    with pytest.raises(ObservationError, match="0 to 1"):
        read_mediapipe(tmp_path / "shares.npy", camera="c", rate=30)


def test_caliscope_table(data_dir, tmp_path):
    path = data_dir("mv4_landmarks_caliscope") / "HOLISTIC" / "xy_HOLISTIC.csv"
    cameras = read_caliscope_csv(path)
    assert list(cameras) == ["cam_0", "cam_1", "cam_2", "cam_3"]
    assert all(k.points.shape == (267, 1, 75, 2) and k.keypoint_set == "MEDIAPIPE_75" for k in cameras.values())
    assert cameras["cam_0"].rate == pytest.approx(30.4, abs=0.1)
    assert cameras["cam_0"].points[0, 0, 0].tolist() == [520, 193]
    (tmp_path / "x.csv").write_text("sync_index,port\n0,1\n")
    with pytest.raises(FileError, match="no column frame_time"):
        read_caliscope_csv(tmp_path / "x.csv")
    with pytest.raises(FileError, match="No such file"):
        read_caliscope_csv(tmp_path / "y.csv")
    apart = np.concatenate([_of_wrists(k) for k in cameras.values()])
    assert np.all(np.nanmedian(apart, axis=0)[[0, 1], [0, 1]] < 35)  # each hand at its own side's wrist
    assert np.all(np.nanmedian(apart, axis=0)[[0, 1], [1, 0]] > 35)
    rows = path.read_text().splitlines()
    alone = [rows[0], *(row for row in rows[1:] if int(row.split(",")[4]) < 33)]
    (tmp_path / "x.csv").write_text("\n".join(alone))
    without = read_caliscope_csv(tmp_path / "x.csv")["cam_0"]
    assert without.keypoint_set == "MEDIAPIPE_33"
    np.testing.assert_array_equal(without.points, cameras["cam_0"].points[:, :, :33])
    text = path.read_text().splitlines()[:9]
    (tmp_path / "x.csv").write_text("\n".join([*text, "0,0,0,1.0,3,abc,5,,"]))
    with pytest.raises(FileError, match="not a number"):
        read_caliscope_csv(tmp_path / "x.csv")


def _of_wrists(record):
    """(F, 2, 2) [px] from the left and right hand's wrist to the pose's left and right wrist."""
    at = record.points[:, 0, [record.names.index(n) for n in ("left_hand_wrist", "right_hand_wrist")]]
    pose = record.points[:, 0, [record.names.index(n) for n in ("left_wrist", "right_wrist")]]
    return np.linalg.norm(at[:, :, None] - pose[:, None], axis=-1)


def test_openpose_with_hands(tmp_path):
    left = [v for k in range(21) for v in (10.0 + k, 20.0, 0.8)]
    body = {"pose_keypoints_2d": [5.0, 6.0, 0.9] * 25}
    frames = {0: [body | {"hand_left_keypoints_2d": left, "hand_right_keypoints_2d": []}], 1: [body]}
    seen = read(write(tmp_path / "cam", frames), keypoint_set="BODY_25_HANDS")
    assert len(seen.names) == 67 and seen.names[25] == "LHandWrist" and seen.names[-1] == "RHandLittle4"
    assert seen.points[0, 0, seen.names.index("LHandIndex1")].tolist() == [15.0, 20.0]
    assert np.isnan(seen.points[0, 0, 46:]).all() and not seen.confidence[1, 0, 25:].any()
    assert read(tmp_path / "cam", keypoint_set="BODY_25").points.shape[2] == 25  # without them, too
    short = [body | {"hand_left_keypoints_2d": left[:-3]}]
    with pytest.raises(ObservationError, match="198 numbers where BODY_25_HANDS has 67 x 3"):
        read(write(tmp_path / "cut", {0: short}), keypoint_set="BODY_25_HANDS")


def test_mediapipe_with_hands(tmp_path):
    data = np.ones((4, 75, 3))
    data[2, 54:] = np.nan  # a hand that is not seen
    data[3, 33:54] = 0.0
    np.save(tmp_path / "m.npy", data)
    seen = read_mediapipe(tmp_path / "m.npy", camera="c", rate=30)
    assert seen.keypoint_set == "MEDIAPIPE_75" and seen.names[33] == "left_hand_wrist"
    assert np.isnan(seen.points[2, 0, 54:]).all() and np.isfinite(seen.points[2, 0, :54]).all()
    assert not seen.confidence[3, 0, 33:54].any() and seen.confidence[3, 0, 54:].all()
    data[1, 40, 0] = np.nan
    np.save(tmp_path / "m.npy", data)
    with pytest.raises(ObservationError, match="frame 1.*left_index_dip"):
        read_mediapipe(tmp_path / "m.npy", camera="c", rate=30)


def test_any_format(data_dir, tmp_path):
    folder = data_dir("video_balancing_4cam")
    by_kind = read_keypoints(folder / "openpose_json" / "cam03", camera="cam03", rate=60)
    assert by_kind.keypoint_set == "BODY_25B"
    assert read_keypoints(folder / "mediapipe_landmarks_cam03.npy", camera="c", rate=60).keypoint_set == "MEDIAPIPE_33"
    with pytest.raises(ObservationError, match="no keypoint format 'theia'; there are: openpose, alphapose"):
        read_keypoints(tmp_path, format="theia", camera="c", rate=60)


def depths(rng, shape):
    return rng.normal(0.0, 0.15, shape)


def of_record(data):
    names = keypoint_names("MEDIAPIPE_33")
    return Keypoints("c", "MEDIAPIPE_33", names, 30.0, data[:, None, :, :2], data[:, None, :, 2])


NO_CONFIDENCE = {  # of a third value: what it is, and what is said of it
    "z in shares of the width": (depths, "% of them below 0", "depth"),
    "z in pixels": (lambda rng, shape: 900.0 * depths(rng, shape), "% of them below 0", "depth"),
    "z of somebody far away": (lambda rng, shape: 0.05 * depths(rng, shape), "% of them below 0", "depth"),
    "logits": (lambda rng, shape: rng.normal(3.0, 2.5, shape), "% of them below 0", "logits"),
    "percentages": (lambda rng, shape: rng.uniform(20.0, 100.0, shape), "from 20", "divide them by 100"),
    "metres from the camera": (lambda rng, shape: rng.uniform(2.0, 3.5, shape), "from 2 to 3.5", "depth"),
    "millimetres from the camera": (lambda rng, shape: rng.uniform(1900.0, 2600.0, shape), "from 1.9e+03 to", "depth"),
}


@pytest.mark.parametrize("kind", NO_CONFIDENCE)
@pytest.mark.parametrize("format", ["array", "json", "record"])
def test_a_third_value_that_is_no_confidence(tmp_path, kind, format):
    make, problem, cause = NO_CONFIDENCE[kind]
    rng = np.random.default_rng(0)
    data = np.dstack([rng.uniform(100.0, 900.0, (20, 33, 2)), make(rng, (20, 33, 1))])
    with pytest.raises(ObservationError, match="no confidence or visibility") as caught:
        if format == "array":
            np.save(tmp_path / "m.npy", data)
            read_mediapipe(tmp_path / "m.npy", camera="c", rate=30)
        elif format == "json":
            rows = {i: [{"pose_keypoints_2d": frame[:17].ravel().tolist()}] for i, frame in enumerate(data)}
            read(write(tmp_path / "json", rows))
        else:
            of_record(data)
    assert problem in caught.value.problem and cause in caught.value.remedy
    assert caught.value.file == {"array": tmp_path / "m.npy", "json": tmp_path / "json", "record": None}[format]


def test_scores_that_detectors_give():
    def confidence(scores):
        scores = np.array(scores, float).reshape(1, 1, -1)
        names, uv = tuple(f"p{k}" for k in range(scores.size)), np.full((*scores.shape, 2), 300.0)
        return Keypoints("c", "any", names, 30.0, uv, scores).confidence[0, 0].tolist()

    assert confidence([0.2, 1.4, 0.97, 1.1]) == [0.2, 1.0, 0.97, 1.0]  # heatmaps of OpenPose
    assert confidence([-0.02, 0.3, *[0.9] * 20]) == [0.0, 0.3, *[0.9] * 20]  # by little below 0
    assert confidence([6.8, 0.4, 2.1, 5.5]) == [1.0, 0.4, 1.0, 1.0]  # SimCC of RTMW
    assert confidence([2, 1, 0, 2]) == [1.0, 0.5, 0.0, 1.0]  # COCO's flags
    assert confidence([1, 0, 1]) == [1.0, 0.0, 1.0]
    assert confidence([-1, 0.8, -1]) == [0.0, 0.8, 0.0]  # not detected
    assert confidence([-1, -1]) == [0.0, 0.0]


@pytest.mark.parametrize("format", ["array", "json", "record"])
@pytest.mark.parametrize("low", [0.0, -1.0])
def test_coordinates_in_shares_of_the_image(tmp_path, format, low):
    rng = np.random.default_rng(0)
    data = np.dstack([rng.uniform(low, 1.0, (20, 33, 2)), rng.uniform(0.2, 1.0, (20, 33, 1))])
    with pytest.raises(ObservationError, match="from 0 to 1 .shares of the image's size.") as caught:
        if format == "array":
            np.save(tmp_path / "m.npy", data)
            turned = ImageFrame.rotated((1920, 1080), 90)  # by which they become large
            read_mediapipe(tmp_path / "m.npy", camera="c", rate=30, image_frame=turned)
        elif format == "json":
            rows = {i: [{"pose_keypoints_2d": frame[:17].ravel().tolist()}] for i, frame in enumerate(data)}
            read(write(tmp_path / "json", rows))
        else:
            of_record(data)
    assert "Multiply x by the image's width" in caught.value.remedy


def test_users_arrays_with_a_depth_in_the_third_column(data_dir):
    for case in ("keypoints-z-in-place-of-visibility", "keypoints-normalised-z"):
        take = data_dir("cases_of_users") / case / "take.toml"
        with pytest.raises(ObservationError, match="36 % of them below 0") as caught:
            load_observations(read_take(take))
        assert caught.value.file == take.with_name("mp1.npy")


MOTION = squat_and_wave(duration=1.0)
RIG = studio_rig(MOTION)


def people_of(keypoint_set, folder, order=None):
    """A folder of OpenPose's json of one camera, with points of a set, in another order where one is given."""
    record = simulate_keypoints(MOTION, RIG, keypoint_set, noise_px=3.0)[0]
    rows = np.nan_to_num(np.dstack([record.points[:, 0], record.confidence[:, 0]]))
    rows = rows if order is None else rows[:, order]
    return write(folder, {i: [{"pose_keypoints_2d": frame.ravel().tolist()}] for i, frame in enumerate(rows)})


@pytest.mark.parametrize("keypoint_set", ["BODY_25", "BODY_25B", "COCO_17", "COCO_18", "HALPE_26"])
def test_the_set_follows_from_the_number_of_points_and_the_bones(tmp_path, keypoint_set):
    folder = people_of(keypoint_set, tmp_path / "json")
    seen = read_openpose(folder, camera="c", rate=30)
    assert seen.keypoint_set == keypoint_set and seen.names == KEYPOINT_SETS[keypoint_set]
    stated = read_openpose(folder, camera="c", rate=30, keypoint_set=keypoint_set)
    np.testing.assert_array_equal(stated.points, seen.points)


@pytest.mark.parametrize(("right", "wrong"), [("BODY_25", "BODY_25B"), ("BODY_25B", "BODY_25")])
def test_a_stated_set_of_as_many_points_that_does_not_fit(tmp_path, right, wrong):
    folder = people_of(right, tmp_path / "json")
    with pytest.raises(ObservationError, match=f"order of {right}: as {wrong}, bones are 2.. times as long") as caught:
        read_openpose(folder, camera="c", rate=30, keypoint_set=wrong)
    assert f'set = "{right}"' in caught.value.remedy and caught.value.file == str(folder)


def test_openpose_s_own_model_without_a_set(data_dir):
    seen = load_observations(read_take(data_dir("cases_of_users") / "openpose-body25-without-set" / "take.toml"))
    assert [k.keypoint_set for k in seen.keypoints] == 4 * ["BODY_25"]


OTHERS = {  # a file that no reader takes: what is said of it
    "annotations.json": (b'{"images": [{"file_name": "a.jpg"}], "annotations": []}', "COCO's annotations"),
    "tracks.h5": (b"\x89HDF\r\n\x1a\nand nothing more", "HDF5, of which DeepLabCut's and SLEAP's is read"),
    "table.csv": (b"a,b\n1,2\n", "a file of another kind"),
    "notes.json": (b'{"notes": 3}', "a file of another kind"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_file_that_no_reader_takes_is_said_for_what_it_is(tmp_path, name):
    content, said = OTHERS[name]
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ObservationError, match=f"{said}.*no keypoints of a known form") as caught:
        read_keypoints(path, camera="c", rate=30.0)
    assert caught.value.file == path and "AlphaPose, MMPose" in caught.value.remedy
    if "another kind" in said:
        assert find_keypoints([path], []) == ([], [])
    else:
        (remark,) = find_keypoints([path], [])[1]
        assert remark.startswith(f"{name}: ") and said in remark and "not used" in remark
        with pytest.raises(ObservationError, match=f"{said}.*no keypoints of a known form"):
            read_keypoints(path, format="mediapipe", camera="c", rate=30.0)


@pytest.mark.parametrize("format", [None, "sleap", "deeplabcut"])
def test_hdf5_without_the_package_that_reads_it(tmp_path, monkeypatch, format):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["node_names"] = [1.0]
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ObservationError, match=r"read with the package h5py \(kinefit\[hdf5\]\)"):
        read_keypoints(path, format=format, camera="c", rate=30.0)
    found, (remark,) = find_keypoints([path], [])
    assert not found and "kinefit[hdf5]" in remark


def test_alphapose_s_results_named_as_openpose(data_dir):
    path = data_dir("cases_of_users") / "keypoints-alphapose-results" / "alphapose-results.json"
    for named in (path, path.parent):
        with pytest.raises(ObservationError, match="all frames' people by AlphaPose.*not openpose") as caught:
            read_openpose(named, camera="c", rate=30.0)
        assert caught.value.file == path and 'format = "alphapose"' in caught.value.remedy


OLD = {"pose_keypoints_2d": "pose_keypoints", "hand_left_keypoints_2d": "hand_left_keypoints"}


def test_keys_of_older_versions(tmp_path):
    people = [person(25) | {"hand_left_keypoints_2d": [7.0, 8.0, 0.5] * 21}]
    new = read(write(tmp_path / "new", {0: people}), keypoint_set="BODY_25_HANDS")
    old = read(write(tmp_path / "old", {0: [{OLD.get(k, k): v for k, v in people[0].items()}]}), keypoint_set=None)
    assert old.keypoint_set in ("BODY_25", "BODY_25B") and old.points.shape == (1, 1, 25, 2)
    old = read(tmp_path / "old", keypoint_set="BODY_25_HANDS")
    np.testing.assert_array_equal(old.points, new.points)
    np.testing.assert_array_equal(old.confidence, new.confidence)
    assert new.confidence[0, 0, 25:46].tolist() == [0.5] * 21
    (tmp_path / "cmu").mkdir()
    for i in range(2):  # AlphaPose's form "cmu", one file an image
        frame = {"version": "AlphaPose v0.3", "bodies": [{"joints": [100.0, 101.0, 0.9] * 18}] * i}
        (tmp_path / "cmu" / f"{i}.json").write_text(json.dumps(frame))
    cmu = read(tmp_path / "cmu", keypoint_set=None)
    assert cmu.keypoint_set == "COCO_18" and np.isfinite(cmu.points[:, 0, 0, 0]).tolist() == [False, True]


def test_people_that_pose2sim_did_not_associate(tmp_path):
    """`pose-associated` has an empty object in the place of a person that a camera does not see."""
    seen = read(write(tmp_path / "json", {0: [{}, person(value=5)], 1: [{}, {}], 2: [person(value=7), {}]}))
    assert seen.points.shape == (3, 1, 17, 2) and seen.points[[0, 2], 0, 0, 0].tolist() == [5, 7]
    assert not seen.confidence[1].any()
    with pytest.raises(ObservationError, match="broken json.*pose_keypoints_2d"):
        read(write(tmp_path / "other", {0: [{"face_keypoints_2d": []}]}))


def freemocap(cameras=2, frames=4, points=553):
    data = np.random.default_rng(0).uniform(100.0, 600.0, (cameras, frames, points, 3))
    data[..., 2] = -50.0  # a depth
    data[1, 2] = np.nan
    data[0, 1, 33:54] = np.nan  # the right hand
    return data


@pytest.mark.parametrize("points", [33, 75, 553])
def test_freemocap(tmp_path, points):
    data = freemocap(points=points)
    path = tmp_path / "mediapipe2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy"
    np.save(path, data)
    seen = read_keypoints(path, camera="Camera_001", rate=30.0)
    assert (seen.camera, seen.rate) == ("Camera_001", 30.0)
    assert seen.keypoint_set == ("MEDIAPIPE_33" if points == 33 else "MEDIAPIPE_75")
    assert not seen.confidence[2].any() and (seen.confidence[[0, 1, 3]] == 1.0).all()
    np.testing.assert_array_equal(seen.points[0, 0, :33], data[1, 0, :33, :2])
    first = read_keypoints(path, camera="cam_0", rate=30.0)
    if points > 33:
        at = [first.names.index(name) for name in ("left_hand_wrist", "right_hand_wrist")]
        np.testing.assert_array_equal(first.points[0, 0, at], data[0, 0, [54, 33], :2])
        assert first.confidence[1, 0, at].tolist() == [1.0, 0.0]
    if points == 553:
        face = read_keypoints(path, camera="cam_0", rate=30.0, keypoint_set="MEDIAPIPE_478")
        np.testing.assert_array_equal(face.points[0, 0], data[0, 0, 75:, :2])
    else:
        with pytest.raises(ObservationError, match="landmarks have shape"):
            read_keypoints(path, camera="cam_0", rate=30.0, keypoint_set="MEDIAPIPE_478")
    with pytest.raises(ObservationError, match="no camera in this file named 'Camera_7'; there are: cam_0, cam_1"):
        read_keypoints(path, camera="Camera_7", rate=30.0)
    found, _ = find_keypoints([path], [])
    assert [(k.format, k.frames, k.points) for k in found] == [("freemocap", 4, points)]


def test_freemocap_s_points_in_space_are_not_read(tmp_path):
    path = tmp_path / "mediapipe3dData_numFrames_numTrackedPoints_spatialXYZ.npy"
    np.save(path, freemocap()[0])
    with pytest.raises(ObservationError, match=r"landmarks have shape \(4, 553, 3\)"):
        read_keypoints(path, camera="cam_0", rate=30.0)
    found, (remark,) = find_keypoints([path], [])
    assert not found and "landmarks in images" in remark
