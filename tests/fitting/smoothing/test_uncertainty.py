"""Lasting errors go through to the pose as the closed form says: against fits with such errors."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import PointSet, load_body
from kinefit.fitting.smoothing.sensor_noise import Pushes
from kinefit.fitting.smoothing.shared_errors import SharedErrors
from kinefit.fitting.smoothing.uncertainty import Averaged, KeypointPriors, systematic_errors
from kinefit.fitting.subject.keypoints import fit_subject
from kinefit.fitting.subject.parameters import World
from kinefit.fitting.subject.subject import CameraExtrinsics
from kinefit.geometry.camera import Rig
from kinefit.sensors.channels import make_channels
from kinefit.sensors.points.keypoints import Layout
from kinefit.sensors.settings import CameraErrors
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.solving.correspondences import pixel_rows, prior_rows
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.trajectory.variance_components import VarianceComponents

MOTION = squat_and_wave(rate=20.0, duration=3.0)
RIG = studio_rig(MOTION)
SIGMA = 3.0


@pytest.fixture(scope="module")
def scene():
    seen = simulate_keypoints(MOTION, RIG, noise_px=1.0, outliers=0.0, missing=0.0)
    body = load_body("humanoid")
    channels = make_channels(body, RIG, seen, [SIGMA] * 4)
    subject = fit_subject(body, channels)
    channels = channels.with_points(subject.body)
    weight = channels.weight[20]
    return subject, channels, weight, fit(subject.body, channels, channels.uv[20], weight, MOTION.state(20))


def fit(body, channels, uv, weight, start):
    points = channels.with_points(body).points
    each = PointSet(channels.column.astype(str), points.segments[channels.column], points.points[channels.column])
    uv = np.where(weight[:, None] > 0, uv, np.nan)
    sigma = 1.0 / np.sqrt(np.where(weight > 0, weight, 1.0))

    def rows(state):
        return [pixel_rows(body, state, each, channels.rig, channels.camera, uv, sigma=sigma), prior_rows(body, state)]

    return levenberg_marquardt(body, start, rows, tolerance=1e-12, max_iterations=60).state


def covariance(scene, noise, Sigma=None, cameras=None):
    subject, channels, weight, state = scene
    known, layout = KeypointPriors.of(subject, channels, cameras), Layout(channels, subject.body)
    known = replace(known, covariance=np.zeros_like(known.covariance) if Sigma is None else Sigma)
    n = subject.body.tree.n_dofs
    return systematic_errors(known, layout, state, weight, noise, SharedErrors.none(len(weight)), no_others(n))


def no_others(n):
    return Pushes(np.zeros((n, n)), *np.zeros((2, 0, n)), *np.zeros((2, n, n)))


def noise_of(channels, drift=0.0, shift=None):
    count = len(channels.column)
    shift = np.zeros((4, 2)) if shift is None else shift
    none = np.zeros(count)
    return VarianceComponents(none, np.full(count, drift), none, shift, 0.3, none, np.zeros((0, count), bool))


def test_drift_moves_the_pose_as_refitting_does(scene):
    subject, channels, weight, state = scene
    random = np.random.default_rng(0)
    exact = channels.uv[20]
    moved = np.array([
        state.difference(fit(subject.body, channels, exact + 2.0 * random.standard_normal(exact.shape), weight, state))
        for _ in range(60)
    ])
    told = np.sqrt(np.diag(covariance(scene, noise_of(channels, drift=2.0)).dofs))
    sure = told[6:] < 0.15  # what is nearly free is not linear
    ratio = np.std(moved, axis=0)[6:][sure] / told[6:][sure]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.12)
    assert np.all((ratio > 0.6) & (ratio < 1.5))


def test_a_constant_error_changes_a_difference_of_frames_as_refitting_does(scene):
    subject, channels, _, _ = scene
    random = np.random.default_rng(1)
    layout, n = Layout(channels, subject.body), subject.body.tree.n_dofs
    none = no_others(n)
    count = len(channels.column)
    noise = replace(noise_of(channels), bias=np.full(count, 2.0))
    exact = replace(KeypointPriors.of(subject, channels, None), covariance=np.zeros((len(subject.covariance),) * 2))
    factors, fits = [], []
    for frame in (20, 40):
        weight = channels.weight[frame]
        state = fit(subject.body, channels, channels.uv[frame], weight, MOTION.state(frame))
        one = systematic_errors(exact, layout, state, weight, noise, SharedErrors.none(count), none)
        np.testing.assert_allclose(one.constant @ one.constant.T, one.dofs, atol=1e-12)
        factors.append(one.constant)
        fits.append((frame, weight, state))
    changes = []
    for _ in range(60):
        error = 2.0 * random.standard_normal((count, 2))
        a, b = (s.difference(fit(subject.body, channels, channels.uv[f] + error, w, s)) for f, w, s in fits)
        changes.append(b - a)
    told, alone = np.linalg.norm(factors[1] - factors[0], axis=1), np.linalg.norm(factors[1], axis=1)
    sure = alone[6:] < 0.15
    ratio = np.std(changes, axis=0)[6:][sure] / told[6:][sure]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.12) and np.median(told[6:] / alone[6:]) < 0.9


def test_white_errors_smaller_than_assumed_move_the_pose_less_as_refitting_does(scene):
    subject, channels, weight, state = scene
    random, exact, sigma = np.random.default_rng(2), channels.uv[20], 1.0
    errors = sigma * random.standard_normal((80, *exact.shape))
    moved = np.array([state.difference(fit(subject.body, channels, exact + e, weight, state)) for e in errors])
    noise = replace(noise_of(channels), jitter=np.full(len(weight), sigma))
    layout, n = Layout(channels, subject.body), subject.body.tree.n_dofs
    none = no_others(n)
    known = KeypointPriors.of(subject, channels, None)
    assumed, shared = 1.0 / np.where(weight > 0, weight, np.inf), SharedErrors.none(len(weight))
    one, alone = (
        systematic_errors(known, layout, state, weight, of, shared, none, Averaged(1, assumed))
        for of in (noise, replace(noise, jitter=np.sqrt(assumed)))
    )
    sure = np.sqrt(np.diag(one.alone))[6:] < 0.1  # what is nearly free is not linear
    posture = one.alone[:, 6:] @ subject.body.tree.posture_precision @ one.alone[6:]  # what the prior adds to the noise
    told = 1.0 - (1.0 - one.white_dofs[6:][sure]) / 0.8  # the rest is of accelerations
    found = (np.var(moved, axis=0) + np.diag(posture))[6:][sure] / np.diag(one.alone)[6:][sure]
    np.testing.assert_allclose(found, told, rtol=0.25)
    assert np.median(told) < 0.6
    np.testing.assert_allclose(alone.white_dofs, 1.0, atol=1e-6)
    assert one.white_joints.shape == one.joints.shape and np.all((one.white_joints >= 0.2) & (one.white_joints <= 1.0))
    smoothed = systematic_errors(known, layout, state, weight, noise, shared, none)
    np.testing.assert_array_equal(smoothed.white_dofs, 1.0)  # a fit of each frame, whose errors are not averaged


def test_a_shifted_camera_moves_the_pose_as_refitting_does(scene):
    subject, channels, weight, state = scene
    shift = np.zeros((4, 2))
    shift[1] = (2.0, 0.0)
    pushed = channels.uv[20] + shift[channels.source]
    moved = state.difference(fit(subject.body, channels, pushed, weight, state))
    told = np.sqrt(np.diag(covariance(scene, noise_of(channels, shift=shift)).dofs))
    sure = (told < 0.1) & (told > 1e-4)
    np.testing.assert_allclose(np.abs(moved)[sure], told[sure], rtol=0.25, atol=2e-3)


def test_another_shape_moves_joints_as_refitting_does(scene):
    subject, channels, weight, state = scene
    body, groups = load_body("humanoid"), load_body("humanoid").scale_groups
    g, by = groups.index("thigh"), 0.01
    longer = np.array(subject.scales)
    longer[g] *= 1.0 + by
    name = next(iter(channels.sets))
    other = body.scaled(longer)
    shifts = subject.body.keypoints(name).points - body.scaled(subject.scales).keypoints(name).points
    other = other.with_keypoints(name, other.keypoints(name).points + shifts)
    refitted = fit(other, channels, channels.uv[20], weight, state)
    before, after = (
        b.tree.segment_poses(s.T_world_root[None], s.angles[None])[0, :, :3, 3]
        for b, s in ((subject.body, state), (other, refitted))
    )
    Sigma = np.zeros((len(subject.fit.mean),) * 2)
    Sigma[g, g] = by**2
    told = np.sqrt(covariance(scene, noise_of(channels), Sigma).joints)
    np.testing.assert_allclose(told, np.abs(after - before), atol=1.2e-3)
    assert told.max() > 2e-3


@pytest.mark.parametrize(("axis", "by"), [(0, 0.005), (2, 0.01), (4, 0.002), (5, 0.003)])
def test_a_camera_that_stands_elsewhere_moves_the_pose_as_refitting_does(scene, axis, by):
    subject, channels, weight, state = scene
    cameras, twist = CameraExtrinsics(RIG, None), np.zeros(6 * len(RIG))
    twist[6 + axis] = by  # of the second camera
    elsewhere = replace(channels, rig=cameras.apply(World(subject.body, RIG), twist).rig)
    moved = state.difference(fit(subject.body, elsewhere, channels.uv[20], weight, state))
    count = len(subject.fit.mean)
    Sigma = np.zeros((count + len(twist),) * 2)
    Sigma[count:, count:] = np.outer(twist, twist)
    told = np.sqrt(np.diag(covariance(scene, noise_of(channels), Sigma, CameraErrors(0.003, 0.002)).dofs))
    sure = (told < 0.1) & (told > 1e-4)
    np.testing.assert_allclose(np.abs(moved)[sure], told[sure], rtol=0.25, atol=2e-3)
    assert told[:6].max() > 1e-3


def test_a_subject_of_other_cameras_tells_its_shape_and_nothing_of_these(scene):
    _, channels, _, _ = scene
    body = load_body("humanoid")
    other = fit_subject(body, channels, cameras=CameraErrors(0.003, 0.002))
    mine = KeypointPriors.of(other, channels, CameraErrors(0.003, 0.002))
    assert mine.cameras is other.fit.cameras and mine.covariance.shape == other.covariance.shape
    names = tuple(f"other {name}" for name in RIG.names)
    elsewhere = replace(channels, rig=Rig(tuple(replace(c, name=n) for c, n in zip(RIG, names))))
    known = KeypointPriors.of(other, elsewhere, CameraErrors(0.003, 0.002))
    assert known.cameras.free == names
    count = len(other.fit.mean) - 6 * len(RIG)
    np.testing.assert_array_equal(known.covariance[:count, :count], other.covariance[:count, :count])
    np.testing.assert_allclose(known.covariance[count:, count:], np.linalg.inv(known.cameras.information))
    assert KeypointPriors.of(other, elsewhere, None).cameras is None


def test_nothing_seen_leaves_finite_bars(scene):
    subject, channels, weight, state = scene
    unseen = subject, channels, np.zeros_like(weight), state
    out = covariance(unseen, noise_of(channels, drift=3.0), subject.covariance)
    assert np.all(np.isfinite(out.dofs)) and np.all(np.isfinite(out.joints)) and out.joints.min() >= 0
