"""Results of detectors that write all frames into one file: AlphaPose, COCO and MMPose, in each form."""

import json

import numpy as np
import pytest

from kinefit.errors import ObservationError
from kinefit.readers.guess.files import find_keypoints
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.landmarks.keypoints import read_keypoints
from kinefit.readers.plugins import KEYPOINTS
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

MOTION = squat_and_wave(duration=1.0)
RIG = studio_rig(MOTION)


def seen_of(keypoint_set):
    """(F, K, 3) x, y [px], confidence of one simulated person, and the record."""
    record = simulate_keypoints(MOTION, RIG, keypoint_set, noise_px=3.0)[0]
    return np.nan_to_num(np.dstack([record.points[:, 0], record.confidence[:, 0]])), record


def written(path, content):
    path.write_text(json.dumps(content))
    return path


def alphapose(rows, name="{}.jpg", **more):
    of = [{"image_id": name.format(i), "category_id": 1, "keypoints": row.ravel().tolist(), "score": 2.9} | more
          for i, row in enumerate(rows)]  # fmt: skip
    return of


def by_image(rows, people, keypoints):
    return {f"{i}.jpg": {"version": "AlphaPose v0.3", people: [{keypoints: row.ravel().tolist()}]}
            for i, row in enumerate(rows)}  # fmt: skip


def mmpose(rows, first=0):
    return [{"frame_id": i, "instances": [
        {"keypoints": row[:, :2].tolist(), "keypoint_scores": row[:, 2].tolist(), "bbox": [[0, 0, 9, 9]]}
    ]} for i, row in enumerate(rows, first)]  # fmt: skip


FORMS = {
    "list": ("alphapose", alphapose),
    "list with identities": ("alphapose", lambda rows: alphapose(rows, idx=3, box=[1.0, 2.0, 3.0, 4.0])),
    "COCO's ids": ("alphapose", lambda rows: [one | {"image_id": i + 40} for i, one in enumerate(alphapose(rows))]),
    "images": ("alphapose", lambda rows: alphapose(rows, "walk_{:04d}.png")),
    "open": ("alphapose", lambda rows: by_image(rows, "people", "pose_keypoints_2d")),
    "cmu": ("alphapose", lambda rows: by_image(rows, "bodies", "joints")),
    "frames": ("mmpose", mmpose),
    "meta_info": ("mmpose", lambda rows: {"meta_info": {"names": 999 * ["nose"]}, "instance_info": mmpose(rows, 1)}),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("keypoint_set", ["COCO_17", "COCO_18", "HALPE_26", "BODY_25", "COCO_WHOLEBODY_133"])
def test_every_form_and_set_gives_the_simulated_points(tmp_path, form, keypoint_set):
    format, make = FORMS[form]
    names = KEYPOINT_SETS[keypoint_set]
    if keypoint_set == "COCO_WHOLEBODY_133":
        rows = np.zeros((4, 133, 3))
        rows[...] = np.arange(133)[:, None] + [100.0, 200.0, 0.0]
        rows[..., 2] = 0.9
    else:
        rows, record = seen_of(keypoint_set)
        assert record.names == names
    path = written(tmp_path / "all.json", make(rows))
    assert KEYPOINTS.name_of(path) == format
    seen = read_keypoints(path, camera="c", rate=30.0)
    assert (seen.keypoint_set, seen.names, seen.rate, seen.camera) == (keypoint_set, names, 30.0, "c")
    np.testing.assert_allclose(np.nan_to_num(seen.points[:, 0]), rows[..., :2])
    np.testing.assert_allclose(seen.confidence[:, 0], np.clip(rows[..., 2], 0.0, 1.0))
    (found,), remarks = find_keypoints([path], [])
    assert (found.format, found.frames, found.points, remarks) == (format, len(rows), len(names), [])


def test_frames_without_people_and_several_people(tmp_path):
    rows = np.full((4, 17, 3), 200.0) + np.arange(17)[:, None]
    rows[..., 2] = 0.9
    people = [alphapose(rows)[0] | {"image_id": f"{i}.jpg", "idx": k} for i, k in ((2, 1), (4, 1), (4, 7))]
    seen = read_keypoints(written(tmp_path / "video.json", people), camera="c", rate=30.0)
    assert seen.confidence.any(axis=2).sum(axis=1).tolist() == [0, 0, 1, 0, 2]  # a video's frame 0 is its first
    images = [one | {"image_id": f"walk_{int(one['image_id'][0]):04d}.png"} for one in people]
    seen = read_keypoints(written(tmp_path / "images.json", images), camera="c", rate=30.0)
    assert seen.confidence.any(axis=2).sum(axis=1).tolist() == [1, 0, 2]  # where images begin is not known
    frames = [*mmpose(rows[:1], 1), {"frame_id": 2, "instances": []}, *mmpose(rows[:2], 3)]
    seen = read_keypoints(written(tmp_path / "mm.json", frames), camera="c", rate=30.0)
    assert seen.confidence.any(axis=2).sum(axis=1).tolist() == [1, 0, 1, 1]


def test_face_and_hands_of_halpe_are_left_out(tmp_path):
    rows = seen_of("HALPE_26")[0]
    more = np.concatenate([rows, np.full((len(rows), 110, 3), 0.5)], axis=1)
    for wide in (more, more[:, :68]):
        seen = read_keypoints(written(tmp_path / "a.json", alphapose(wide)), camera="c", rate=30.0)
        assert seen.keypoint_set == "HALPE_26"
        np.testing.assert_allclose(np.nan_to_num(seen.points[:, 0]), rows[..., :2])


def test_the_third_value_follows_the_same_rules(tmp_path):
    rows = seen_of("COCO_17")[0]
    flags = rows.copy()
    flags[..., 2] = np.where(np.arange(17) % 2, 2, 1)
    seen = read_keypoints(written(tmp_path / "flags.json", alphapose(flags)), camera="c", rate=30.0)
    assert seen.confidence[0, 0, :2].tolist() == [0.5, 1.0]
    rows[..., 2] = np.random.default_rng(0).normal(0.0, 5.0, rows.shape[:2])
    with pytest.raises(ObservationError, match="no confidence or visibility"):
        read_keypoints(written(tmp_path / "z.json", mmpose(rows)), camera="c", rate=30.0)
    shares = seen_of("COCO_17")[0] * [1e-3, 1e-3, 1.0]
    with pytest.raises(ObservationError, match="coordinates run from 0 to 1"):
        read_keypoints(written(tmp_path / "shares.json", alphapose(shares)), camera="c", rate=30.0)


ROW = np.tile([[[100.0, 200.0, 0.9]]], (2, 17, 1))
IN_3D = [{"frame_id": 0, "instances": [{"keypoints": [[1.0, 2.0, 3.0]] * 17, "keypoint_scores": [0.9] * 17}]}]
BAD = {
    "no frame number in the name of the image 'a.jpg'": alphapose(ROW, "a.jpg"),
    "2 frames in 100000001 of frames": [alphapose(ROW)[0], alphapose(ROW)[1] | {"image_id": "100000000.jpg"}],
    "57 numbers where BODY_25B has 25 x 3": alphapose(np.tile(ROW[:, :1], (1, 19, 1))),
    "frame 0, person 1: 42 numbers where COCO_17 has 17 x 3": [*alphapose(ROW), *alphapose(ROW[:, :14])],
    "broken json.*length 2": IN_3D,
    "broken json.*17 points and 1 scores": [{"frame_id": 0, "instances": [
        {"keypoints": [[1.0, 2.0]] * 17, "keypoint_scores": [0.9]}]}],
    "broken json.*keypoints": [{"image_id": "0.jpg", "category_id": 1, "keypoints": [None]}],
    "NaN or infinity": alphapose(ROW * [np.nan, 1.0, 1.0]),
    "no person is detected in any of the 2 frames of camera c": [{"frame_id": k, "instances": []} for k in (1, 2)],
}


@pytest.mark.parametrize("problem", BAD)
def test_a_bad_file_is_named(tmp_path, problem):
    path = written(tmp_path / "a.json", BAD[problem])
    with pytest.raises(ObservationError, match=problem) as caught:
        read_keypoints(path, camera="c", rate=30.0)
    assert str(caught.value.file) == str(path) and caught.value.remedy
    faults = []
    assert find_keypoints([path], faults) == ([], []) and len(faults) == 1


def test_a_set_that_is_stated(tmp_path):
    path = written(tmp_path / "a.json", mmpose(seen_of("BODY_25")[0]))
    assert read_keypoints(path, camera="c", rate=30.0, keypoint_set="BODY_25").keypoint_set == "BODY_25"
    with pytest.raises(ObservationError, match="the points are in the order of BODY_25"):
        read_keypoints(path, camera="c", rate=30.0, keypoint_set="BODY_25B")
    with pytest.raises(ObservationError, match="75 numbers where HALPE_26 has 26.*This number fits: BODY_25B, BODY_25"):
        read_keypoints(path, camera="c", rate=30.0, keypoint_set="HALPE_26")
    with pytest.raises(ObservationError, match="AlphaPose.*not mmpose|MMPose.*not alphapose"):
        read_keypoints(path, format="alphapose", camera="c", rate=30.0)


def test_alphapose_s_results_of_a_user(data_dir):
    path = data_dir("cases_of_users") / "keypoints-alphapose-results" / "alphapose-results.json"
    seen = read_keypoints(path, camera="c", rate=30.0)
    people = json.loads(path.read_text())
    frames = [int(one["image_id"].split(".")[0]) for one in people]
    assert seen.keypoint_set == "COCO_17" and len(seen) == 30 and len(set(frames)) == 28
    assert np.flatnonzero(seen.confidence.any(axis=(1, 2))).tolist() == sorted(frames)
    assert seen.points[0, 0].ravel().tolist() == [v for k, v in enumerate(people[0]["keypoints"]) if k % 3 < 2]
