"""Cameras beside markers are found along with the person; beside keypoints alone their errors are in the bars."""

import numpy as np
import pytest

from kinefit import Recording, TrackSettings, read_take, track, track_take
from kinefit.errors import TakeError
from kinefit.fitting.subject.parameters import World
from kinefit.fitting.subject.subject import CameraExtrinsics
from kinefit.fitting.tracking.cameras import as_found, between, composed, sentences
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.observations import KeypointFrame, MarkerFrame
from kinefit.readers.take.load import load_observations
from kinefit.sensors.settings import CameraErrors
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

WRISTS_ANKLES = ("l_ulnar_styloid", "r_ulnar_styloid", "l_lateral_malleolus", "r_lateral_malleolus")


@pytest.fixture(scope="module")
def take(tmp_path_factory, copy_take):
    return copy_take(tmp_path_factory.mktemp("cameras"))


def stating(take, text):
    path = take.with_name("stated.toml")
    told = take.read_text("utf-8").replace("[calibration]", f"frames = [0, 12]\n[calibration]\n{text}", 1)
    path.write_text(told, "utf-8")
    return path


def test_markers_set_cameras_right_that_point_beside_their_calibration():
    motion = squat_and_wave(rate=15.0, duration=1.0)
    rig, body = studio_rig(motion), motion.body
    twist = np.array([0.004, -0.002, 0.003, 0.003, -0.0025, 0.002])
    off = CameraExtrinsics(rig, None).apply(World(body, rig), np.concatenate([twist, -twist, twist, -twist])).rig
    seen = simulate_keypoints(motion, rig, noise_px=0.5, drift_px=0.0, outliers=0.0, missing=0.0)
    points = body.markers("HANIM_45")
    steps = []
    for f, x in enumerate(motion.positions(points)):
        time = f / motion.rate
        pixels = [
            KeypointFrame(k.camera, time, k.names, k.points[f, 0], k.confidence[f, 0], k.keypoint_set) for k in seen
        ]
        steps.append([*pixels, MarkerFrame("mocap", time, points.names, x, marker_set="HANIM_45")])
    sigma = {**dict.fromkeys(rig.names, 2.0), "mocap": 0.002}
    told = {}
    for std in ((0.005, 0.003), None):
        settings = TrackSettings(camera_std=std)
        recording = Recording.of_frames(steps, off, rate=motion.rate, sigma=sigma)
        told[std] = track(recording, body, smooth=False, settings=settings).provenance
    assert "cameras" not in told[None]
    moved = as_found(off, told[0.005, 0.003])
    for a, b, c in zip(moved, off, rig):
        left, before = (np.linalg.norm(se3.log(x.T_camera_world @ np.linalg.inv(c.T_camera_world))[3:]) for x in (a, b))
        assert left < 0.5 * before
    assert as_found(off, {}).cameras == off.cameras


def test_an_exact_calibration_stays_and_leaves_smaller_bars(take):
    free, _ = track_take(stating(take, "position_sigma = 0.01\nrotation_sigma = 0.3"), smooth=False)
    path = stating(take, "position_sigma = 0\nrotation_sigma = 0")
    exact, seen = track_take(path, smooth=False)
    calibrated = load_observations(read_take(path)).rig
    assert all(np.array_equal(a.T_camera_world, b.T_camera_world) for a, b in zip(seen.rig, calibrated))
    root = [np.median(m.joint_std[:, 0]) for m in (exact, free)]
    assert root[0] < root[1]


def test_a_camera_that_is_farther_off_than_it_can_be_is_named():
    told = {"cameras": {"a": {"moved": [0.004, 0, 0, 0, 0.006, 0]}, "b": {"moved": [0.0, 0.004, 0, 0, 0.001, 0]}}}
    (sentence,) = sentences(told, CameraErrors(0.003, 0.00175))
    assert sentence.startswith("camera a was found 4 mm and 0.34 degrees from its calibration")
    assert not sentences(told, None) and not sentences({}, CameraErrors(0.003, 0.00175))


def test_a_camera_turned_about_any_axis_is_moved_back_and_named():
    motion = squat_and_wave(rate=10.0, duration=2.0)
    rig, turn = studio_rig(motion), se3.exp(np.radians([0.0, 0.0, 0.0, 2.0, 1.0, -2.0]))
    wrong = Rig(tuple(c.with_pose(turn @ c.T_camera_world) if c.name == "cam02" else c for c in rig))
    seen = simulate_keypoints(motion, rig, noise_px=1.0, drift_px=0.5, outliers=0.05, missing=0.05)
    told = {name: track(Recording.of_keypoints(r, seen), motion.body) for name, r in (("right", rig), ("wrong", wrong))}
    assert "cameras" not in told["right"].provenance
    (named,) = sentences(told["wrong"].provenance, TrackSettings().camera_errors)
    assert named.startswith("camera cam02 was found")
    found = as_found(wrong, told["wrong"].provenance)["cam02"].T_camera_world
    left = se3.log(found @ se3.inverse(rig["cam02"].T_camera_world))
    assert np.degrees(np.linalg.norm(left[3:])) < 1.0
    away = {n: np.linalg.norm(m.positions() - motion.positions(), axis=-1).mean() for n, m in told.items()}
    assert away["wrong"] < away["right"] + 0.005


@pytest.mark.parametrize(("name", "axis"), [("cam01", 0), ("cam02", 1), ("cam02", 2)])
def test_of_two_cameras_beside_four_markers_the_turned_one_is_moved_back_and_named(name, axis):
    motion = squat_and_wave(rate=15.0, duration=2.0)
    rig, points = studio_rig(motion).select(("cam01", "cam02")), motion.body.markers("HANIM_45")
    seen = simulate_keypoints(motion, rig, noise_px=2.0, drift_px=1.0, outliers=0.05, missing=0.05)
    steps = []
    for f, x in enumerate(motion.positions(points.select(WRISTS_ANKLES))):
        time = f / motion.rate
        steps.append([*(KeypointFrame.of_record(k, f, time) for k in seen),
                      MarkerFrame("mocap", time, WRISTS_ANKLES, x, marker_set="HANIM_45")])  # fmt: skip
    turn = se3.transform(se3.exp_so3(np.radians(3.0) * np.eye(3)[axis]), np.zeros(3))
    wrong = rig.with_camera(rig[name].with_pose(turn @ rig[name].T_camera_world))
    found = track(Recording.of_frames(steps, wrong, rate=motion.rate), motion.body)
    said = sentences(found.provenance, TrackSettings().camera_errors)
    assert [s.split()[1] for s in said] == [name]
    assert np.linalg.norm(found.positions() - motion.positions(), axis=-1).mean() < 0.015


def test_two_moves_of_a_camera_amount_to_one():
    twists = np.random.default_rng(1).normal(0.0, 0.1, (2, 6))
    motion = squat_and_wave(rate=10.0, duration=0.5)
    rig = studio_rig(motion)
    steps = [{"cam01": {"moved": twist.tolist()}} for twist in twists]
    once = as_found(as_found(rig, {"cameras": steps[0]}), {"cameras": steps[1]})
    direct = as_found(rig, {"cameras": composed(*steps)})
    assert np.allclose(direct["cam01"].T_camera_world, once["cam01"].T_camera_world)
    assert np.allclose(between(rig, once)["cam01"]["moved"], composed(*steps)["cam01"]["moved"])
    assert list(between(rig, once)) == ["cam01"]


@pytest.mark.parametrize(
    "text",
    [
        "position_sigma = 0.003", "rotation_sigma = 0.1", "position_sigma = -0.1\nrotation_sigma = 0.1",
        "position_sigma = 0\nrotation_sigma = 0.1", "position_sigma = 2.0\nrotation_sigma = 0.1",
        "position_sigma = nan\nrotation_sigma = 0.1",
    ],
)  # fmt: skip
def test_sigmas_that_cannot_be_are_told(take, text):
    with pytest.raises(TakeError, match=r"\[calibration\].*position_sigma"):
        read_take(stating(take, text))
