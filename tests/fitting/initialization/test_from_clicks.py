"""A start from clicked joints: recovered poses and lengths, and clicks that do not meet."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.errors import TrackingError
from kinefit.fitting.initialization.from_points import clickable, clicked_points, clicked_start
from kinefit.geometry.camera import Rig
from kinefit.simulation import squat_and_wave, studio_rig

MOTION = squat_and_wave()
BODY = MOTION.body
RIG = Rig(studio_rig().cameras[:3])
NAMES = clickable(BODY)


def clicks(frame=20, noise=0.0, seed=0, names=NAMES):
    x = MOTION.positions(BODY.landmarks.select(names))[frame]
    uv = np.stack([camera.project(x) for camera in RIG], axis=1)
    return x, uv + noise * np.random.default_rng(seed).normal(size=uv.shape)


def test_what_can_be_clicked_are_joints_and_ends():
    assert {"l_hip", "r_knee", "l_wrist", "skull_vertex", "r_digit_2", "l_metacarpal_phalanx_5"} <= set(NAMES)
    assert "r_thigh_front" not in NAMES and {"r_shoulder", "r_elbow", "r_wrist"} <= set(clickable(load_body("arm")))


def test_pose_and_lengths_come_back():
    scales = np.linspace(0.9, 1.1, len(BODY.scale_groups))
    person = BODY.scaled(scales)
    x, uv = clicks(noise=2.0)
    assert np.linalg.norm(clicked_points(RIG, NAMES, uv)[0] - x, axis=1).max() < 0.03
    state = MOTION.state(20)
    x = person.positions(state, person.landmarks.select(NAMES))
    fitted, found, left = clicked_start(BODY, NAMES, x)
    assert left < 0.01
    for name, length in person.segment_lengths().items():
        if name in ("thigh_r-shank_r", "shank_l-foot_l", "upperarm_r-forearm_r", "forearm_l-hand_l"):
            assert fitted.segment_lengths()[name] == pytest.approx(length, rel=0.01)
    there = fitted.positions(found, fitted.landmarks.select(NAMES))
    assert np.linalg.norm(there - x, axis=1).max() < 0.03
    off = np.degrees(np.abs(found.angles - state.angles))
    for name in ("knee_angle_r", "elbow_flex_l", "knee_angle_l"):
        assert off[BODY.tree.coordinate(name)] < 5, name


def test_the_camera_that_is_off_is_named_with_how_much():
    _, uv = clicks(noise=1.0)
    uv[NAMES.index("r_knee"), 1] += (50.0, 110.0)
    with pytest.raises(TrackingError, match=rf"r_knee: camera {RIG.names[1]} is off by 1[12]\d px \(\d\d cm\)") as told:
        clicked_points(RIG, NAMES, uv)
    assert "l_knee" not in str(told.value) and "Click these again" in str(told.value)
    _, uv = clicks()
    uv[NAMES.index("r_knee"), 1] += (120.0, 0.0)  # all three stand alike high: any of them may be off
    with pytest.raises(TrackingError, match=r"r_knee: rays pass each other by \d+ cm \(cam01 \d+ px, cam02"):
        clicked_points(RIG, NAMES, uv)
    _, uv = clicks(noise=1.0)
    uv[:, 2] += (90.0, 60.0)
    with pytest.raises(TrackingError, match=rf"Camera cam03 is off in \d+ of {len(NAMES)} points, by 1\d\d px"):
        clicked_points(RIG, NAMES, uv)


def test_two_cameras_do_not_tell_which_of_them_is_off():
    _, uv = clicks()
    uv[:, 2] = np.nan
    uv[0, 0, 1] += 150.0
    with pytest.raises(TrackingError, match=rf"{NAMES[0]}: rays pass each other by \d+ cm \({RIG.names[0]} \d+ px"):
        clicked_points(RIG, NAMES, uv)
    with pytest.raises(TrackingError, match="0 points can be triangulated"):
        clicked_points(RIG, NAMES, np.full_like(uv, np.nan))


def test_names_that_the_body_does_not_have():
    with pytest.raises(TrackingError, match="no landmark of body 'humanoid' 'knie'"):
        clicked_start(BODY, ["knie", "r_hip", "l_hip"], np.zeros((3, 3)))


def test_short_bones_follow_the_others_as_far_as_their_clicks_are_unsure():
    person = BODY.scaled(np.full(len(BODY.scale_groups), 1.1))
    x = person.positions(MOTION.state(20), person.landmarks.select(NAMES))
    group, camera = BODY.scale_groups.index("foot"), RIG.cameras[0]
    off, alone = [], []
    for seed in range(8):
        uv = np.stack([c.project(x) for c in RIG], axis=1)
        uv += 3.0 * np.random.default_rng(seed).normal(size=uv.shape)
        points, covariance = clicked_points(RIG, NAMES, uv)
        along = (points - camera.centre_world) / np.linalg.norm(points - camera.centre_world, axis=1, keepdims=True)
        assert (np.einsum("ni,nij,nj->n", along, covariance, along) > np.trace(covariance, axis1=1, axis2=2) / 3).all()
        for told, values in (((covariance,), off), ((), alone)):
            values.append(_scale(clicked_start(BODY, NAMES, points, *told)[0], group) / 1.1 - 1.0)
    assert np.abs(off).max() < 0.06 < np.abs(alone).max()


def _scale(body, group):
    segment = BODY.tree.segment("toes_r")
    assert BODY.scale_groups[group] == "foot"
    return np.linalg.norm(body.tree.offsets[segment]) / np.linalg.norm(BODY.tree.offsets[segment])
