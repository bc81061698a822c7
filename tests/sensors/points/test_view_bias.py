"""Bias by direction of view: what it moves, its mirror image, and that fit and measurement are kept apart."""


import numpy as np

from kinefit.bodies import load_body
from kinefit.fitting.tracking.recording import Recording
from kinefit.fitting.tracking.video import track
from kinefit.geometry.losses import geman_mcclure
from kinefit.sensors.channels import make_channels
from kinefit.sensors.points.keypoints import KeypointMeasurement, KeypointSensor, Layout, projected
from kinefit.sensors.points.views import MIRRORED, TERMS, ViewBias, directions, trunks, view_offset
from kinefit.sensors.scene import Scene
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

BODY = load_body("humanoid")
MOTION = squat_and_wave(rate=20.0, duration=2.0)
RIG = studio_rig(MOTION)


def channels_of(noise_px=1.0):
    seen = simulate_keypoints(MOTION, RIG, noise_px=noise_px, seed=0)
    return make_channels(BODY, RIG, seen, [8.0] * 4)


def test_a_limbs_trunk_is_the_first_segment_of_neither_side():
    trunk = trunks(BODY.tree)
    assert BODY.tree.segments[trunk[BODY.tree.segment("hand_l")]] == "thorax"
    assert BODY.tree.segments[trunk[BODY.tree.segment("toes_r")]] == "pelvis"
    assert BODY.tree.segments[trunk[BODY.tree.segment("head")]] == "head"


def test_points_are_seen_beside_as_the_formula_says():
    random, camera = np.random.default_rng(0), np.arange(20) % len(RIG)
    x = MOTION.positions(BODY.landmarks)[3].mean(axis=0) + random.normal(0.0, 0.3, (20, 3))
    frames, _ = BODY.tree.forward(MOTION.Ts_world_root[3], MOTION.angles[3])
    trunk = random.integers(0, len(frames), 20)
    C = random.normal(0.0, 0.02, (20, TERMS, 3))
    for n, pixels in enumerate(view_offset(C, trunk, x, frames, RIG, camera)):
        eye, R = RIG.cameras[camera[n]], frames[trunk[n], :9].reshape(3, 3)
        d = R.T @ (eye.centre_world - x[n]) / np.linalg.norm(eye.centre_world - x[n])
        expected = eye.project(x[n] + R @ C[n].T @ directions(d)) - eye.project(x[n])
        np.testing.assert_allclose(pixels, expected, atol=1e-9)


def test_left_is_the_mirror_image_of_right():
    C = np.random.default_rng(1).normal(size=(TERMS, 3))
    M, d = np.diag([1.0, 1.0, -1.0]), np.array([0.48, 0.6, 0.64])
    np.testing.assert_allclose((C * MIRRORED).T @ directions(d), M @ C.T @ directions(M @ d), atol=1e-12)


def test_what_is_told_is_read_back_and_no_bias_changes_no_channels():
    bias = ViewBias({"BODY_25B": {"LHip": np.full((TERMS, 3), 0.01)}})
    again = ViewBias.from_record(bias.as_record())
    np.testing.assert_allclose(again.sets["BODY_25B"]["LHip"], 0.01)
    channels = channels_of()
    assert ViewBias().known_to(channels) is channels
    known = again.known_to(channels)
    names = [channels.points.names[c] for c in channels.column]
    assert [bool(c.any()) for c in known.view_bias] == [n == "LHip" for n in names]


def test_a_known_bias_is_taken_out_of_the_fit_and_not_of_what_was_measured():
    channels = channels_of()
    bias = ViewBias({"BODY_25B": {"RKnee": np.full((TERMS, 3), 0.03)}})
    layout = Layout(bias.known_to(channels), BODY)
    recording = Recording.of_keypoints(RIG, simulate_keypoints(MOTION, RIG, seed=0))
    motion = track(recording, BODY, smooth=False)
    scene = Scene(motion.body, motion.state(5), RIG)
    sensor = KeypointSensor(RIG, {}, 8.0, geman_mcclure(), 0.03)
    given = channels.uv[5], channels.confidence[5], 0.0
    plain = KeypointMeasurement(sensor, Layout(channels, BODY), *given).match(scene, 0.03)
    known = KeypointMeasurement(sensor, layout, *given).match(scene, 0.03)
    shift = layout.bias(scene)
    assert np.abs(shift).max() > 3.0
    np.testing.assert_allclose(known.uv, plain.uv - shift, atol=1e-9)
    for a, b in zip(known.leftovers(scene), plain.leftovers(scene)):
        np.testing.assert_allclose(a.measured, b.measured, atol=1e-9)
    assert np.nanmax(np.abs(projected(scene, layout) - projected(scene, Layout(channels, BODY)))) == 0.0
