"""Cameras beside a depth camera: the one that does not stand where it is stated is moved, or left out, and named."""

import numpy as np
import pytest

from kinefit import Recording, TrackSettings, load_body, track
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.tracking.cameras import CAMERAS, LEFT_OUT, placed_cameras, sentences
from kinefit.fitting.tracking.sizing import channels_of
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.observations import KeypointFrame
from kinefit.sensors.settings import CameraErrors
from kinefit.simulation import DepthSensor, in_front, simulate_depth, simulate_keypoints, squat_and_wave, studio_rig

SENSOR = DepthSensor("depth", (128, 96), 110.0, 0.5, 5.5, (0.004, 0.0008, 0.0), holes=0.01)
PRIOR = CameraErrors(0.003, 0.001745)


@pytest.fixture(scope="module")
def scene():
    """True rig, motion, and what two cameras and the depth camera saw at each step."""
    motion = squat_and_wave(rate=8.0, duration=1.5, up="y")
    front = in_front(motion, SENSOR.camera(), azimuth=0.4, near=SENSOR.near, far=SENSOR.far)
    cameras = studio_rig(motion, cameras=2)
    seen = simulate_keypoints(motion, cameras, noise_px=1.0, drift_px=0.0, outliers=0.0, missing=0.0)
    depth = simulate_depth(motion, front, SENSOR, room=False, seed=1)
    steps = []
    for f, time in enumerate(motion.times):
        pixels = [KeypointFrame.of_record(k, f, float(time)) for k in seen]
        steps.append([*pixels, depth.frame(f)])
    return Rig((*cameras, front)), motion, steps


def recording(scene, turn, name="depth"):
    """What was seen, with a camera stated as turned about its own axes by a vector (3,) [deg]."""
    rig, motion, steps = scene
    T = se3.transform(se3.exp_so3(np.radians(turn)), np.zeros(3))
    stated = rig.with_camera(rig[name].with_pose(T @ rig[name].T_camera_world))
    return Recording.of_frames(steps, stated, rate=motion.rate, up="y", on_body=("depth",))


@pytest.mark.parametrize(
    ("turn", "fits", "usable"),
    [((0.2, -0.1, 0.3), True, True), ((2.0, -2.5, 1.0), False, True), ((0.0, 0.0, 180.0), False, False)],
)
def test_a_turned_depth_camera_is_told_from_one_that_fits_and_one_upside_down(scene, turn, fits, usable):
    given, body, settings = recording(scene, turn), load_body("humanoid"), TrackSettings()
    subject = fit_subject(body, channels_of(given, body, settings), cameras=PRIOR)
    placed = placed_cameras(given, subject, settings)["depth"]
    assert (placed.is_near, placed.usable) == (fits, usable)
    if usable:
        true, stated = scene[0]["depth"], given.rig["depth"]
        x = scene[1].positions()[0]
        known = se3.apply(se3.inverse(stated.T_camera_world) @ true.T_camera_world, x)
        left, before = (np.linalg.norm(a - known, axis=1).mean() for a in (se3.apply(se3.inverse(placed.T), x), x))
        assert fits or left < 0.3 * before


def test_a_turned_depth_camera_is_moved_and_named(scene):
    motion = track(recording(scene, (2.0, -2.5, 1.0)), load_body("humanoid"), smooth=False)
    assert "depth" in motion.provenance[CAMERAS]
    assert any(s.startswith("camera depth was found") for s in sentences(motion.provenance, PRIOR))
    away = np.linalg.norm(motion.positions() - scene[1].positions(), axis=-1)
    assert away.mean() < 0.025


def test_a_depth_camera_upside_down_is_left_out_and_named(scene):
    motion = track(recording(scene, (0.0, 0.0, 180.0)), load_body("humanoid"), smooth=False)
    assert list(motion.provenance[LEFT_OUT]) == ["depth"]
    (sentence,) = [s for s in sentences(motion.provenance, PRIOR) if "excluded" in s]
    assert "depth camera depth was excluded" in sentence and "rotation by 1" in sentence
    assert "depth" not in motion.residuals


@pytest.mark.parametrize(("name", "turn"), [("cam02", (3.0, 0.0, 0.0)), ("cam01", (0.0, -3.0, 0.0)),
                                            ("cam02", (0.0, 3.0, 0.0)), ("cam01", (0.0, 0.0, 3.0))])  # fmt: skip
def test_a_turned_video_camera_is_moved_and_named_and_no_other(scene, name, turn):
    motion = track(recording(scene, turn, name), load_body("humanoid"), smooth=False)
    (sentence,) = sentences(motion.provenance, PRIOR)
    assert sentence.startswith(f"camera {name} was found") and LEFT_OUT not in motion.provenance
    away = np.linalg.norm(motion.positions() - scene[1].positions(), axis=-1)
    assert away.mean() < 0.025
