"""Cameras beside markers are found along with the person; beside keypoints alone their errors are in the bars."""

import numpy as np
import pytest

from kinefit import Recording, TrackSettings, read_take, track, track_take
from kinefit.errors import TakeError
from kinefit.geometry import se3
from kinefit.observations import KeypointFrame, MarkerFrame
from kinefit.readers.take.load import load_observations
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.subject.parameters import World
from kinefit.subject.sensor_parameters import CameraExtrinsics
from kinefit.tracking.cameras import as_found, sentences


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
    for f in range(len(motion)):
        frames, _ = body.tree.forward(motion.Ts_world_root[f], motion.angles[f])
        turn, place = frames[points.segments, :9].reshape(-1, 3, 3), frames[points.segments, 9:]
        x = place + np.einsum("nij,nj->ni", turn, points.points)
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
    (sentence,) = sentences(told, (0.003, 0.00175))
    assert sentence.startswith("camera a was found 4 mm and 0.34 degrees from its calibration")
    assert not sentences(told, None) and not sentences({}, (0.003, 0.00175))


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
