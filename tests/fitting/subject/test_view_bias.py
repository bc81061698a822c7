"""A bias by direction of view that a simulated detector has is found in the take; none is, where it has none."""

from dataclasses import replace

import numpy as np

from kinefit.bodies import load_body
from kinefit.fitting.subject.keypoints import SeenFrames, fit_subject, learn_view_bias
from kinefit.sensors.channels import make_channels
from kinefit.sensors.points.keypoints import Layout
from kinefit.sensors.points.views import MIRRORED, TERMS, ViewBias
from kinefit.sensors.scene import Scene
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

BODY = load_body("humanoid")
MOTION = squat_and_wave(rate=20.0, duration=3.0)
RIG = studio_rig(MOTION)
HIP = np.zeros((TERMS, 3))
HIP[0, 2], HIP[2, 0] = 0.03, -0.03  # nearer to the middle from the front, forward from the left
TRUE = ViewBias({"BODY_25B": {"RHip": HIP, "LHip": HIP * MIRRORED}})


def frames_of(bias: ViewBias, cameras: int = 4, noise_px: float = 1.0) -> SeenFrames:
    rig = RIG.select(RIG.names[:cameras])
    seen = simulate_keypoints(MOTION, rig, noise_px=noise_px, seed=0)
    channels = make_channels(BODY, rig, seen, [8.0] * cameras)
    states = [MOTION.state(f) for f in range(len(MOTION))]
    uv = np.array(channels.uv)
    if bias.sets:
        layout = Layout(bias.known_to(channels), BODY)
        uv += np.stack([layout.bias(Scene(BODY, state, rig)) for state in states])
    return SeenFrames(MOTION.body, channels, states, uv, channels.confidence)


def seen_beside(bias: ViewBias, take: SeenFrames) -> np.ndarray:
    layout = Layout(bias.known_to(take.channels), BODY)
    return np.stack([layout.bias(Scene(BODY, state, take.channels.rig)) for state in take.states])


def test_what_cameras_disagree_in_is_found():
    take = frames_of(TRUE)
    found = learn_view_bias([take])
    names = np.array([take.channels.points.names[c] for c in take.channels.column])
    hips, truth, told = np.isin(names, ("LHip", "RHip")), seen_beside(TRUE, take), seen_beside(found, take)
    # What all cameras see alike is where the point is, and no bias: compare what they differ in.
    truth, told = (v[:, hips] - v[:, hips].mean(axis=(0, 1)) for v in (truth, told))
    assert np.linalg.norm(told - truth) < 0.75 * np.linalg.norm(truth)
    others = np.abs(np.concatenate([c.ravel() for n, c in found.sets["BODY_25B"].items() if "Hip" not in n]))
    assert others.max() < 0.003 < np.abs(found.sets["BODY_25B"]["RHip"]).max()


def test_sides_are_mirror_images_and_shares_are_told():
    found = learn_view_bias([frames_of(TRUE)])
    points = found.sets["BODY_25B"]
    np.testing.assert_allclose(points["LHip"], points["RHip"] * MIRRORED)
    assert np.abs(points["Nose"][MIRRORED < 0]).max() < 1e-9
    assert all(0.0 < share < 0.5 for share in found.followed["BODY_25B"].values())


def test_two_cameras_tell_of_no_bias():
    assert learn_view_bias([frames_of(TRUE, cameras=2)]).sets == {}


def test_a_camera_without_keypoints_changes_nothing():
    three = frames_of(TRUE, cameras=3)
    with_fourth = replace(three, channels=replace(three.channels, rig=RIG))
    a, b = (learn_view_bias([take]).sets["BODY_25B"] for take in (three, with_fourth))
    assert a.keys() == b.keys() and all(np.allclose(a[n], b[n], rtol=0.0, atol=1e-9) for n in a)


def test_a_fit_of_the_person_finds_it_and_may_leave_it():
    take = frames_of(TRUE)
    channels = replace(take.channels, uv=take.uv)
    assert fit_subject(BODY, channels).view_bias.sets == {}
    found = fit_subject(BODY, channels, view_bias=True).view_bias.sets["BODY_25B"]
    assert np.abs(found["RHip"]).max() > 3 * np.abs(found["RKnee"]).max()
