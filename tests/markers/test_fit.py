"""The plain fit of labelled markers."""

from __future__ import annotations

import numpy as np
import pytest

from kinefit import MarkerFrame, Markers, Recording, fit_marker_subject, fit_markers, load_body, track
from kinefit.bodies.marker_sets import bare
from kinefit.errors import ObservationError
from kinefit.evaluation import joint_errors
from kinefit.geometry.camera import Rig
from kinefit.simulation import squat_and_wave


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


def test_a_track_of_the_same_markers_agrees(recording):
    """One subject fit, one prior, one loss, one meaning of quality; the track smooths each frame's own errors."""
    _, markers = recording
    body, names = load_body("humanoid"), tuple(bare(name) for name in markers.names)
    subject = fit_marker_subject(body, markers, "HANIM_45")
    fitted = fit_markers(subject, markers)
    steps = [[MarkerFrame("mocap", t, names, x, "HANIM_45")] for t, x in zip(markers.times, markers.positions)]
    tracked = track(Recording.of_frames(steps, Rig(()), rate=markers.rate, up=markers.up), body)
    np.testing.assert_allclose(tracked.body.tree.offsets, fitted.body.tree.offsets, atol=1e-9)
    assert np.median(np.linalg.norm(tracked.joint_centres - fitted.joint_centres, axis=2)) < 0.002
    assert abs(tracked.quality.mean() - fitted.quality.mean()) < 0.01
    assert np.mean(tracked.lost != fitted.lost) < 0.01


def test_error_bars_are_those_of_the_scatter(recording):
    truth, markers = recording
    motion = fit_markers(load_body("humanoid"), markers, sigma=0.002)
    off = motion.segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3]
    inside = np.abs(off) < 2 * motion.joint_std
    assert 0.92 < inside.mean() <= 0.99


def test_unknown_labels_are_told():
    markers = Markers(("a", "b", "c", "d"), 100.0, np.zeros((3, 4, 3)))
    with pytest.raises(ObservationError, match="HANIM_45"):
        fit_markers(load_body("humanoid"), markers)
