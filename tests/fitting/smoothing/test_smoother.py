"""Whole takes: angles without jumps, estimated strength, windows, gaps, contacts."""

from __future__ import annotations

import json
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit import Motion, Recording, load_body, track
from kinefit.bodies import PointSet
from kinefit.bodies.tree import twin
from kinefit.fitting.smoothing.foot_contacts import find_contacts, soles
from kinefit.fitting.smoothing.smoother import smooth_results
from kinefit.fitting.smoothing.unwrap import boxes, unwrap
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking.run import run
from kinefit.geometry import se3
from kinefit.sensors.evidence import levers, moves_points, near
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.simulation.evaluation import angle_errors, joint_errors

BODY = load_body("humanoid")
TREE = BODY.tree
ARM = slice(TREE.coordinate("arm_flex_r"), TREE.coordinate("arm_rot_r") + 1)
DEFAULT = TrackSettings()


def turns_of(angles):
    """(F, S, 3, 3) orientations of all segments for angles (F, D)."""
    return TREE.segment_poses(np.tile(np.eye(4), (len(angles), 1, 1)), angles)[..., :3, :3]


def overhead(frames=200):
    """An arm that is lifted sideways overhead and beyond, twice, its angles given within limits in either chart."""
    angles = np.tile(TREE.usual, (frames, 1))
    lift = -np.radians(90 - 85 * np.cos(np.linspace(0, 4 * np.pi, frames)))
    angles[:, ARM] = np.stack([0.3 + 0.1 * lift, lift, 0.2 - 0.2 * lift], axis=1)
    return angles


def test_overhead_reaching_has_no_jumps_whatever_charts_it_is_given_in():
    smooth_angles = overhead()
    given_angles = smooth_angles.copy()
    other = np.random.default_rng(0).random(len(smooth_angles)) < 0.4
    given_angles[other, ARM] = twin(smooth_angles[other, ARM])
    assert np.abs(np.diff(given_angles[:, ARM], axis=0)).max() > 2.0
    out = unwrap(TREE, given_angles)
    np.testing.assert_allclose(turns_of(out), turns_of(smooth_angles), atol=1e-12)
    assert np.abs(np.diff(out, axis=0)).max() < 1.05 * np.abs(np.diff(smooth_angles, axis=0)).max()
    assert np.all((out > TREE.lower - 1e-9) & (out < TREE.upper + 1e-9))


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_unwrapping_changes_no_pose_and_depends_on_no_chart(seed, mirrored):
    random = np.random.default_rng(seed)
    walk = np.cumsum(0.05 * random.normal(size=(40, len(TREE.coordinates))), axis=0)
    angles = np.clip(TREE.usual + walk, TREE.lower, TREE.upper)
    out = unwrap(TREE, angles)
    np.testing.assert_allclose(turns_of(out), turns_of(angles), atol=1e-12)
    assert np.abs(np.diff(out, axis=0)).max() <= np.abs(np.diff(angles, axis=0)).max() + 1e-9
    again = angles.copy()
    frames = random.random(40) < 0.5
    for d in TREE.ball_joints:
        again[frames, d] = twin(angles[frames, d]) + 2 * np.pi * mirrored
    np.testing.assert_allclose(unwrap(TREE, again), out, atol=1e-9)


def test_joints_without_limits_count_whole_turns():
    free = replace(TREE, lower=np.full(41, -np.inf), upper=np.full(41, np.inf))
    knee = TREE.coordinate("knee_angle_r")
    angles = np.tile(TREE.usual, (100, 1))
    angles[:, knee] = np.angle(np.exp(1j * np.linspace(0, 20, 100)))
    np.testing.assert_allclose(unwrap(free, angles)[:, knee], np.linspace(0, 20, 100), atol=1e-9)


def test_limits_follow_an_angle_into_its_other_chart():
    angles = np.tile(TREE.usual, (2, 1))
    angles[:, ARM] = [0.3, -1.0, 0.2]
    angles[1, ARM] = twin(angles[0, ARM])
    lower, upper, usual = boxes(TREE, angles)
    np.testing.assert_allclose([lower[0], upper[0]], [TREE.lower, TREE.upper])
    np.testing.assert_allclose(usual[0], TREE.usual)
    assert np.all((angles[1] > lower[1]) & (angles[1] < upper[1]))
    inside = [np.minimum(angles - lower, upper - angles)[f, ARM] for f in (0, 1)]
    np.testing.assert_allclose(inside[0], inside[1], atol=1e-12)  # as far from the limits as before
    np.testing.assert_allclose(turns_of(usual)[1], turns_of(usual)[0], atol=1e-12)


def test_a_joint_is_told_of_only_by_points_away_from_its_axis():
    k = BODY.keypoints("BODY_25B")
    angles = np.tile(TREE.usual, (2, 1))
    roots = np.tile(np.eye(4), (2, 1, 1))
    seen = np.ones((2, len(k)), bool)
    seen[1, k.index("RWrist")] = False
    found = levers(BODY, k, seen, roots, angles)
    assert found[0, TREE.coordinate("pro_sup_r")] < 1e-9  # no point on the hand
    np.testing.assert_allclose(found[:, TREE.coordinate("elbow_flex_r")], [0.255, 0.0], atol=1e-9)
    told = np.zeros((9, 1), bool)
    told[4] = True
    np.testing.assert_array_equal(near(told, 2)[:, 0], [0, 0, 1, 1, 1, 1, 1, 0, 0])


def test_a_short_segment_needs_a_short_lever():
    """A finger's tip, 18 mm from its joint, tells that joint's angle; the same lever on a forearm tells nothing."""
    body = load_body("humanoid_hands")
    k, angles = body.keypoints("MEDIAPIPE_75"), body.tree.usual[None]
    seen = np.ones((1, len(k)), bool)
    told = moves_points(body, k, seen, np.eye(4)[None], angles)[0]
    dip = body.tree.coordinate("index_dip_flex_r")
    assert 0.01 < levers(body, k, seen, np.eye(4)[None], angles)[0, dip] < 0.02 and told[dip]
    seen[0, k.index("right_index_tip")] = False
    assert not moves_points(body, k, seen, np.eye(4)[None], angles)[0, dip]
    points = PointSet(("near",), [TREE.segment("forearm_r")], [[0.015, 0.0, 0.0]])
    one = np.ones((1, 1), bool)
    near_joint = moves_points(BODY, points, one, np.eye(4)[None], TREE.usual[None])[0]
    assert not near_joint[TREE.coordinate("elbow_flex_r")]


@pytest.fixture(scope="module")
def squats():
    """Two seconds of squatting and waving while turning round twice, seen by four cameras with noise."""
    truth = squat_and_wave(BODY, rate=30)
    roots = np.array(truth.Ts_world_root)
    for f in range(len(roots)):
        turn = se3.exp_so3(np.array([0.0, 0.0, 4 * np.pi * f / len(roots)]))
        roots[f, :3, :3] = turn @ roots[f, :3, :3]
        roots[f, :3, 3] = turn @ roots[f, :3, 3]
    truth = replace(truth, Ts_world_root=roots)
    rig = studio_rig(truth)
    return truth, rig, simulate_keypoints(truth, rig, "BODY_25B", noise_px=4.0, seed=1)


def followed(truth, rig, keypoints, sigma=8.0):
    """The frames of keypoints as tracked."""
    return run(Recording.of_keypoints(rig, keypoints, sigma=sigma), truth.body, DEFAULT)


def smoothed_of(truth, tracked, settings=DEFAULT, count=None, **options):
    """Smoothed frames, and what is told of them."""
    tracker = copy(tracked.tracker)
    tracker.settings = settings
    frames = replace(tracked, results=tracked.results[:count], tracker=tracker)
    done = smooth_results(frames, **options)
    return done.results, done.provenance


@pytest.fixture(scope="module")
def tracked(squats):
    """The frames of it as tracked."""
    return followed(*squats)


def as_motion(truth, results) -> Motion:
    return replace(
        truth,
        Ts_world_root=np.stack([r.state.T_world_root for r in results]),
        angles=np.stack([r.state.angles for r in results]),
        dof_std=np.stack([r.dof_std for r in results]),
        joint_std=np.stack([r.joint_std for r in results]),
    )


def test_smoothing_is_nearer_to_the_truth_and_tells_what_it_found(squats, tracked):
    truth, _, _ = squats
    smoothed, told = smoothed_of(truth, tracked)
    before, after = as_motion(truth, tracked.results), as_motion(truth, smoothed)
    assert joint_errors(truth, after).mean() < 0.75 * joint_errors(truth, before).mean()
    seen = np.isfinite(after.dof_std[:, 6:])
    assert np.abs(angle_errors(truth, after))[seen].mean() < 0.75 * np.abs(angle_errors(truth, before))[seen].mean()
    limbs_seen = [TREE.segment(s) for s in ("shank_r", "foot_l", "forearm_r", "hand_l")]
    known = np.isfinite(after.joint_std[:, limbs_seen])  # in the deepest squat the turn of the spine is hardly seen
    assert np.mean(known) > 0.995
    assert np.all((after.joint_std < before.joint_std)[:, limbs_seen][known])
    assert np.isinf(after.dof_std[:, 6 + TREE.coordinate("pro_sup_r")]).all()  # no point on the hand
    json.dumps(told, allow_nan=False)
    sigma = [s for source in told["pixel_sigma"].values() for s in source.values()]
    assert 3.0 < np.median(sigma) < 4.0  # a sure point of 4 px noise has confidence 0.8: 3.6 px at full confidence


def test_livelier_motion_is_given_more_acceleration(squats, tracked):
    truth, rig, _ = squats
    _, told = smoothed_of(truth, tracked)
    assert told["acceleration"]["knee_angle_r"] == told["acceleration"]["knee_angle_l"]
    roots, angles = np.tile(truth.Ts_world_root[0], (60, 1, 1)), np.tile(truth.angles[0], (60, 1))
    still = replace(truth, Ts_world_root=roots, angles=angles)
    subject = Subject(truth.body, np.ones(len(BODY.scale_groups)))
    seen = simulate_keypoints(still, rig, "BODY_25B", noise_px=4.0, seed=1)
    calm = track(Recording.of_keypoints(rig, seen), BODY, subject=subject)
    found = calm.provenance["smoothing"]["acceleration"]
    assert found["knee_angle_r"] < 0.8 * told["acceleration"]["knee_angle_r"]


def test_windows_agree_with_all_at_once(squats, tracked):
    truth, _, _ = squats
    settings = TrackSettings(smooth_rounds=0)
    whole, _ = smoothed_of(truth, tracked, settings)
    cut, _ = smoothed_of(truth, tracked, settings, windows=(40, 20))
    moved = joint_errors(as_motion(truth, whole), as_motion(truth, cut))
    assert 0 < moved.max() < 5e-4
    for a, b in zip(whole, cut, strict=True):
        known = np.isfinite(a.joint_std) & np.isfinite(b.joint_std)
        np.testing.assert_allclose(a.joint_std[known], b.joint_std[known], rtol=0.02)


def test_person_hidden_for_a_while_is_bridged(squats):
    truth, rig, keypoints = squats
    gap = (np.arange(len(truth)) >= 25) & (np.arange(len(truth)) < 40)
    hidden = [replace(k, points=np.where(gap[:, None, None, None], np.nan, k.points)) for k in keypoints]
    smoothed, _ = smoothed_of(truth, followed(truth, rig, hidden))
    after = as_motion(truth, smoothed)
    std = after.joint_std[:, TREE.segment("shank_r")].max(axis=1)
    assert std[24] < std[27] < std[32] and std[32] > std[37] > std[40]
    error = joint_errors(truth, after)[:, TREE.segment("shank_r")]
    assert error[32] < 3 * std[32]
    assert smoothed[32].quality == 0.0
    steps = np.linalg.norm(np.diff(after.Ts_world_root[:, :3, 3], axis=0), axis=1)
    assert steps[24:40].max() < 3 * np.linalg.norm(np.diff(truth.Ts_world_root[:, :3, 3], axis=0), axis=1).max() + 0.01


def test_exchanged_sides_stay_put_right(squats):
    truth, rig, _ = squats
    keypoints = simulate_keypoints(truth, rig, "BODY_25B", noise_px=3.0, outliers=0.0, swaps=0.15, seed=2)
    smoothed, _ = smoothed_of(truth, followed(truth, rig, keypoints, 5.0))
    swaps = np.stack([m.swapped for r in smoothed for m in r.matched])
    assert 0.1 < swaps.mean() < 0.2
    assert joint_errors(truth, as_motion(truth, smoothed)).mean() < 0.02
    assert min(r.support for r in smoothed) > 0.6


def test_track_smooths_unless_it_is_told_not_to(squats):
    truth, rig, keypoints = squats
    subject = Subject(truth.body, np.ones(len(BODY.scale_groups)))
    causal = track(Recording.of_keypoints(rig, keypoints), BODY, subject=subject, smooth=False)
    assert "smoothing" not in causal.provenance
    shorter = [replace(k, points=k.points[:40], confidence=k.confidence[:40]) for k in keypoints]
    again = track(Recording.of_keypoints(rig, shorter), BODY, subject=subject, smooth=False)
    np.testing.assert_array_equal(again.angles, causal.angles[:40])  # knows of no later frame
    smooth = track(Recording.of_keypoints(rig, keypoints), BODY, subject=subject)
    assert smooth.provenance["smoothing"]["rounds"] > 0
    assert joint_errors(truth, smooth).mean() < joint_errors(truth, causal).mean()


def test_soles_that_rest_are_held_still():
    truth = squat_and_wave(BODY, rate=30)
    points = soles(BODY)
    assert {n[2:] for n in points.names} >= {"heel", "digit_2"} and {n[0] for n in points.names} == {"l", "r"}
    roots = np.tile(truth.Ts_world_root[0], (60, 1, 1))
    angles = np.tile(truth.angles[0], (60, 1))
    angles[:, ARM] = truth.angles[:60, ARM]  # stands and waves
    jump = roots.copy()
    jump[30:50, 2, 3] += 0.5
    found = find_contacts(BODY, jump, angles, 30.0, truth.up)
    on = found.weight > 0
    assert on[:28].all() and on[52:].all() and not on[31:49].any()
    still = replace(truth, Ts_world_root=roots, angles=angles)
    rig = studio_rig(still)
    keypoints = simulate_keypoints(still, rig, "BODY_25B", noise_px=6.0, seed=3)
    subject = Subject(BODY, np.ones(len(BODY.scale_groups)))
    recording = Recording.of_keypoints(rig, keypoints, up=truth.up)
    x = [track(recording, BODY, subject=subject, contacts=c).positions(points) for c in (False, True)]
    slip = [float(np.linalg.norm(np.diff(v, axis=0), axis=2).mean()) for v in x]
    off = [float(np.linalg.norm(v - still.positions(points), axis=2).mean()) for v in x]
    assert slip[1] < 0.5 * slip[0]
    assert off[1] < 1.1 * off[0]


def test_one_and_two_frames_are_smoothed_too(squats, tracked):
    truth, _, _ = squats
    for count in (1, 2, 3):
        smoothed, told = smoothed_of(truth, tracked, count=count)
        assert len(smoothed) == count
        states = (np.stack([getattr(r.state, n) for r in smoothed]) for n in ("T_world_root", "angles"))
        places = TREE.segment_poses(*states)
        off = np.linalg.norm((places - truth.segment_poses()[:count])[..., :3, 3], axis=-1)
        assert off.mean() < 0.05
        json.dumps(told, allow_nan=False)
