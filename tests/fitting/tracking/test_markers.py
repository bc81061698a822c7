"""Labelled markers of one file: `track` with one marker sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinefit import BodyState, Markers, Recording, fit_marker_subject, fit_markers, load_body, track
from kinefit.bodies.marker_sets import bare, placement
from kinefit.errors import ObservationError
from kinefit.fitting.smoothing.smoother import smooth_results
from kinefit.fitting.tracking.run import fit_marker_steps
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import SQUARED
from kinefit.observations import MarkerFrame, NamedMarkers
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import squat_and_wave
from kinefit.simulation.evaluation import joint_errors


@pytest.fixture(scope="module")
def recording():
    truth = squat_and_wave(rate=60)
    points = truth.body.markers("HANIM_45")
    rng = np.random.default_rng(0)
    x = truth.positions(points) + rng.normal(0, 0.002, (len(truth), len(points), 3))
    x[rng.uniform(size=x.shape[:2]) < 0.1] = np.nan
    x[30, 5] += 0.3
    return truth, Markers(tuple(f"Anna:{n}" for n in points.names), truth.rate, x, up=truth.up)


def test_motion_is_recovered_with_gaps_and_a_ghost(recording):
    truth, markers = recording
    motion = fit_markers(load_body("humanoid"), markers)
    known = motion.joint_std.max(axis=2) < 0.01  # a segment of two markers is loose where one is missing
    assert known.mean() > 0.8
    assert joint_errors(truth, motion)[known].max() < 0.03
    assert joint_errors(truth, motion)[known].mean() < 0.004
    assert motion.residuals["markers"].weights[30, 5] < 0.01


def test_a_track_of_the_same_markers_is_the_same(recording):
    _, markers = recording
    body, names = load_body("humanoid"), tuple(bare(name) for name in markers.names)
    fitted = fit_markers(fit_marker_subject(body, markers, "HANIM_45"), markers)
    steps = [[MarkerFrame("markers", t, names, x, "HANIM_45")] for t, x in zip(markers.times, markers.positions)]
    tracked = track(Recording.of_frames(steps, Rig(()), rate=markers.rate, up=markers.up), body)
    np.testing.assert_allclose(tracked.body.tree.offsets, fitted.body.tree.offsets, atol=1e-9)
    np.testing.assert_allclose(tracked.joint_centres, fitted.joint_centres, atol=1e-6)
    np.testing.assert_allclose(tracked.joint_std, fitted.joint_std, rtol=1e-4)
    np.testing.assert_allclose(tracked.segment_quality, fitted.segment_quality)
    assert fitted.provenance["smoothing"].keys() == tracked.provenance["smoothing"].keys()
    assert fitted.lasting is not None and fitted.provenance["length_std_m"]


@pytest.mark.parametrize("smooth", [True, False])
def test_error_bars_of_a_fitted_subject_cover_the_truth(smooth):
    """Its lengths and offsets are estimates: with them taken as exact, hardly half of the truth was inside."""
    truth, inside, narrow = squat_and_wave(rate=60), [], []
    placed = placement(truth.body, "CMU_41")
    for seed in range(2):
        rng = np.random.default_rng(seed)
        away = placed.spread[:, None] * rng.normal(size=(len(placed.points), 3))
        points = replace(placed.points, points=placed.points.points + away)
        x = truth.positions(points) + rng.normal(0, 0.002, (len(truth), len(points), 3))
        markers = Markers(points.names, truth.rate, x, up=truth.up)
        subject = fit_marker_subject(load_body("humanoid"), markers)
        motion = fit_markers(subject, markers, smooth=smooth)
        off = np.abs(motion.joint_centres - truth.joint_centres)
        inside.append(np.mean(off < 1.96 * motion.joint_std))
        exact = fit_markers(subject.body, markers, subject.marker_set, sigma=subject.sigma, smooth=smooth)
        narrow.append(np.mean(off < 1.96 * exact.joint_std))
    assert 0.85 < np.mean(inside) < 0.995
    assert np.mean(narrow) < 0.7


def test_each_frame_alone_knows_of_no_other(recording):
    _, markers = recording
    body = load_body("humanoid")
    motion = fit_markers(body, markers, smooth=False)
    assert motion.provenance["estimate"] == "each frame alone" and "smoothing" not in motion.provenance
    some = replace(markers, positions=np.delete(markers.positions, slice(50, 60), axis=0))
    rest = np.delete(np.arange(len(markers)), slice(50, 60))
    again = fit_markers(body, some, smooth=False)
    np.testing.assert_allclose(again.joint_centres, motion.joint_centres[rest], atol=2e-3)
    smoothed = fit_markers(body, markers)
    jerk = [np.square(np.diff(m.joint_centres, 3, axis=0)).mean() for m in (motion, smoothed)]
    assert jerk[1] < 0.3 * jerk[0]
    assert np.median(smoothed.joint_std) < np.median(motion.joint_std)


@pytest.mark.parametrize("smooth", [True, False])
def test_joints_may_leave_their_limits(smooth):
    body = load_body("humanoid")
    truth = squat_and_wave(rate=30, duration=1.0)
    d = body.tree.coordinates.index("knee_angle_r")
    angles = np.array(truth.angles)
    beyond = body.tree.lower[d] - 0.4
    angles[:, d] = beyond
    points = body.markers("HANIM_45")
    x = body.trajectories(truth.Ts_world_root, angles, points)
    markers = Markers(points.names, truth.rate, x, up=truth.up)
    free, held = (fit_markers(body, markers, limits=limits, smooth=smooth) for limits in (False, True))
    assert np.abs(free.angles[:, d] - beyond).max() < 0.1
    assert (held.angles[:, d] >= body.tree.lower[d] - 1e-9).all()
    assert free.body is body


def test_sigma_and_loss_are_those_that_are_given(recording):
    truth, markers = recording
    body, points = load_body("humanoid"), truth.body.markers("HANIM_45")
    k = int(np.flatnonzero(points.segments == body.tree.segment("pelvis"))[0])
    x = np.array(markers.positions)
    x[:, k] += 0.01
    shifted = replace(markers, positions=x)
    sigma = np.full(len(points), 0.005)
    trusted = fit_markers(body, shifted, "HANIM_45", sigma=sigma)
    sigma[k] = 0.1
    doubted = fit_markers(body, shifted, "HANIM_45", sigma=sigma)
    off = [np.nanmedian(m.residuals["markers"].norms[:, k]) for m in (trusted, doubted)]
    assert off[0] < 0.95 * off[1] and off[1] == pytest.approx(0.01 * 3**0.5, rel=0.2)
    pulled = fit_markers(body, markers, loss=SQUARED)
    plain = fit_markers(body, markers)
    errors = [joint_errors(truth, m)[30].max() for m in (pulled, plain)]  # in the frame of the ghost
    assert errors[0] > 2.0 * errors[1]


def test_the_vertical_is_that_of_the_body_where_none_is_stated(recording):
    truth, markers = recording
    assert fit_markers(load_body("humanoid"), replace(markers, up=None)).up == truth.up
    assert fit_markers(load_body("humanoid"), markers, up="x").up == "x"


@pytest.fixture(scope="module")
def bow():
    """Lumbar and thorax bent against each other, with no marker between them: body, markers, angles (F, 2) [rad]."""
    body, rng, frames = load_body("humanoid"), np.random.default_rng(0), 90
    points, angles = placement(body, "STANFORD_47").points, np.tile(body.tree.usual, (frames, 1))
    trunk = [body.tree.coordinates.index(f"{part}_extension") for part in ("lumbar", "thorax")]
    angles[:, trunk] = np.radians([-30.0, 30.0]) * np.sin(np.linspace(0.0, np.pi, frames))[:, None]
    x = body.trajectories(np.tile(np.eye(4), (frames, 1, 1)), angles, points)
    x = x + rng.normal(0, 0.005, x.shape[1:]) + rng.normal(0, 0.005, x.shape)
    markers = Markers(points.names, 60.0, x, up="y")
    return replace(body, marker_sets={"STANFORD_47": points}), markers, trunk, angles


def test_error_bars_cover_a_flat_valley_of_the_cost(bow):
    """The prior errs alike in all frames: smoothing does not make what it alone decides more certain."""
    body, markers, trunk, angles = bow
    motion = fit_markers(body, markers, sigma=0.007)
    off, std = np.abs(motion.angles - angles)[:, trunk], motion.dof_std[:, 6:][:, trunk]
    assert np.mean(off < 2.0 * std) > 0.8
    assert np.abs(np.diff(motion.angles[:, trunk], axis=0)).max() < np.radians(3.0)


def test_smoothing_leaves_a_worse_minimum(bow):
    body, markers, trunk, _ = bow
    worn = NamedMarkers("markers", markers, "STANFORD_47")
    recording = Recording(
        markers.times, 60.0, Rig(()), steps=lambda i: [worn.at(float(markers.times[i]))], markers=(worn,), up="y"
    )
    settings = TrackSettings()
    frames = fit_marker_steps(recording, body, settings)
    results = list(frames.results)
    for f in range(20, 30):
        state = results[f].state
        angles = np.array(state.angles)
        angles[trunk] += np.radians([25.0, -25.0])
        results[f] = replace(results[f], state=BodyState(state.T_world_root, angles))
    both = frames, replace(frames, results=results)
    right, left = (smooth_results(one).take.angles for one in both)
    np.testing.assert_allclose(left[:, trunk], right[:, trunk], atol=np.radians(0.5))


def test_unknown_labels_are_told():
    markers = Markers(("a", "b", "c", "d"), 100.0, np.zeros((3, 4, 3)))
    with pytest.raises(ObservationError, match="HANIM_45"):
        fit_markers(load_body("humanoid"), markers)
