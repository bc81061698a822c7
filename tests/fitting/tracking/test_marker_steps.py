"""Labelled markers alone are fitted as one sequence; all else goes through the tracker."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit import BodyState, Recording
from kinefit.fitting.tracking.run import fit_marker_steps, run
from kinefit.fitting.tracking.video import track
from kinefit.geometry.camera import Rig
from kinefit.observations import MarkerFrame
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation import squat_and_wave

RATE, NOISE = 50.0, 0.004


@pytest.fixture(scope="module")
def truth():
    return squat_and_wave(rate=RATE, duration=1.6)


@pytest.fixture(scope="module")
def recording(truth):
    """80 frames of 45 markers, a tenth of them unseen."""
    rng, points = np.random.default_rng(2), truth.body.markers("HANIM_45")
    x = truth.positions(points) + rng.normal(0.0, NOISE, (len(truth), len(points), 3))
    x[rng.uniform(size=x.shape[:2]) < 0.1] = np.nan
    steps = [[MarkerFrame("mocap", i / RATE, points.names, x[i], "HANIM_45")] for i in range(len(truth))]
    return Recording.of_frames(steps, Rig(()), rate=RATE, up="y")


def centres(motion):
    return motion.body.tree.segment_poses(motion.Ts_world_root, motion.angles)[..., :3, 3]


def off(truth, motion):
    """[m] root mean square error of the joint centres."""
    return float(np.sqrt(np.mean(np.sum((centres(motion) - centres(truth)) ** 2, axis=2))))


def test_the_sequence_starts_where_the_tracker_would(truth, recording):
    fitted = fit_marker_steps(recording, truth.body, TrackSettings())
    tracked = run(recording, truth.body, TrackSettings())
    assert fitted.steps == list(range(len(truth))) == tracked.steps and fitted.complete
    apart = [
        np.linalg.norm(a.state.T_world_root[:3, 3] - b.state.T_world_root[:3, 3])
        for a, b in zip(fitted.results, tracked.results, strict=True)
    ]
    assert np.median(apart) < 0.004


def test_smoothed_poses_cover_the_truth(truth, recording):
    motion = track(recording, truth.body, size=False)
    assert motion.provenance["estimate"] == "smoothed"
    assert off(truth, motion) < 0.006
    error, std = centres(motion) - centres(truth), motion.joint_std
    seen = np.isfinite(std)
    assert 0.9 < np.mean(np.abs(error[seen]) < 1.96 * std[seen]) <= 1.0
    assert motion.residuals["mocap"].values.shape == (len(truth), 45, 3)


def test_without_smoothing_or_with_a_lag_no_frame_knows_of_later_ones(truth, recording):
    motion = track(recording, truth.body, size=False, smooth=False)
    assert motion.provenance["estimate"] == "filtered" and off(truth, motion) < 0.012
    short = track(recording.part(slice(0, 40)), truth.body, size=False, smooth=False)
    np.testing.assert_array_equal(short.angles, motion.angles[:40])
    lagged = track(recording, truth.body, size=False, lag=0.1)
    assert lagged.provenance["estimate"] == "fixed lag" and off(truth, lagged) < 0.012


def test_a_gap_of_all_markers_is_bridged(truth, recording):
    steps = [recording.steps(i) if not 30 <= i < 36 else [] for i in range(len(truth))]
    gap = Recording.of_frames(steps, Rig(()), rate=RATE, up="y")
    motion = track(gap, truth.body, size=False)
    assert len(motion) == len(truth) and off(truth, motion) < 0.03
    assert motion.joint_std[33].mean() > 1.5 * motion.joint_std[20].mean()


def test_what_a_sequence_cannot_do_is_left_to_the_tracker(truth, recording):
    body, settings = truth.body, TrackSettings()
    start = 0, truth.state(0)
    assert fit_marker_steps(replace(recording, start=start), body, settings) is None
    assert fit_marker_steps(replace(recording, others=(truth,)), body, settings) is None
    few = [[replace(f, names=f.names[:4], positions=f.positions[:4]) for f in recording.steps(i)] for i in range(20)]
    few = Recording.of_frames(few, Rig(()), rate=RATE, up="y")
    assert fit_marker_steps(few, body, settings) is None
    between = [
        [replace(f, time=f.time + (0.004 if i % 2 else 0.0)) for f in recording.steps(i)] for i in range(len(truth))
    ]
    late = replace(recording, steps=lambda i: between[i])
    assert fit_marker_steps(late, body, settings) is None
    assert isinstance(run(recording, body, settings).results[0].state, BodyState)
