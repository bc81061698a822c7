"""One frame's fit: a limb far from where it is expected is found, or told to be lost; what is not seen is not known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinefit import load_body
from kinefit.bodies import BodyState
from kinefit.fitting.frame.fit import FrameFit
from kinefit.fitting.frame.results import dofs_moving, dofs_of_joints, observed, reset_to_prior, without_segments
from kinefit.observations import KeypointFrame
from kinefit.sensors.points.keypoints import KeypointSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import squat_and_wave, studio_rig
from kinefit.solving.rows import DofRows, PairRows, ParameterRows, Rows

BODY = load_body("humanoid")
TREE = BODY.tree
TRUTH = squat_and_wave(BODY, rate=30)
RIG = studio_rig(TRUTH)
SETTINGS = TrackSettings()
SIGMA = 3.0


def state_of(**turned):
    """Upright, some coordinates turned [rad]."""
    angles = np.array(TRUTH.angles[0])
    for name, angle in turned.items():
        angles[TREE.coordinate(name)] = angle
    return BodyState(TRUTH.Ts_world_root[0], angles)


def seen(state, move=None):
    """Keypoints of all cameras, with a little noise; `move` (camera, name) -> (2,) [px] shifts some."""
    points, random = BODY.keypoints("BODY_25B"), np.random.default_rng(0)
    x, frames = BODY.positions(state, points), []
    for camera in RIG:
        uv = camera.project(x) + random.normal(0.0, 1.0, (len(x), 2))
        if move is not None:
            uv = uv + np.array([move(camera.name, n) for n in points.names])
        frames.append(KeypointFrame(camera.name, 0.0, points.names, uv, np.ones(len(x)), "BODY_25B"))
    return frames


def fitted(frames, predicted, sigma, known=None, body=BODY, pixels=SIGMA):
    """A fit that begins where a body was predicted, with one standard deviation [m, rad] of all of it; inf for none."""
    sensor = KeypointSensor(RIG, {}, pixels, SETTINGS.loss, SETTINGS.near)
    scene = Scene(body, predicted, RIG)
    held = (predicted, np.eye(TREE.n_dofs) / sigma**2) if np.isfinite(sigma) else None
    return FrameFit(body, SETTINGS).run(scene, held, [sensor.prepare(frames, scene)], known)


@pytest.mark.parametrize("sigma", [0.15, 0.3, 0.6])
@pytest.mark.parametrize("predicted", [(0.3, 0.1), (-0.3, 0.1), (0.3, 1.8)])
def test_a_leg_that_swung_unseen_is_found(predicted, sigma):
    """Hip and knee were predicted elsewhere, up to half a metre; the loss at its final width leaves the leg there."""
    truth = state_of(hip_flexion_r=-0.3, knee_angle_r=1.2)
    result = fitted(seen(truth), state_of(hip_flexion_r=predicted[0], knee_angle_r=predicted[1]), sigma).result
    a, b = (TREE.segment_poses(s.T_world_root[None], s.angles[None])[0, :, :3, 3] for s in (truth, result.state))
    assert np.linalg.norm(a - b, axis=1).max() < 0.02
    assert not result.lost.any() and result.joint_std[TREE.segment("shank_r")].max() < 0.02


def test_an_elbow_that_cameras_agree_on_elsewhere_is_lost():
    """The hand and the shoulder agree, the elbow does not: no bend of the arm brings it there."""
    truth, there = state_of(), BODY.keypoints("BODY_25B")
    elbow = BODY.positions(truth, there.select(("RElbow",)))[0]
    moved = {c.name: (c.project(elbow + [0.0, 0.0, 0.25]) - c.project(elbow)).ravel() for c in RIG}
    forearm = TREE.segment("forearm_r")

    def together(camera, name):
        return moved[camera] if name == "RElbow" else np.zeros(2)

    def apart(camera, name):  # each camera to another side: no place in space
        side = np.array([1.0, 1.0]) * (1 if camera in RIG.names[:2] else -1) * (1 + RIG.names.index(camera))
        return 150.0 * side if name == "RElbow" else np.zeros(2)

    result = fitted(seen(truth, move=together), truth, 0.05).result
    assert result.lost[forearm] and result.segment_quality[forearm] > 0.4
    assert np.isinf(result.joint_std[forearm]).all()
    assert np.isinf(result.dof_std[6 + TREE.coordinate("elbow_flex_r")])
    assert np.isfinite(result.joint_std[TREE.segment("shank_r")]).all()
    noise = fitted(seen(truth, move=apart), truth, 0.05).result
    assert np.isfinite(noise.joint_std[forearm]).all()


def test_what_keypoints_leave_open_of_a_bend_is_shared_as_people_share_it():
    """The pelvis may tilt about the hips' points unseen: the spine takes its usual share of the bend."""
    hips = [TREE.coordinate(f"hip_flexion_{side}") for side in "rl"]
    spine = [TREE.coordinate(f"{name}_extension") for name in ("lumbar", "thorax")]
    truth = state_of(hip_flexion_r=1.2, hip_flexion_l=1.2, lumbar_extension=-0.45, thorax_extension=-0.1)
    independent = replace(BODY, tree=replace(TREE, couplings=np.empty((0, 0))))
    results = {}
    for name, body in (("coupled", BODY), ("independent", independent)):
        fit = fitted(seen(truth), truth, np.inf, body=body, pixels=20.0)
        std = np.degrees(fit.result.dof_std[6:])
        results[name] = std[hips].max(), np.degrees(np.abs(fit.result.state.angles - truth.angles)[hips + spine]).max()
    assert results["coupled"][0] < 9.0 < 12.0 < results["independent"][0]
    assert results["coupled"][1] < 6.0


def test_what_contradicts_a_segment_makes_it_no_more_certain():
    """Every camera puts the leg somewhere else: the prediction's deviation is what is left."""
    off = dict(zip(RIG.names, ([300.0, 0.0], [0.0, -300.0], [-280.0, 150.0], [150.0, 290.0])))
    leg = ("RKnee", "RAnkle", "RHeel", "RBigToe", "RSmallToe")
    truth = state_of()
    frames = seen(truth, move=lambda camera, name: np.array(off[camera] if name in leg else (0.0, 0.0)))
    fit = fitted(frames, truth, 0.1)
    knee = 6 + TREE.coordinate("knee_angle_r")
    assert fit.result.lost[TREE.segment("shank_r")]
    assert np.sqrt(fit.filtered[knee, knee]) == pytest.approx(0.1, rel=0.05)
    assert np.isinf(fit.result.dof_std[knee]) and not fit.known[knee - 6]
    assert np.sqrt(np.diag(fit.filtered)[6 + TREE.coordinate("knee_angle_l")]) < 0.05


def test_a_joint_that_hardly_moves_a_point_is_not_seen_by_it():
    fit = fitted(seen(state_of()), state_of(), 0.05)  # BODY_25B has nothing beyond the wrist
    unseen = [TREE.coordinate(c) for c in ("pro_sup_r", "wrist_flex_r", "wrist_dev_l")]
    assert not fit.seen[unseen].any() and fit.seen[TREE.coordinate("elbow_flex_r")]
    assert np.isinf(fit.result.dof_std[6:][unseen]).all()
    known = fitted(seen(state_of()), state_of(), 0.05, np.ones(len(TREE.coordinates), bool))
    assert np.isfinite(known.result.dof_std).all() and not known.seen[unseen].any()


def test_information_observes_what_it_makes_narrower_than_the_prior():
    spread = np.concatenate([np.full(6, 1.0), TREE.spread])
    information = np.diag(1.0 / np.square(spread))
    information[6:, 6:] += TREE.couplings.T @ TREE.couplings
    knee = 6 + TREE.coordinate("knee_angle_r")
    information[knee, knee] *= 1.2
    assert np.flatnonzero(observed(TREE, information)).tolist() == [knee]


def test_degrees_of_freedom_of_a_lost_segment():
    lost = np.zeros(len(TREE.segments), bool)
    lost[TREE.segment("shank_r")] = True
    names = np.array(["root"] * 6 + list(TREE.coordinates))
    leg = {"hip_flexion_r", "hip_adduction_r", "hip_rotation_r", "knee_angle_r"}
    assert set(names[dofs_moving(TREE, lost)]) == leg | {"root"}
    assert set(names[dofs_of_joints(TREE, lost)]) == leg
    gone = dofs_of_joints(TREE, lost)
    covariance = reset_to_prior(TREE, np.full((TREE.n_dofs,) * 2, 0.01), gone)
    assert not covariance[np.ix_(gone, ~gone)].any() and (covariance[np.ix_(~gone, ~gone)] == 0.01).all()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)[gone]), TREE.posture_std[gone[6:]])


def test_rows_of_segments_that_are_left_out_weigh_nothing():
    lost, one = np.array([False, True]), np.ones(2)
    segment, x = np.array([0, 1]), np.eye(3)[:2]
    rows = Rows.of(segment, x, x, one, one)
    assert without_segments(rows, lost).weight.tolist() == [1.0, 0.0] and rows.weight.tolist() == [1.0, 1.0]
    pairs = PairRows(np.array([[0, 1], [0, 0]]), x, x, x, one, one)
    assert without_segments(pairs, lost).weight.tolist() == [0.0, 1.0]
    dense = DofRows(np.ones((2, 8)), one, one, segment, segment=segment)
    assert without_segments(dense, lost).weight.tolist() == [1.0, 0.0]
    assert without_segments(DofRows(np.ones((2, 8)), one, one, segment), lost).weight.tolist() == [1.0, 1.0]
    parameters = ParameterRows(segment, one, one)
    assert without_segments(parameters, lost) is parameters
